"""What a job tells in the end: the document, its page and its figures."""
