"""User interfaces: HTTP API, command line, Python client and web page."""
