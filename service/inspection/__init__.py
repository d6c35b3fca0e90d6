"""Checks of users' files in a separate process, so that a malicious file cannot crash the service."""
