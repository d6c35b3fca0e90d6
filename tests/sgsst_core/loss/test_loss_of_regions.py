"""Tests of the loss of several regions with different styles."""

import pytest
import torch

from benchmarks.stability.sos_reference import StyledWeights, sos_reference
from sgsst_core.errors import SettingsError
from sgsst_core.features.statistics import layer_statistics, merge
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import combined, layers_of
from sgsst_core.regions import Region, Regions, check_regions
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.style import Style
from tests.networks import comparing_pixels
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image

SIZE = (112, 150)


def coverage_maps(size, count):
    """Return coverage maps of `count` regions, which add up to 1 with the background; the first have hard borders."""
    raw = torch.stack([synthetic_image(*size, seed=10 + number)[:, :, 0] ** 4 for number in range(count + 1)])
    raw[0, :, size[1] // 2 :] = 0
    raw[1, : size[0] // 2] = 0
    return list((raw / raw.sum(dim=0))[:count])


def targets_of(loss, styles, weights):
    return combined([loss.targets.of_style(Style.of(style), SIZE) for style in styles], weights)


def evaluate(network, image, content, styles, maps, weights, **options):
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
    actual = evaluate(network, *case, tile_size=tile_size, style_loss=style_loss)
    assert actual.loss == pytest.approx(expected, rel=1e-9)
    assert relative_error(actual.image_gradient, gradient) < 1e-9


def test_float32_tiles_agree_with_untiled_float64(tiny_weights, case):
    whole = evaluate(FeatureNetwork(tiny_weights, dtype=torch.float64), *case)
    tiled = evaluate(FeatureNetwork(tiny_weights), *case, tile_size=64, memory=1)
    assert tiled.loss == pytest.approx(whole.loss, rel=1e-5)
    assert relative_error(tiled.image_gradient, whole.image_gradient) < 1e-5


def test_order_of_regions_does_not_matter(tiny_weights, case):
    image, content, *parts = case
    network = FeatureNetwork(tiny_weights, dtype=torch.float64)
    results = [
        evaluate(network, image, content, *([part[i] for i in order] for part in parts))
        for order in ([0, 1, 2], [2, 0, 1])
    ]
    assert results[1].loss == pytest.approx(results[0].loss, rel=1e-13)
    assert relative_error(results[1].image_gradient, results[0].image_gradient) < 1e-12


def test_single_region_is_bit_identical_to_no_regions(tiny_weights, case):
    """Results are bit-identical: same statistics, same position weights."""
    image, content, styles, maps, _ = case
    network = FeatureNetwork(tiny_weights)
    loss = SosLoss(network, coarsest=60)
    content = content.float()
    plain = loss.evaluate(
        image.float(), loss.targets.of_style(Style.of(styles[0]), SIZE), loss.targets.of_view(content, maps[2])
    )
    view = loss.targets.of_view(content, maps[2])
    view.regions = [loss.targets.position_weights(maps[2])]
    result = loss.evaluate(image.float(), targets_of(loss, styles[:1], [1.0]), view)
    assert torch.equal(result.values, plain.values)
    assert torch.equal(result.image_gradient, plain.image_gradient)


def test_region_outside_the_view_adds_nothing(tiny_weights, case):
    image, content, styles, maps, weights = case
    network = FeatureNetwork(tiny_weights, dtype=torch.float64)
    without = evaluate(network, image, content, styles[:2], maps[:2], weights[:2])
    blind = [*maps[:2], torch.zeros(SIZE)]
    result = evaluate(network, image, content, styles, blind, weights)
    assert torch.equal(result.values, without.values)
    assert torch.equal(result.image_gradient, without.image_gradient)


def test_weights_scale_only_the_style_terms(tiny_weights, case):
    image, content, styles, maps, _ = case
    network = FeatureNetwork(tiny_weights, dtype=torch.float64)
    one, two = (evaluate(network, image, content, styles, maps, [w] * 3) for w in (1.0, 2.0))
    for scale, terms in one.terms.items():
        for name, value in terms.items():
            assert two.terms[scale][name] == pytest.approx(value if name == "content" else 2 * value, rel=1e-12)


def test_statistics_of_united_regions_are_merged():
    """The union's map is the sum of both, and its moments are theirs, merged."""
    features = torch.rand(9, 13, 16, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    first, second = coverage_maps((9, 13), 2)
    whole = layer_statistics(features, first + second)
    parts = merge(layer_statistics(features, first), layer_statistics(features, second))
    for name in ("count", "mean", "centered"):
        torch.testing.assert_close(getattr(parts, name), getattr(whole, name), rtol=1e-12, atol=1e-13)


# --- resolved regions ----------------------------------------------------------------------------------------------


def regions(labels, **frozen):
    names = ("rest", "a", "b")
    every = tuple(Region(name, freeze=frozen.get(name, False)) for name in names)
    return Regions(every, torch.tensor(labels, dtype=torch.uint8))


def test_regions_outside_all_views_join_the_rest():
    resolved = regions([0, 1, 2, 2]).resolved(torch.tensor([1.0, 0, 0, 2]))
    assert resolved.labels.tolist() == [0, 0, 2, 2]
    assert resolved.active == (0, 2)
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
