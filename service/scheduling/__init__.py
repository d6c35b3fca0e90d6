"""Which job runs when and where, and what follows from how it ends."""
