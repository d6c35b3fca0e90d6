"""Simulated CUDA device for tests on machines without a GPU; see `device` and `runtime`."""
