"""The feature network: its weights, the partition of a view that it takes, statistics of its features."""
