"""SOS loss of a view: its terms, their targets, and its gradient."""
