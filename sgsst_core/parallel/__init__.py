"""Communication between ranks, and the division of work among them."""
