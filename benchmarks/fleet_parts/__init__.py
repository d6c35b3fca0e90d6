"""A fleet in simulation: its jobs, its hosts under a clock of their own, and what is told of them."""
