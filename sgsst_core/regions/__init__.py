"""Regions of a scene: their definition, their selection by masks, and their weights in every pixel."""
