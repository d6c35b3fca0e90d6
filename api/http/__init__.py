"""The REST API. Each module has one subject, with its routes, and the models of all are in `schemas`."""
