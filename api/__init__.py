"""Everything that a user touches."""
