"""The optimiser: views, steps, phases, checkpoints."""
