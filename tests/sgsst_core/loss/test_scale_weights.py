"""Tests of scale weights: the weighted loss matches its definition, and scales with weight 0 are not computed."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss, SosResult
from sgsst_core.planning.facts import check_scales
from sgsst_core.scales import EVEN, ScaleWeights
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.steps import drawn_scales
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import cameras

SIZE, COARSEST = (160, 233), 50


def evaluate(
    weights: BackboneWeights,
    values: tuple[float, ...],
    tile_size: int | None = None,
    dtype: torch.dtype = torch.float64,
) -> tuple[SosResult, list[tuple[int, int]]]:
    """Return the loss of a view at three scales, and the sizes of all images that the network processed."""
    image, content, painting = (synthetic_image(*SIZE, seed=seed).to(dtype) for seed in (1, 2, 3))
    coverage = (synthetic_image(*SIZE, seed=4)[:, :, 0] * 3 - 1).clamp(0, 1).to(dtype)
    network = FeatureNetwork(weights, dtype=dtype)
    seen, forward = [], network.forward

    def record_size(rgb: torch.Tensor, **options: Any) -> object:
        seen.append((int(rgb.shape[0]), int(rgb.shape[1])))
        return forward(rgb, **options)

    network.forward = record_size  # type: ignore[method-assign, assignment]
    loss = SosLoss(network, tile_size=tile_size, coarsest=COARSEST, scales=ScaleWeights(values))
    targets = loss.targets.of_style(Style.of(painting), SIZE)
    result = loss.evaluate(image, targets, loss.targets.of_view(content, coverage))
    assert targets.keys() == set(result.scales)
    return result, seen


@pytest.mark.parametrize(
    ("values", "tile_size"),
    [((1.0, 0.5, 2.0), 64), ((0.0, 3.0, 0.25), None), ((1.0,), 64), ((0.0, 0.0, 1e-9), None), ((1e12, 1e-12), 64)],
)
def test_float64_agrees_with_the_definition(
    tiny_weights: BackboneWeights, values: tuple[float, ...], tile_size: int | None
) -> None:
    image, content, painting = (synthetic_image(*SIZE, seed=seed) for seed in (1, 2, 3))
    painting = resize_area(painting, style_size(SIZE, SIZE))
    coverage = (synthetic_image(*SIZE, seed=4)[:, :, 0] * 3 - 1).clamp(0, 1)
    expected, gradient = sos_reference(
        tiny_weights, image, painting, content, coverage=coverage, coarsest=COARSEST, scales=values
    )
    actual, _ = evaluate(tiny_weights, values, tile_size)
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


def test_cost_of_drawn_scales_is_the_mean_over_draws() -> None:
    assert EVEN.evaluated(3) == pytest.approx(1 + 1 / 4 + 1 / 16)
    assert EVEN.evaluated(3, 2) == pytest.approx(1 / 4 + 1 / 8 + 1 / 16)
    assert ScaleWeights((1.0, 0.0, 2.0)).evaluated(3, 3) == pytest.approx(1 / 3 + 1 / 16)
    assert EVEN.sampled_cost(3, 1) == EVEN.sampled_cost(1, 5) == 1
    assert EVEN.sampled_cost(2, 4) == pytest.approx(1 / 4)
    assert EVEN.sampled_cost(3, 2) == pytest.approx((16 / 4 + 4 / 2) / 20)
    assert ScaleWeights((1.0, 0.0, 2.0)).sampled_cost(3, 3) == pytest.approx(1 / 3)


def test_scales_without_weight_are_not_computed(tiny_weights: BackboneWeights) -> None:
    result, seen = evaluate(tiny_weights, (0.0, 1.0))
    assert result.scales == (1,)
    assert all(height <= SIZE[0] // 2 and width <= SIZE[1] // 2 for height, width in seen)
    assert len(seen) == 3  # content, style and view, once each


@pytest.mark.parametrize("values", [(1.0, 1.0, 1.0), (7.0, 7.0, 7.0)])
def test_equal_weights_are_bit_identical_to_none(tiny_weights: BackboneWeights, values: tuple[float, ...]) -> None:
    actual, _ = evaluate(tiny_weights, values, dtype=torch.float32)
    expected, _ = evaluate(tiny_weights, (), dtype=torch.float32)
    assert actual.image_gradient is not None
    assert expected.image_gradient is not None
    assert torch.equal(actual.values, expected.values)
    if values[0] == 1:
        assert actual.loss == expected.loss
        assert torch.equal(actual.image_gradient, expected.image_gradient)
    else:
        torch.testing.assert_close(actual.image_gradient, expected.image_gradient)


def test_fractions_sum_to_one_and_need_a_weighted_scale() -> None:
    weights = ScaleWeights((1.0, 0.0, 3.0))
    assert weights.chosen(5) == [0, 2]
    assert EVEN.chosen(3) == [0, 1, 2]
    assert weights.fractions([0, 2]) == {0: 0.25, 2: 0.75}
    assert weights.mean({0: 4.0, 2: 8.0}) == 7
    with pytest.raises(ValueError, match="none of the scales"):
        weights.fractions([1])


@pytest.mark.parametrize("values", [(0.0, 0.0), (-1.0, 1.0), (math.nan,), (math.inf, 1.0), (1e13,), (1.0,) * 17])
def test_invalid_weights_are_refused(values: tuple[float, ...]) -> None:
    with pytest.raises(SettingsError, match="scales"):
        make_settings(scales=values)


def test_scales_beyond_those_of_the_views_are_refused() -> None:
    views = cameras(2, 128, 96)
    check_scales((1.0, 0.0, 0.5), views, 24)
    check_scales((1.0, 0.0, 0.0, 0.0), views, 96)
    check_scales((), views, 96)
    with pytest.raises(SettingsError, match="gives scale 3 a weight, but the views have 3 scales, 0 to 2"):
        check_scales((1.0, 0.0, 0.5, 1.0), views, 24)
    with pytest.raises(SettingsError, match="gives scale 1 a weight, but the views have one scale, 0"):
        check_scales((0.0, 1.0), views, 96)
    with pytest.raises(SettingsError, match="gives no weight to the 1 of 3 scales that view 'view_0' has"):
        check_scales((0.0, 1.0), [*cameras(1, 30, 20), *cameras(2, 128, 96)[1:]], 24)
