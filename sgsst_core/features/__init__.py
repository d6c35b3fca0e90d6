"""Feature network: weights, partition tiles and feature statistics."""
