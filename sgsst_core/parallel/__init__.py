"""Communication between ranks, and the division of views into tiles and among ranks."""
