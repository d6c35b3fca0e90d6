"""Tests of the papers' protocol: which scene and pairs it measures, and that its figures are those of novel views."""

from __future__ import annotations

import pytest
import torch

from benchmarks.protocol import STYLIZED, UNSTYLIZED, measured
from sgsst_core.quality.consistency import Warp, consistency, expected_depth, find_warp, shown, view_pairs
from sgsst_core.quality.lpips import Lpips
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.scene.spherical_harmonics import view_colors
from tests.small_scenes import ball, cameras

pytestmark = pytest.mark.usefixtures("one_thread")


def test_figures_are_those_of_novel_views(vgg16_weights: object) -> None:
    scene, views, lpips = ball(), cameras(9), Lpips()
    rasterizer = CpuRasterizer(scene)
    noise = torch.randn(scene.sh_dc.shape, generator=torch.Generator().manual_seed(0))
    colors = {UNSTYLIZED: scene.sh_dc, STYLIZED: scene.sh_dc + 0.3 * noise}
    rows = measured(scene, views, rasterizer, colors, lpips, 2)
    depths = [expected_depth(scene, view, rasterizer) for view in views]
    plain = torch.zeros(())  # the scene has no view-dependent color

    def warp(first: int, second: int) -> Warp:
        return find_warp(depths[second], views[second], depths[first], views[first])

    for name, sh_dc in colors.items():
        images = [shown(rasterizer.render(view_colors(sh_dc, plain), view), view, plain.device) for view in views]
        for range_name, gap in (("short", 1), ("long", 7)):
            expected = consistency(gap, view_pairs(9, gap, 2), images.__getitem__, warp, lpips)
            assert rows[name][range_name] == {
                "rmse": expected.rmse,
                "lpips": expected.lpips,
                "compared": expected.compared,
                "pairs": 2,
            }
    assert rows[UNSTYLIZED]["short"]["rmse"] < rows[UNSTYLIZED]["long"]["rmse"]
