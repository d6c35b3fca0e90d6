"""What ranks tell each other, and who of them does what."""
