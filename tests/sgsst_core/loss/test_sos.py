"""Tests of the SOS loss of a view, also with regions, against float64."""

from dataclasses import replace

import pytest
import torch

from benchmarks.stability.sos_reference import StyledWeights, sos_reference
from sgsst_core.errors import SettingsError
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import combined, layers_of
from sgsst_core.regions import Region, Regions, check_regions
from sgsst_core.scales import scale_count
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.style import Style
from tests.networks import comparing_pixels
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image

#: Tolerances of gradients: float64 against the reference; float32 tiled against float32 untiled.
FLOAT64_TOLERANCE = 1e-9
FLOAT32_TOLERANCE = 1e-5


def setting(size, *, covered=False):
    """Return float64 image, style, content and coverage (None unless `covered`) for a view of this size."""
    image, content = synthetic_image(*size, seed=1), synthetic_image(*size, seed=2)
    style = resize_area(synthetic_image(600, 500, seed=3) ** 2, style_size((600, 500), size))
    coverage = None
    if covered:
        coverage = (synthetic_image(*size, seed=4)[:, :, 0] * 3 - 1).clamp(0, 1)
        coverage[: size[0] // 3] = 0
    return image, style, content, coverage


def evaluate(network, case, tile_size, **options):
    image, style, content, coverage = (None if t is None else t.to(network.dtype) for t in case)
    loss = SosLoss(network, tile_size=tile_size, **options)
    targets = loss.targets.of_style(Style.of(style), image.shape[:2])
    return loss.evaluate(image, targets, loss.targets.of_view(content, coverage))


@pytest.mark.parametrize(
    ("size", "tile_sizes", "covered"),
    [
        ((160, 233), [None, 64], False),
        ((129, 250), [64, 160], True),
    ],
)
def test_float64_agrees_with_untiled_autograd(tiny_weights, size, tile_sizes, covered):
    check_against_untiled_autograd(tiny_weights, size, tile_sizes, covered, 100)


@pytest.mark.parametrize(("gray", "covered"), [(False, True), (True, False)])
def test_compared_pixels_agree_with_untiled_autograd(tiny_weights, covered, gray):
    weights = replace(comparing_pixels(tiny_weights), gray=gray)
    check_against_untiled_autograd(weights, (129, 190), [None, 64], covered, 100)


def test_real_network_agrees_with_untiled_autograd(vgg16_weights):
    check_against_untiled_autograd(vgg16_weights, (64, 99), [48], True, 32)


def check_against_untiled_autograd(weights, size, tile_sizes, covered, coarsest):
    case = setting(size, covered=covered)
    image, style, content, coverage = case
    expected, expected_gradient = sos_reference(weights, image, style, content, coverage=coverage, coarsest=coarsest)
    network = FeatureNetwork(weights, layers_of("sos", weights, content=True), torch.float64)
    for tile_size in tile_sizes:
        result = evaluate(network, case, tile_size, coarsest=coarsest)
        assert len(result.terms) == scale_count(*size, coarsest)
        assert result.loss == pytest.approx(expected, rel=FLOAT64_TOLERANCE)
        assert relative_error(result.image_gradient, expected_gradient) < FLOAT64_TOLERANCE


@pytest.mark.parametrize(
    ("size", "tile_sizes", "covered"),
    [
        ((160, 233), [64], False),
        ((333, 517), [128], True),
        ((256, 1031), [512], False),
    ],
)
def test_float32_does_not_depend_on_the_partition(tiny_weights, size, tile_sizes, covered):
    weights = comparing_pixels(tiny_weights)
    network = FeatureNetwork(weights, layers_of("sos", weights, content=True))
    case = setting(size, covered=covered)
    whole = evaluate(network, case, None, memory=1 << 34)
    for tile_size in tile_sizes:
        tiled = evaluate(network, case, tile_size)
        assert tiled.loss == pytest.approx(whole.loss, rel=1e-5)
        assert relative_error(tiled.image_gradient, whole.image_gradient) < FLOAT32_TOLERANCE


@pytest.mark.parametrize("size", [(1, 1), (15, 17), (16, 16), (3, 200)])
def test_tiny_views_have_finite_gradients(tiny_weights, size):
    case = (synthetic_image(*size, seed=1), synthetic_image(40, 30, seed=2), synthetic_image(*size, seed=3), None)
    result = evaluate(FeatureNetwork(tiny_weights), case, None)
    assert torch.isfinite(result.image_gradient).all()
    assert result.image_gradient.abs().max() > 0


def test_pixels_far_from_covered_cells_have_zero_gradient(tiny_weights):
    """Pixels beyond the receptive field of every covered cell have zero gradient."""
    size = (400, 300)
    coverage = torch.zeros(size)
    coverage[:64] = 1
    image, style, content, _ = (None if t is None else t.float() for t in setting(size))
    loss = SosLoss(FeatureNetwork(tiny_weights))
    result = loss.evaluate(image, loss.targets.of_style(Style.of(style), size), loss.targets.of_view(content, coverage))
    assert result.image_gradient[:64].abs().max() > 0
    assert result.image_gradient[64 + 16 + 64 :].abs().max() == 0


SIZE = (112, 150)


def coverage_maps(size, count):
    """Return coverage maps of `count` regions, which add up to 1 with the background; the first have hard borders."""
    raw = torch.stack([synthetic_image(*size, seed=10 + number)[:, :, 0] ** 4 for number in range(count + 1)])
    raw[0, :, size[1] // 2 :] = 0
    raw[1, : size[0] // 2] = 0
    return list((raw / raw.sum(dim=0))[:count])


def targets_of(loss, styles, weights):
    return combined([loss.targets.of_style(Style.of(style), SIZE) for style in styles], weights)


def evaluate_regions(network, image, content, styles, maps, weights, **options):
    dtype = network.dtype
    loss = SosLoss(network, coarsest=60, **options)
    view = loss.targets.of_view(content.to(dtype))
    view.regions = [loss.targets.position_weights(share) for share in maps]
    return loss.evaluate(image.to(dtype), targets_of(loss, [s.to(dtype) for s in styles], weights), view)


@pytest.fixture
def case():
    styles = [resize_area(synthetic_image(90, 130, seed=s) ** s, style_size((90, 130), SIZE)) for s in (1, 2, 3)]
    return (
        synthetic_image(*SIZE, seed=5),
        synthetic_image(*SIZE, seed=6),
        styles,
        coverage_maps(SIZE, 3),
        [1.0, 0.3, 7.0],
    )


@pytest.mark.parametrize(
    ("tile_size", "style_loss", "pixels"), [(64, "sos", False), (None, "sos", True), (64, "mixed", False)]
)
def test_float64_agrees_with_autograd(tiny_weights, case, tile_size, style_loss, pixels):
    tiny_weights = comparing_pixels(tiny_weights) if pixels else tiny_weights
    image, content, styles, maps, weights = case
    parts = [StyledWeights(*part) for part in zip(styles, maps, weights, strict=True)]
    expected, gradient = sos_reference(tiny_weights, image, parts, content, coarsest=60, style_loss=style_loss)
    layers = layers_of(style_loss, tiny_weights, content=True)
    network = FeatureNetwork(tiny_weights, layers, torch.float64)
    actual = evaluate_regions(network, *case, tile_size=tile_size, style_loss=style_loss)
    assert actual.loss == pytest.approx(expected, rel=1e-9)
    assert relative_error(actual.image_gradient, gradient) < 1e-9


def test_float32_tiles_agree_with_untiled_float64(tiny_weights, case):
    whole = evaluate_regions(FeatureNetwork(tiny_weights, dtype=torch.float64), *case)
    tiled = evaluate_regions(FeatureNetwork(tiny_weights), *case, tile_size=64, memory=1)
    assert tiled.loss == pytest.approx(whole.loss, rel=1e-5)
    assert relative_error(tiled.image_gradient, whole.image_gradient) < 1e-5


# --- resolved regions ----------------------------------------------------------------------------------------------


def regions(labels, **frozen):
    names = ("rest", "a", "b")
    every = tuple(Region(name, freeze=frozen.get(name, False)) for name in names)
    return Regions(every, torch.tensor(labels, dtype=torch.uint8))


def test_regions_outside_all_views_join_the_rest():
    resolved = regions([0, 1, 2, 2]).resolved(torch.tensor([1.0, 0, 0, 2]))
    assert (resolved.labels.tolist(), resolved.active) == ([0, 0, 2, 2], (0, 2))
    assert resolved.mapped


def test_frozen_regions_outside_all_views_stay_frozen():
    resolved = regions([0, 1, 2, 2], a=True).resolved(torch.tensor([1.0, 0, 1, 2]))
    assert resolved.frozen.tolist() == [False, True, False, False]
    assert not resolved.frozen_in_view


def test_region_of_all_seen_gaussians_needs_no_map():
    resolved = regions([0, 1, 1]).resolved(torch.tensor([0.0, 1, 1]))
    assert resolved.active == (1,)
    assert not resolved.mapped


def test_freezing_everything_is_an_error():
    all_frozen = regions([1, 1, 2], a=True, b=True)
    with pytest.raises(SettingsError, match=r"Every Gaussian is frozen \(a, b\)"):
        check_regions(all_frozen)
    partly = regions([0, 1, 2], a=True, b=True)
    check_regions(partly)
    with pytest.raises(SettingsError, match=r"--sh-attenuation 0\.5 changes the Gaussians of every region"):
        check_regions(partly, 0.5)
    with pytest.raises(SettingsError, match="that a view sees is frozen"):
        partly.resolved(torch.tensor([0.0, 1, 1]))
