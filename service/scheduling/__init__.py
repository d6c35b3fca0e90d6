"""Scheduling of jobs: which one runs when and where, and what follows from how it ends."""
