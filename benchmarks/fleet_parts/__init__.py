"""Simulation of a fleet: its jobs, its hosts under a simulated clock, and its figures."""
