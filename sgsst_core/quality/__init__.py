"""Measurements of a finished result, and findings about inputs: nothing here changes a job."""
