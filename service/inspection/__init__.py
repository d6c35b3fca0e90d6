"""Checks of users' files in a separate process, which a malicious file may crash."""
