"""Tests of the benchmark that compares variants by a network that is not part of any loss."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image

from sgsst_core.bench.variants import (
    TRANSFER,
    UNSTYLIZED,
    Quality,
    VariantResult,
    choose_variants,
    compare_quality,
    write_plot,
    write_sheet,
)
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def quality(tiny_weights: BackboneWeights, vgg16_weights: object) -> Quality:
    """Compare three variants. AlexNet's weights are installed together with VGG16's."""
    variants = choose_variants(["standard", "one-scale", "tf32"])
    views = cameras(3, 96, 72)
    return compare_quality(wall(), views, style(), variants, 1.0, weights=tiny_weights, coarsest_side=36)


def test_variants_are_compared_with_scene_and_color_transfer(quality: Quality) -> None:
    before, transfer, *variants = quality.outcomes
    assert (before.name, transfer.name) == (UNSTYLIZED, TRANSFER)
    assert [outcome.name for outcome in variants] == ["standard", "one-scale"]
    assert [curve.variant.name for curve in quality.curves if curve.left_out] == ["tf32"]  # needs a GPU
    assert before.judgment.content == 0
    assert transfer.judgment.color_distance < before.judgment.color_distance
    for outcome in variants:
        assert outcome.loss is not None
        assert outcome.loss < 1
        assert outcome.steps > 0
        assert outcome.judgment.content > 0
        assert outcome.short is not None
    values = json.loads(json.dumps(quality.as_dict()))
    assert values["outcomes"][2]["consistency"]["short"]["rmse"] > 0
    assert values["views"]
    last = values["error_time"]["variants"]["standard"]["points"][-1]
    assert last["relative"] == variants[0].loss


def test_pareto_front_contains_undominated_outcomes(quality: Quality) -> None:
    def outcome(name: str, style: float, content: float) -> VariantResult:
        judgment = replace(quality.outcomes[0].judgment, style=style, content=content)
        return replace(quality.outcomes[0], name=name, judgment=judgment)

    outcomes = [
        outcome(UNSTYLIZED, 2.0, 0.0),  # does not count as a result
        outcome("a", 1.0, 0.5),
        outcome("b", 0.8, 0.6),
        outcome("beaten", 1.1, 0.55),
        outcome("c", 1.5, 0.1),
    ]
    assert [one.name for one in replace(quality, outcomes=outcomes).front()] == ["b", "a", "c"]


def test_plot_and_sheet_are_written(quality: Quality, tmp_path: Path) -> None:
    write_plot(tmp_path / "q.png", quality, "a wall")
    write_sheet(tmp_path / "q.jpg", quality)
    assert Image.open(tmp_path / "q.png").width > 600
    sheet = Image.open(tmp_path / "q.jpg")
    assert sheet.height > 4 * 300  # style and four rows
    on_white = quality.judge.renders(torch.zeros_like(wall().sh_dc), quality.judge.cameras[0])[1]
    assert on_white.shape == (72, 96, 3)


def test_too_few_cameras_are_refused(tiny_weights: BackboneWeights, vgg16_weights: object) -> None:
    with pytest.raises(SettingsError, match="more cameras"):
        compare_quality(wall(), cameras(1, 96, 72), style(), [], 1.0, weights=tiny_weights, coarsest_side=36)
