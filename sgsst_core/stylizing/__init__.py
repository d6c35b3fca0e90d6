"""The optimizer: views, steps, phases, checkpoints."""
