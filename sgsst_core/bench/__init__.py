"""Benchmarks that users can run on their own scenes and machines."""
