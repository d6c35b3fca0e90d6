"""Paintings that come with the program; in the public domain."""

from __future__ import annotations

from pathlib import Path

#: Vincent van Gogh, The Starry Night, 1889: 800x633 JPEG.
STARRY_NIGHT = Path(__file__).with_name("starry_night.jpg")
