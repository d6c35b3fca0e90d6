"""Tests of the comparison of methods: a small run, and that the document shows stored results."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from benchmarks.equal_steps import UNSTYLIZED
from benchmarks.methods import COLORS, METHODS, PAIRS, recolored, run, stored, table
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.style import color_moments
from tests.small_scenes import cameras, style, wall

ROOT = Path(__file__).resolve().parents[2]


def test_document_shows_the_stored_results() -> None:
    assert list(stored()) == PAIRS[: len(stored())]
    assert table(list(stored().values())) in (ROOT / "docs" / "quality.md").read_text()


def test_table_has_means_of_the_pairs_that_have_a_figure() -> None:
    pairs = [{"a": {"style": 1.0, "long_lpips": 0.25}}, {"a": {"style": 2.0}}]
    head, _, row = table(pairs).splitlines()
    cells = dict(zip(head.split(" | "), row.split(" | "), strict=True))
    assert (cells["style"], cells["long-range LPIPS"], cells["content"]) == ("1.500", "0.250", "")
    assert head.startswith("| mean of 2 |")


def test_recolored_views_have_the_mean_and_covariance_of_the_style() -> None:
    """Nothing is clipped, because scene and style have little contrast."""
    scene, views = replace(wall(), sh_dc=0.3 * wall().sh_dc), cameras(2)
    pixels = 0.5 + 0.1 * (style() - 0.5)
    shown = replace(scene, sh_dc=recolored(scene, views, pixels))
    rasterizer = make_rasterizer("cpu", scene)
    images = torch.cat([rasterizer.render(scene_colors(shown, view), view).flatten(0, 1) for view in views])
    for actual, expected in zip(color_moments(images), color_moments(pixels.flatten(0, 1)), strict=True):
        torch.testing.assert_close(actual, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.slow
def test_all_methods_change_the_colors_of_one_scene(vgg16_weights: object, tmp_path: Path) -> None:
    (tmp_path / "styles").mkdir()
    Image.effect_noise((96, 64), 80).convert("RGB").save(tmp_path / "styles" / "noise.jpg")
    rows = run(tmp_path, "demo, noise", 96, steps_coarse=0, steps_sos=3)
    assert list(rows) == [UNSTYLIZED, COLORS, *METHODS]
    before = rows.pop(UNSTYLIZED)
    assert (before["content"], before["ssim"]) == (0, 1)
    assert all(row["content"] > 0 and row["ssim"] < 1 for row in rows.values())
    assert all({"short_rmse", "short_lpips", "long_rmse", "long_lpips"} <= row.keys() for row in rows.values())
    assert all(row["short_compared"] == before["short_compared"] > 0.5 for row in rows.values())
    assert rows[COLORS]["color_distance"] < before["color_distance"]
    assert len({row["style"] for row in rows.values()}) == len(rows)
