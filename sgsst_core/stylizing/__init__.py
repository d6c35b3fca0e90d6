"""Optimization: inputs, styles and views of a job, its plan and steps, its colors, and checkpoints."""
