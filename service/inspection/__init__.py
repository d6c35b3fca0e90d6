"""Checks of users' files in a process that may die of them."""
