"""Benchmarks that users run on their own scene (`variants`), and the examination of their machine (`doctor`)."""
