"""Regions of a scene: their definition, their selection by masks, and their share of every pixel."""
