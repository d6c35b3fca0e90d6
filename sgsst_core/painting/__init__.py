"""Painted views: colors of a scene that show what somebody painted on pictures of it."""
