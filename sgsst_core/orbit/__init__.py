"""Orbits: subject and up direction of a scene, and rings of cameras around it."""
