"""Tests of the benchmarks that compare variants with equal time budgets, by one loss and by the judge."""

import json
from pathlib import Path

import pytest

from api.cli.scene_tools import point_line
from sgsst_core.bench.variants import (
    TRANSFER,
    UNSTYLIZED,
    VARIANTS,
    Curve,
    Point,
    Quality,
    as_dict,
    choose_variants,
    compare_quality,
    pareto_front,
    write_plot,
)
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.quality.judge import Lpips
from sgsst_core.quality.measure import make_novel_views
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.small_scenes import cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def test_pareto_front_contains_undominated_points() -> None:
    def curve(name: str, *points: tuple[float, float]) -> Curve:
        return Curve(VARIANTS[name], [Point(seconds, 1, loss, {0: loss}) for seconds, loss in points])

    curves = [curve("standard", (1, 0.9), (2, 0.5), (4, 0.3)), curve("two-views", (1, 0.8), (2, 0.6), (3, 0.4))]
    front = [(name, point.seconds) for name, point, _ in pareto_front(curves)]
    assert front == [("two-views", 1), ("standard", 2), ("two-views", 3), ("standard", 4)]


def test_initial_loss_of_zero_has_no_ratio(tmp_path: Path) -> None:
    curves = [Curve(VARIANTS["standard"], [Point(seconds, 1, None, {0: None}) for seconds in (1, 2)])]
    assert as_dict(curves)["pareto_front"] == []
    assert point_line(curves[0]) == "standard: the initial loss was 0, after 2.0 s, 1 steps"
    write_plot(tmp_path / "plot.png", curves, "black")


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
    assert values["lpips"] == "alex"
    assert values["outcomes"][2]["consistency"]["short"]["rmse"] > 0
    assert values["error_time"]["variants"]["standard"]["points"][-1]["relative"] == variants[0].loss


def test_consistency_is_that_of_the_novel_views(quality: Quality, tiny_weights: BackboneWeights) -> None:
    settings = make_settings(coarsest_side=36)
    stylizer = Stylizer.planned(wall(), cameras(3, 96, 72), style(), settings, weights=tiny_weights)
    before, _, *variants = quality.outcomes
    novel_views = make_novel_views(stylizer, lpips=Lpips())
    for outcome in (before, *variants):
        assert outcome.short == novel_views.measure(outcome.sh_dc).short


def test_too_few_cameras_are_refused(tiny_weights: BackboneWeights, vgg16_weights: object) -> None:
    with pytest.raises(SettingsError, match="more cameras"):
        compare_quality(wall(), cameras(1, 96, 72), style(), [], 1.0, weights=tiny_weights, coarsest_side=36)
