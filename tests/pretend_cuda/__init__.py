"""A pretend CUDA device: what can be shown of a GPU without one. See `device` and `runtime`."""
