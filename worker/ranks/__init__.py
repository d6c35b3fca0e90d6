"""A job on several ranks: processes, exchanges between them, what happens when one is lost."""
