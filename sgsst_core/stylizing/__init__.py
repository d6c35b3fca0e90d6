"""Optimization: views, steps, phases and checkpoints."""
