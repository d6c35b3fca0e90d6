"""Tests of scales: their weights in the loss, the scales that are drawn, and windows of rounds of views."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.planning.plan import check_scales
from sgsst_core.quality.measure import Float32Reference, Measurements
from sgsst_core.scales import ScaleWeights, Visit, has_converged, has_reached, predicted_fall, smoothed
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.stylizer import Stylizer, drawn_scales, mean_loss
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import cameras, style, wall

SIZE, COARSEST = (160, 233), 50


@pytest.mark.parametrize(
    ("values", "tile_size"),
    [((1.0, 0.5, 2.0), 64), ((0.0, 3.0, 0.25), None), ((1.0,), 64), ((0.0, 0.0, 1e-9), None), ((1e12, 1e-12), 64)],
)
def test_float64_agrees_with_the_definition(
    tiny_weights: BackboneWeights, values: tuple[float, ...], tile_size: int | None
) -> None:
    image, content, painting = (synthetic_image(*SIZE, seed=seed) for seed in (1, 2, 3))
    coverage = (synthetic_image(*SIZE, seed=4)[:, :, 0] * 3 - 1).clamp(0, 1)
    scaled = resize_area(painting, style_size(SIZE, SIZE))
    expected, gradient = sos_reference(
        tiny_weights, image, scaled, content, coverage=coverage, coarsest=COARSEST, scales=values
    )
    network = FeatureNetwork(tiny_weights, dtype=torch.float64)
    loss = SosLoss(network, tile_size=tile_size, coarsest=COARSEST, scales=ScaleWeights(values))
    targets = loss.targets.of_style(Style.of(painting), SIZE)
    actual = loss.evaluate(image, targets, loss.targets.of_view(content, coverage))
    assert targets.keys() == set(actual.scales)
    assert actual.loss == pytest.approx(expected, rel=1e-9)
    assert actual.image_gradient is not None
    assert relative_error(actual.image_gradient, gradient) < 1e-9


@pytest.mark.parametrize(("values", "period"), [((), 2), ((1.0, 0.5, 2.0), 2), ((1.0, 0.0, 2.0), 3)])
def test_mean_gradient_of_all_draws_is_that_of_the_whole_loss(
    tiny_weights: BackboneWeights, values: tuple[float, ...], period: int
) -> None:
    """Each view sees every draw equally often, so the mean over as many visits as there are draws is the mean."""
    image, content, painting = (synthetic_image(*SIZE, seed=seed) for seed in (1, 2, 3))
    expected = sos_reference(
        tiny_weights, image, resize_area(painting, style_size(SIZE, SIZE)), content, coarsest=COARSEST, scales=values
    )[1]
    weights = ScaleWeights(values)
    loss = SosLoss(FeatureNetwork(tiny_weights, dtype=torch.float64), coarsest=COARSEST, scales=weights)
    style, view = loss.targets.of_style(Style.of(painting), SIZE), loss.targets.of_view(content)
    chosen = weights.chosen(3)
    draws = period ** (len(chosen) - 1)
    mean = torch.zeros_like(image)
    for visit in range(draws):
        drawn = drawn_scales(chosen, period, 7, 2, visit)
        gradient = loss.evaluate(image, style, view, weights.sampled(chosen, drawn, period)).image_gradient
        assert gradient is not None
        mean += gradient / draws
    assert relative_error(mean, expected) < 1e-9


@pytest.mark.parametrize("values", [(0.0, 0.0), (-1.0, 1.0), (math.nan,), (math.inf, 1.0), (1e13,), (1.0,) * 17])
def test_invalid_weights_are_refused(values: tuple[float, ...]) -> None:
    with pytest.raises(SettingsError, match="scales"):
        make_settings(scales=values)


def test_scales_beyond_those_of_the_views_are_refused() -> None:
    views = cameras(2, 128, 96)
    for usable, coarsest in (((1.0, 0.0, 0.5), 24), ((1.0, 0.0, 0.0, 0.0), 96), ((), 96)):
        check_scales(usable, views, coarsest)
    for values, given, coarsest, message in (
        ((1.0, 0.0, 0.5, 1.0), views, 24, "gives scale 3 a weight, but the views have 3 scales, 0 to 2"),
        ((0.0, 1.0), views, 96, "gives scale 1 a weight, but the views have one scale, 0"),
        ((0.0, 1.0), [*cameras(1, 30, 20), views[1]], 24, "no weight to the 1 of 3 scales that view 'view_0' has"),
    ):
        with pytest.raises(SettingsError, match=message):
            check_scales(values, given, coarsest)


def test_convergence_ignores_differences_between_views() -> None:
    """The losses of three views alternate in the ratio 1 : 10 : 100."""
    views = [1.0, 10.0, 100.0]
    falling = [views[step % 3] * math.exp(-0.01 * step) for step in range(120)]
    assert not has_converged(falling, 3)
    assert has_converged([views[step % 3] for step in range(60)], 3)
    assert not has_converged([views[step % 3] for step in range(47)], 3)  # less than two windows of 24


def visits(steps: int, curve: Callable[[int], float], noise: float = 0.0) -> list[Visit]:
    """Return steps on `VIEWS` views, round by round in random order, whose losses differ by factors of up to e^5."""
    generator = torch.Generator().manual_seed(2)
    order = [view for _ in range(steps) for view in torch.randperm(VIEWS, generator=generator).tolist()][:steps]
    noises = (noise * torch.randn(steps, generator=generator).double()).exp().tolist()
    return [
        (step, view, math.exp(view) * curve(step) * random)
        for step, (view, random) in enumerate(zip(order, noises, strict=True), start=1)
    ]


def actual_fall(steps: int, curve: Callable[[int], float], factor: int) -> float:
    """Return the loss of the last round after `factor` times the steps, relative to that after the steps."""
    ends = [visits(each, curve) for each in (steps, factor * steps)]
    before, after = (smoothed([loss for _, _, loss in each], VIEWS) for each in ends)
    return after / before


VIEWS = 6


@pytest.mark.parametrize(
    ("steps", "curve", "noise", "within"),
    [
        (48, lambda step: 3 * step**-0.4, 0.0, 1e-9),
        (120, lambda step: step**-0.25, 0.0, 1e-9),
        (120, lambda step: step**-0.3, 0.2, 0.1),
        (120, lambda step: 0.2 + 1 / step, 0.0, 0.05),
        (120, lambda step: max(0.2, step**-0.5), 0.01, 0.05),
    ],
    ids=["short power law", "power law", "noise", "flattening", "plateau"],
)
def test_fall_is_predicted_from_the_curve(
    steps: int, curve: Callable[[int], float], noise: float, within: float
) -> None:
    predicted = predicted_fall(visits(steps, curve, noise), 4, VIEWS)
    assert predicted == pytest.approx(actual_fall(steps, curve, 4), rel=within)


def test_exponent_is_that_of_least_squares() -> None:
    """The reference solves for the exponent and the constants of all views at once."""
    noisy = visits(60, lambda step: step**-0.3, 0.1)
    design = torch.zeros(60, VIEWS + 1, dtype=torch.float64)
    for row, (step, view, _) in zip(design, noisy, strict=True):
        row[view], row[VIEWS] = 1.0, math.log(step)
    logs = torch.tensor([[math.log(loss)] for _, _, loss in noisy], dtype=torch.float64)
    exponent = float(torch.linalg.lstsq(design, logs).solution[VIEWS])
    longer = sum(math.log((240 - place) / (60 - place)) for place in range(VIEWS)) / VIEWS
    assert predicted_fall(noisy, 4, VIEWS) == pytest.approx(math.exp(exponent * longer), rel=1e-9)


def test_nothing_is_predicted_from_few_steps_or_noise() -> None:
    assert predicted_fall(visits(47, lambda step: step**-0.4), 4, VIEWS) is None, "less than two windows of 24"
    assert predicted_fall(visits(48, lambda step: step**-0.4, 1.0), 4, VIEWS) is None
    assert predicted_fall([(step, step, 1.0) for step in range(1, 60)], 4, 2) is None, "no view is visited twice"


def test_loss_that_does_not_fall_stays() -> None:
    assert predicted_fall(visits(60, lambda step: step**0.2), 4, VIEWS) == 1
    assert predicted_fall([(step, 0, 0.0) for step in range(1, 60)], 4, 1) == 1


def test_target_is_reached_only_after_a_whole_round() -> None:
    assert not has_reached([0.1], 0.5, 2)
    assert has_reached([0.9, 0.2], 0.5, 2)
    assert not has_reached([0.9, 0.9], 0.5, 2)


pytestmark = pytest.mark.usefixtures("one_thread")


def make(weights: BackboneWeights, steps_coarse: int = 2, **values: Any) -> Stylizer:
    settings = make_settings(
        **({"steps_coarse": steps_coarse, "steps_sos": 3, "coarsest_side": 16, "scale_sampling": 1} | values)
    )
    return Stylizer.planned(wall(), cameras(), style(), settings, weights=weights)


def line(stylizer: Stylizer, item: str) -> str:
    return next((each.decision for each in stylizer.job.plan.decisions if each.item == item), "")


def test_phase_1_uses_the_coarsest_weighted_scale(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, scales=(1.0, 0.5))
    run(stylizer)
    assert [sorted(record.terms) for record in stylizer.history] == [[1], [1], [0, 1], [0, 1], [0, 1]]
    record = stylizer.history[-1]
    assert record.loss == pytest.approx((record.terms[0].total + 0.5 * record.terms[1].total) / 1.5)
    assert line(stylizer, "weights of scales") == "scale 0 1, scale 1 0.5; others are not computed"


def test_evaluated_loss_covers_the_weighted_scales(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, scales=(1.0, 0.0, 0.5), warm_start=False)
    evaluation = stylizer.evaluate([0, 1])
    assert sorted(evaluation) == [0, 2]
    weights = stylizer.job.loss.weights
    assert mean_loss(evaluation, weights) == pytest.approx((evaluation[0].total + 0.5 * evaluation[2].total) / 1.5)
    reference = Float32Reference(stylizer).evaluate([0, 1], stylizer.job.scene.sh_dc)
    assert mean_loss(reference, weights) == pytest.approx(mean_loss(evaluation, weights), rel=1e-5)
    run(stylizer)
    stylizer.job = replace(stylizer.job, plan=replace(stylizer.job.plan, novel_views=1))
    Measurements(stylizer).at_the_end()
    assert set(map(int, stylizer.measured["novel_views"]["moments"][-1]["gram"])) == {0, 2}


def test_drawn_scales_are_the_same_after_a_resume_and_losses_cover_all(tiny_weights: BackboneWeights) -> None:
    """Each of three views shows the finer scales once in two and four visits."""
    values = {"steps_coarse": 0, "steps_sos": 12, "scale_sampling": 2, "early_stop": False}
    whole, first, second = (make(tiny_weights, **values) for _ in range(3))
    run(whole)
    for _ in range(7):
        first.run_step()
    second.load_state(first.state())
    run(second)
    assert torch.equal(second.stylized(), whole.stylized())
    assert [record.terms for record in second.history] == [record.terms for record in whole.history]
    for view in range(3):
        visits = [len(record.evaluated) for record in whole.history if record.view == view]
        assert sorted(visits) == [1, 1, 2, 3]
    known: set[int] = set()
    for record in whole.history:
        known |= set(record.evaluated)
        assert set(record.terms) == known
        assert record.loss == pytest.approx(sum(terms.total for terms in record.terms.values()) / len(known))


def test_losses_of_scales_that_were_not_drawn_follow_the_coarsest(tiny_weights: BackboneWeights) -> None:
    stylizer = make(tiny_weights, steps_coarse=0, steps_sos=9, scale_sampling=3, scales=(1.0, 1.0))
    run(stylizer)
    ratios: dict[int, float] = {}
    for record in stylizer.history:
        if 0 in record.terms:
            ratio = record.terms[0].total / record.terms[1].total
            if record.evaluated == (0, 1):
                ratios[record.view] = ratio
            assert ratio == pytest.approx(ratios.get(record.view, ratio))
    assert len(ratios) == 3
