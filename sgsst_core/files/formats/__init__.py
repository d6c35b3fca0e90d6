"""Scene formats: one module per format, with its header check, reader and writer."""
