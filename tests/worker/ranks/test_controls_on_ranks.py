"""Tests that jobs with artistic controls give the same result on several ranks as on one rank."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sgsst_core.parallel.collectives import ALONE
from sgsst_core.scene.colors import gray
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.synthetic_images import relative_error
from tests.small_scenes import ball, style, wall
from tests.worker.ranks.spawn import on_ranks
from tests.worker.ranks.test_exact_ranks import stylize

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(
    ("scene", "values"),
    [
        pytest.param(wall(sh_degree=2), {"sh_attenuation": 0.3}, id="attenuation"),
        pytest.param(wall(), {"scales": (0.0, 1.0), "style_loss": "mixed"}, id="one-scale"),
        pytest.param(
            ball(), {"preserve_colors": "luminance", "training_background": "palette"}, id="luminance-of-a-scan"
        ),
    ],
)
def test_several_ranks_match_one_rank(scene: Scene, values: dict[str, Any]) -> None:
    values = {"steps_coarse": 2, "steps_sos": 4, "learning_rate": 0.01} | values
    expected = stylize(ALONE, scene, 3, values)
    actual = on_ranks(3, stylize, scene, 3, values)
    for result in actual:
        assert result["losses"] == pytest.approx(expected["losses"], rel=1e-4)
        assert relative_error(result["colors"], expected["colors"]) < 1e-3
        assert torch.equal(result["colors"], actual[0]["colors"])


def test_ranks_stay_in_the_same_color_subspace() -> None:
    values = {"steps_coarse": 2, "steps_sos": 4, "learning_rate": 0.01}
    expected = stylize(ALONE, wall(), 3, values, gray(style()))
    first, second = on_ranks(2, stylize, wall(), 3, values, gray(style()))
    assert "color subspace" in expected["plan"]
    assert relative_error(first["colors"], expected["colors"]) < 1e-3
    assert torch.equal(first["colors"], second["colors"])
