"""Tests that the document shows the stored error against run time, and that its figure can be drawn."""

from __future__ import annotations

from pathlib import Path

from PIL import Image

from benchmarks.error_time import DPI, SIZE, stored, table, write_figure

ROOT = Path(__file__).resolve().parents[2]


def test_document_shows_the_stored_results() -> None:
    assert table(stored()) in (ROOT / "docs" / "performance.md").read_text()


def test_figure_is_small_enough_for_the_readme(tmp_path: Path) -> None:
    path = tmp_path / "error_time.png"
    write_figure(path, stored())
    assert Image.open(path).size == (SIZE[0] * DPI, SIZE[1] * DPI)
    assert path.stat().st_size < 120_000
