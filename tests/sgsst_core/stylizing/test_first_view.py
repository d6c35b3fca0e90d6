"""Tests of the first image of a job against the warm start of a planned job with only this view."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.regions import Region, Regions
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.stylizer import Stylizer, render_first_view
from tests.sgsst_core.stylizing.test_stylized_regions import halves
from tests.small_scenes import blind_camera, cameras, style, wall

CAMERA = cameras(1)[0]


@pytest.mark.parametrize(
    ("values", "right"),
    [
        ({}, None),
        ({"sh_attenuation": 0.5, "background": (0.2, 0.4, 0.6)}, None),
        ({"preserve_colors": "luminance", "warm_start": True}, None),
        ({"preserve_colors": "match", "style_rotation": 30.0}, None),
        ({}, Region("right", freeze=True)),
        ({}, Region("right", style=Style.of(style().flip(2)))),
        ({}, Region("right", content_weight=1e4)),
    ],
    ids=["plain", "attenuated", "luminance", "match", "frozen", "own style", "content"],
)
def test_first_view_has_warm_start_colors(
    tiny_weights: BackboneWeights, values: dict[str, Any], right: Region | None
) -> None:
    scene = wall(sh_degree=1)
    scene.means[:5] += 1000  # the view does not show them
    settings, regions = (
        make_settings("preview", coarsest_side=24, **values),
        None if right is None else halves(scene, right=right),
    )
    planned = Stylizer.planned(scene, [CAMERA], style(), settings, weights=tiny_weights, regions=regions)
    views = planned.job.views
    expected = views.rasterizer.render(views.colors(0, planned.sh_dc), CAMERA)
    actual = render_first_view(scene, CAMERA, Style.of(style()), settings, regions)
    assert actual is not None
    assert torch.equal(actual, expected)
    assert not torch.equal(actual, views.unstylized(0))


def test_view_without_anything_to_change_has_no_image() -> None:
    scene, settings = wall(), make_settings("preview")
    frozen = Regions((Region("rest"), Region("all", freeze=True)), torch.ones(len(scene), dtype=torch.uint8))
    assert render_first_view(scene, blind_camera(), Style.of(style()), settings) is None
    assert render_first_view(scene, CAMERA, Style.of(style()), settings, frozen) is None
