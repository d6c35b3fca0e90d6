"""Tests of quality measurements: before and after the steps, without effect on them, and against exact gradients."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.parallel import ALONE
from sgsst_core.planning.plan import equip
from sgsst_core.quality.measure import Float32Reference, Measurements, approximations, difference
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, plan_job, prepare_job
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.stylizer import Stylizer, mean_loss
from tests.rounding import RoundedToTf32
from tests.small_scenes import ball, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")
STEPS = 8


def make(weights: BackboneWeights, measure: float = 0.75, **values: Any) -> Stylizer:
    settings = make_settings(steps_sos=STEPS, steps_coarse=0, measure=measure, precision="float32", **values)
    return Stylizer(
        plan_job(JobInputs(wall(), cameras(5), Style.of(style()), settings, weights=weights, measured=True))
    )


def measured(stylizer: Stylizer, stop: Any = None) -> list[int]:
    """Run a job, measure it at its end, and return the numbers of steps of the moments."""
    run(stylizer, Callbacks(stop=stop))
    assert stylizer.measured["novel_views"] is None, "nothing is measured between steps"
    Measurements(stylizer).at_the_end()
    novel_views: dict[str, Any] = stylizer.measured["novel_views"] or {"moments": []}
    return [moment["step"] for moment in novel_views["moments"]]


def test_start_and_end_are_measured_without_effect(tiny_weights: BackboneWeights) -> None:
    stylizer, nothing = make(tiny_weights), make(tiny_weights, measure=0.0)
    assert (measured(nothing), measured(stylizer)) == ([], [0, STEPS])
    novel_views = stylizer.measured["novel_views"]
    first, last = novel_views["moments"]
    assert len(novel_views["views"]) == stylizer.job.plan.novel_views == 1
    assert first["gram_relative"] == 1 > last["gram_relative"]
    assert all(value > 0 for value in last["gram"].values())
    assert stylizer.seconds_by_part["measuring"] > 0
    assert torch.equal(nothing.stylized(), stylizer.stylized())


def test_interrupted_job_is_measured_after_its_last_step(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights)
    assert measured(stylizer, lambda: stylizer.step == 3) == [0, 3]


@pytest.mark.parametrize("style_loss", ["nnfm", "mixed"])
def test_other_style_losses_are_measured_by_the_same_statistics(tiny_weights: BackboneWeights, style_loss: str) -> None:
    usual, other = (make(tiny_weights, style_loss=each) for each in ("sos", style_loss))
    other.run_step()
    for stylizer in (usual, other):
        Measurements(stylizer).at_the_end()
    start, same = (stylizer.measured["novel_views"]["moments"][0]["gram"] for stylizer in (other, usual))
    assert start == pytest.approx(same, rel=1e-6)
    assert all(terms["nearest"] > 0 for terms in other.history[-1].terms.values())


def prepared(weights: BackboneWeights, scene: object = None, **values: Any) -> Stylizer:
    given: dict[str, Any] = {
        "steps_coarse": 0,
        "steps_sos": 12,
        "training_background": "background",
        "warm_start": False,
        **values,
    }
    settings = make_settings(**given)
    return Stylizer.planned(scene or ball(500), cameras(2), style(), settings, weights=weights)  # type: ignore[arg-type]


def test_float32_job_agrees_with_its_reference(tiny_weights: BackboneWeights) -> None:
    stylizer = prepared(tiny_weights, wall(sh_degree=2))
    stylizer.run_step()
    reference = Float32Reference(stylizer)
    error = reference.gradient_error()
    assert approximations(stylizer) == []
    assert error.relative_error < 1e-5
    assert error.cosine == pytest.approx(1, abs=1e-6)
    expected = mean_loss(stylizer.evaluate([0, 1]))
    assert mean_loss(reference.evaluate([0, 1], stylizer.stylized())) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize(("precision", "shared"), [("float32", True), ("winograd", False)])
def test_reference_shares_the_network_of_a_float32_job(
    tiny_weights: BackboneWeights, precision: str, shared: bool
) -> None:
    stylizer = prepared(tiny_weights, precision=precision)
    network = Float32Reference(stylizer).loss.network
    assert (network is stylizer.job.network) == shared
    assert (network.precision, network.layers) == ("float32", stylizer.job.network.layers)


def test_tf32_is_measured_against_full_float32(tiny_weights: BackboneWeights) -> None:
    """The plan is constructed by hand, and TF32 is emulated, because a CPU would use float32."""
    scene, settings = ball(500), make_settings(steps_coarse=0, steps_sos=12, warm_start=False)
    context = equip(scene, cameras(2), settings, tiny_weights, ALONE)
    plan = replace(
        plan_job(JobInputs(scene, cameras(2), Style.of(style()), settings, weights=tiny_weights)).plan, precision="tf32"
    )
    rounded = RoundedToTf32(tiny_weights, context.network().layers)
    errors = []
    for shop in (None, replace(context, networks={"tf32": rounded})):
        stylizer = Stylizer(
            prepare_job(
                plan,
                JobInputs(scene, cameras(2), Style.of(style()), settings, weights=tiny_weights),
                planning_context=shop,
            )
        )
        assert approximations(stylizer) == ["TF32 convolutions"]
        errors.append(Float32Reference(stylizer).gradient_error())
    assert errors[0].relative_error < 1e-5
    assert 1e-3 < errors[1].relative_error < 0.2
    assert errors[1].cosine > 0.98


@pytest.mark.parametrize(
    ("actual", "exact", "error", "cosine"),
    [
        ([3.0, 4.0], [3.0, 4.0], 0.0, 1.0),
        ([6.0, 8.0], [3.0, 4.0], 1.0, 1.0),
        ([-4.0, 3.0], [3.0, 4.0], math.sqrt(2), 0.0),
        ([-3.0, -4.0], [3.0, 4.0], 2.0, -1.0),
        ([0.0, 0.0], [3.0, 4.0], 1.0, 0.0),
        ([1e-30, 0.0], [0.0, 0.0], 1.0, 0.0),
        ([0.0, 0.0], [0.0, 0.0], 0.0, 1.0),
        ([1e-30, 0.0], [2e-30, 0.0], 0.5, 1.0),  # squares underflow in float32
        ([1e30, 0.0], [2e30, 0.0], 0.5, 1.0),  # squares overflow
        ([math.nan, 0.0], [1.0, 0.0], math.inf, 0.0),
        ([math.inf, 0.0], [1.0, 0.0], math.inf, 0.0),
    ],
)
def test_difference_has_relative_error_and_cosine(
    actual: list[float], exact: list[float], error: float, cosine: float
) -> None:
    expected = pytest.approx(error), pytest.approx(cosine, abs=1e-12)
    assert difference(torch.tensor(actual), torch.tensor(exact)) == expected
