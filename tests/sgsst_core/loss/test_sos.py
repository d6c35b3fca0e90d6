"""Tests of the SOS loss of a view, also with regions, and of its terms and scales, against float64."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from benchmarks.stability.sos_reference import StyledWeights, applied, sos_reference, style_loss_reference
from sgsst_core.errors import ImageError, SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.statistics import layer_statistics
from sgsst_core.features.vgg import (
    CONTENT_LAYER,
    EVEN_COLOR_SCALE,
    EVEN_PIXEL_SCALE,
    EVEN_SCALE,
    PIXELS,
    PUBLISHED,
    STYLE_LAYERS,
    FeatureNetwork,
    at_scale,
    paper_scales,
    with_scales,
)
from sgsst_core.loss import terms as nearest
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import (
    MAX_VECTORS,
    LayerTarget,
    Matches,
    StyleVectors,
    TermWeights,
    combined,
    content_factor,
    content_gradient,
    content_loss,
    layers_of,
    search,
    style_loss,
)
from sgsst_core.regions import Region, Regions, check_regions
from sgsst_core.scales import ScaleWeights, scale_count
from sgsst_core.scene.colors import resize_area, style_size
from sgsst_core.settings import StyleLossName
from sgsst_core.style import STARRY_NIGHT, Style, chosen_positions
from tests.networks import comparing_pixels
from tests.networks import tiny_weights as make_tiny_weights
from tests.sgsst_core.synthetic_images import nearly_one_color, relative_error, synthetic_image

#: Tolerances of gradients: float64 against the reference; float32 tiled against float32 untiled.
FLOAT64_TOLERANCE = 1e-9
FLOAT32_TOLERANCE = 1e-5


def setting(size, *, covered=False, style=None):
    """Return float64 image, style, content and coverage (None unless `covered`) for a view of this size."""
    image, content = synthetic_image(*size, seed=1), synthetic_image(*size, seed=2)
    if style is None:
        style = resize_area(synthetic_image(600, 500, seed=3) ** 2, style_size((600, 500), size))
    coverage = None
    if covered:
        coverage = (synthetic_image(*size, seed=4)[:, :, 0] * 3 - 1).clamp(0, 1)
        coverage[: size[0] // 3] = 0
    return image, style, content, coverage


def evaluate(network, case, tile_size, **options):
    return evaluate_loss(SosLoss(network, tile_size=tile_size, **options), case)


def evaluate_loss(loss, case):
    image, style, content, coverage = (None if part is None else part.to(loss.network.dtype) for part in case)
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


def evaluate_regions(network, image, content, styles, maps, weights, **options):
    dtype = network.dtype
    loss = SosLoss(network, coarsest=60, **options)
    view = loss.targets.of_view(content.to(dtype))
    view.regions = [loss.targets.position_weights(share) for share in maps]
    targets = combined([loss.targets.of_style(Style.of(style.to(dtype)), SIZE) for style in styles], weights)
    return loss.evaluate(image.to(dtype), targets, view)


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


def make_features(height, width, channels, seed, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn((height, width, channels), generator=generator, dtype=torch.float64)
    return (x @ torch.randn((channels, channels), generator=generator, dtype=torch.float64)).relu().to(dtype)


def autograd_style(x, target, weights):
    """Return the style loss by its definition, and its gradient by autograd."""
    x = x.double().clone().requires_grad_()
    loss = style_loss_reference(x, target, weights)
    return loss.item(), torch.autograd.grad(loss, x)[0]


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_style_gradient_agrees_with_autograd(weighted, dtype, tolerance):
    x = make_features(17, 23, 12, 1, dtype)
    a = torch.rand((17, 23), dtype=torch.float64) if weighted else None
    target = LayerTarget.of(layer_statistics(make_features(30, 20, 12, 2)))
    expected, expected_gradient = autograd_style(x, target, a)
    terms, gradient = style_loss(layer_statistics(x, a), target, feature_eps=torch.finfo(dtype).eps)
    assert float(terms.sum()) == pytest.approx(expected, rel=tolerance)
    assert relative_error(applied(gradient, x, a), expected_gradient) < tolerance


def test_map_about_the_rounded_mean_is_equivalent():
    """It matters if features differ by less than the rounding error of their mean, as in pixels of nearly one color."""
    x, target = nearly_one_color(), LayerTarget.of(layer_statistics(make_features(30, 20, 3, 2)))
    _, gradient = style_loss(layer_statistics(x), target, weights=TermWeights(gram=0.0))
    exact = applied(gradient, x.double())
    assert relative_error(applied(gradient.about_rounded_mean(), x), exact) < 1e-5
    assert relative_error(applied(gradient, x), exact) > 1e-3


@pytest.mark.parametrize("weighted", [False, True])
def test_content_gradient_agrees_with_autograd(weighted):
    x, content = make_features(9, 11, 6, 1).requires_grad_(), make_features(9, 11, 6, 2)
    a = torch.rand((9, 11), dtype=torch.float64) if weighted else torch.ones((9, 11), dtype=torch.float64)
    expected = 0.7 * (a[:, :, None] * (x - content) ** 2).sum() / (a.sum() * 6)
    case = x.detach(), content, a if weighted else None, content_factor(a.sum(), x.shape[-1], 0.7)
    assert float(content_loss(*case)) == pytest.approx(expected.item(), rel=1e-12)
    torch.testing.assert_close(content_gradient(*case), torch.autograd.grad(expected, x)[0], rtol=1e-12, atol=0)


def test_loss_and_gradient_are_zero_without_positions():
    x = make_features(17, 23, 12, 1, torch.float32)
    nowhere = torch.zeros((17, 23))
    terms, gradient = style_loss(layer_statistics(x, nowhere), LayerTarget.of(layer_statistics(x)))
    case = x, 2 * x, nowhere, content_factor(nowhere.sum(dtype=torch.float64), x.shape[-1], 0.7)
    assert not terms.any()
    assert not applied(gradient, x, torch.ones((17, 23))).any()
    assert float(content_loss(*case)) == 0.0
    assert not content_gradient(*case).any()


EPS = torch.finfo(torch.float64).eps
MATCHED: tuple[StyleLossName, ...] = ("nnfm", "mixed")
MATCHED_STYLE = synthetic_image(90, 110, seed=3) ** 2


def loss_of(
    weights: BackboneWeights, style_loss: StyleLossName, dtype: torch.dtype = torch.float64, **options: object
) -> SosLoss:
    network = FeatureNetwork(weights, layers_of(style_loss, weights, content=True), dtype)
    return SosLoss(network, style_loss=style_loss, **options)  # type: ignore[arg-type]


def features(positions: tuple[int, int], channels: tuple[int, ...], seed: int) -> dict[str, Tensor]:
    """Return nonnegative float64 features by layer, like a ReLU's output, without zero vectors."""
    generator = torch.Generator().manual_seed(seed)
    return {
        f"relu3_{place}": torch.randn((*positions, count), generator=generator, dtype=torch.float64).relu() + 0.01
        for place, count in enumerate(channels, start=1)
    }


def vectors_of(parts: dict[str, Tensor]) -> StyleVectors:
    return StyleVectors.of({layer: part.flatten(0, 1) for layer, part in parts.items()})


@pytest.mark.parametrize(
    ("network", "style_loss", "tile_size", "covered"),
    [
        ("vgg16", MATCHED[0], None, False),
        ("vgg19", MATCHED[0], 64, True),
        ("vgg16", MATCHED[1], 48, False),
        ("vgg19", MATCHED[1], None, True),
    ],
)
def test_any_partition_agrees_with_untiled_autograd(
    network: str, style_loss: StyleLossName, tile_size: int | None, covered: bool
) -> None:
    weights = make_tiny_weights(network)  # type: ignore[arg-type]
    image, style, content, coverage = case = setting((101, 150), covered=covered, style=MATCHED_STYLE)
    expected, gradient = sos_reference(
        weights, image, style, content, coverage=coverage, style_loss=style_loss, coarsest=60
    )
    result = evaluate_loss(loss_of(weights, style_loss, tile_size=tile_size, coarsest=60), case)
    assert (result.scales, result.loss) == ((0, 1), pytest.approx(expected, rel=1e-9))
    assert relative_error(result.image_gradient, gradient) < 1e-9
    assert all(terms["nearest"] > 0 for terms in result.terms.values())
    assert all((terms["gram"] > 0) == (style_loss == "mixed") for terms in result.terms.values())


def test_lower_precisions_agree_with_float64(vgg16_weights: BackboneWeights) -> None:
    case = setting((84, 100), style=MATCHED_STYLE)
    exact, *lower = (
        evaluate_loss(loss_of(vgg16_weights, "nnfm", dtype), case)
        for dtype in (torch.float64, torch.float32, torch.bfloat16)
    )
    for actual, loss, gradient in zip(lower, (1e-5, 1e-2), (1e-2, 0.5), strict=True):
        assert actual.loss == pytest.approx(exact.loss, rel=loss)
        assert relative_error(actual.image_gradient, exact.image_gradient) < gradient


def test_first_of_equally_near_vectors_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(nearest._BLOCK, "cpu", (2, 2))
    units = torch.eye(3)
    style = units[[2, 1, 1, 0, 2, 0, 0]]
    values, places = search(units, style)
    assert values.tolist() == [1, 1, 1]
    assert places.tolist() == [3, 1, 0]


def test_zero_vectors_match_nothing() -> None:
    """Zero vectors, and vectors of rounding size, count as far from everything and get no gradient."""
    own, style = features((3, 4), (6, 4), 1), features((2, 2), (6, 4), 2)
    for part in own.values():
        part[0] = 0
        part[1] *= 1e-17
    vectors = vectors_of(style)
    matches = Matches.of(own, vectors, EPS)
    away = 1 - matches.cosine
    assert torch.equal(away[:2], torch.ones_like(away[:2]))
    assert (away[2] < 0.9).all()
    gradient = torch.zeros_like(own["relu3_1"])
    matches.add_gradient(gradient, own["relu3_1"], "relu3_1", vectors, torch.tensor(1.0))
    assert gradient[:2].abs().max() == 0
    assert torch.isfinite(gradient).all()
    assert gradient[2].abs().max() > 0


def test_nan_features_give_nan_gradients() -> None:
    """NaN reaches the gradient, which stops a run that diverges."""
    own, style = features((3, 4), (6,), 1), features((2, 2), (6,), 2)
    own["relu3_1"][1, 2, 3] = torch.nan
    vectors = vectors_of(style)
    gradient = torch.zeros_like(own["relu3_1"])
    Matches.of(own, vectors, EPS).add_gradient(gradient, own["relu3_1"], "relu3_1", vectors, torch.tensor(1.0))
    assert gradient[1, 2].isnan().all()
    assert torch.isfinite(gradient[0]).all()


@pytest.mark.parametrize("style_loss", MATCHED)
def test_uncovered_positions_are_ignored(tiny_weights: BackboneWeights, style_loss: StyleLossName) -> None:
    image, style, content, _ = setting((96, 64), style=MATCHED_STYLE)
    coverage = torch.zeros((96, 64), dtype=torch.float64)
    loss = loss_of(tiny_weights, style_loss)
    nothing = evaluate_loss(loss, (image, style, content, coverage))
    assert (nothing.loss, nothing.image_gradient.abs().max()) == (0, 0)
    coverage[:32] = 1
    other = image.clone()
    other[80:] = 0  # outside the receptive field of covered cells
    lean = loss_of(tiny_weights, "nnfm")
    results = [evaluate_loss(lean, (each, style, content, coverage)) for each in (image, other)]
    assert results[0].terms[0]["nearest"] == results[1].terms[0]["nearest"] > 0


def test_style_without_vectors_is_refused(tiny_weights: BackboneWeights) -> None:
    with pytest.raises(ImageError, match="The style is used at 200 x 3 pixels, too few to match"):
        loss_of(tiny_weights, "nnfm").targets.of_style(Style.of(synthetic_image(3, 200)), (100, 80))
    without_full_size = loss_of(tiny_weights, "nnfm", coarsest=40, scales=ScaleWeights((0.0, 1.0)))
    with pytest.raises(ImageError, match="The style is used at 100 x 2 pixels, too few to match"):
        without_full_size.targets.of_style(Style.of(synthetic_image(4, 200)), (100, 80))


def test_large_styles_are_thinned_evenly() -> None:
    assert chosen_positions(MAX_VECTORS, MAX_VECTORS).tolist() == list(range(MAX_VECTORS))
    places = chosen_positions(1000 * 700, 5000)
    assert len(places) == 5000
    assert (places.diff() >= 0).all()
    assert 0 <= int(places[0]) <= int(places[-1]) < 700_000
    for count, most in ((places // 700, 1000), (places % 700, 700)):  # rows and columns are both uniform
        assert torch.histc(count.double(), 10, 0, most).sub(500).abs().max() < 25
    # With fewer than two positions per sample, all are in range and few repeat.
    assert len(chosen_positions(6001, 6000).unique()) > 4000


LAYERS = (*STYLE_LAYERS, CONTENT_LAYER)


@pytest.fixture
def renormalized(tiny_weights: BackboneWeights) -> BackboneWeights:
    """Return a network with another input normalization than the original network."""
    return replace(tiny_weights, input_scale=torch.tensor([250.0, 255.0, 260.0]))


def all_features(weights: BackboneWeights, image: torch.Tensor) -> dict[str, torch.Tensor]:
    network = FeatureNetwork(weights, LAYERS, torch.float64)
    return network.forward(image.double(), cache=False).features


def test_features_of_each_layer_are_scaled_by_its_factor(tiny_weights: BackboneWeights) -> None:
    scales = dict(zip(LAYERS, (1.3, 0.25, 7.0, 3.0, 1e-3, 40.0), strict=True))
    image = torch.rand(48, 64, 3, generator=torch.Generator().manual_seed(0))
    before, after = all_features(tiny_weights, image), all_features(with_scales(tiny_weights, scales), image)
    for layer in LAYERS:
        wanted = before[layer] * scales[layer]
        torch.testing.assert_close(after[layer], wanted, rtol=0, atol=1e-5 * float(wanted.amax()))
    assert float(before["relu5_1"].amax()) > 0


def test_paper_scales_give_the_published_statistics(renormalized: BackboneWeights) -> None:
    """Statistics agree to 22 %, because the factors have two digits."""
    with Image.open(STARRY_NIGHT) as painting:
        small = painting.resize((512, 405), Image.Resampling.LANCZOS)
    image = torch.from_numpy(np.array(small)).double() / 255
    nothing = (torch.tensor([123.68, 116.779, 103.939]) / 255).expand(image.shape)
    scaled = at_scale(renormalized, "paper")
    own_features, of_nothing = all_features(scaled, image), all_features(scaled, nothing)
    for layer in STYLE_LAYERS:
        grams = [values[layer].flatten(0, 1).T @ values[layer].flatten(0, 1) for values in (own_features, of_nothing)]
        statistic = ((grams[0] - grams[1]) / own_features[layer].numel()).square().mean()
        assert float(statistic) == pytest.approx(PUBLISHED[layer], rel=0.25)
    difference = (own_features[CONTENT_LAYER] - of_nothing[CONTENT_LAYER]).square().mean()
    assert float(difference) == pytest.approx(PUBLISHED[CONTENT_LAYER], rel=0.12)


@pytest.mark.slow
def test_torchvision_vgg16_has_the_expected_scales(vgg16_weights: BackboneWeights) -> None:
    wanted = {"relu1_1": 1.2, "relu2_1": 1.5, "relu3_1": 0.91, "relu4_1": 4.9, "relu4_2": 4.4, "relu5_1": 0.75}
    assert paper_scales(vgg16_weights) == pytest.approx(wanted, rel=0.02)


def test_even_scales_differ_only_in_the_color_layers(renormalized: BackboneWeights) -> None:
    scaled = at_scale(renormalized, "even")
    assert (scaled.scales["relu1_1"], scaled.scales[PIXELS]) == (EVEN_COLOR_SCALE, EVEN_PIXEL_SCALE)
    assert {factor for layer, factor in scaled.scales.items() if layer not in ("relu1_1", PIXELS)} == {EVEN_SCALE}
    image = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(1))
    before, after = all_features(renormalized, image), all_features(scaled, image)
    for layer in LAYERS:  # exact, because factors are powers of two
        torch.testing.assert_close(after[layer], before[layer] * scaled.scales[layer], rtol=0, atol=0)


def test_papers_network_is_returned_unchanged(tiny_weights: BackboneWeights) -> None:
    assert at_scale(tiny_weights, "paper") is tiny_weights
    assert at_scale(tiny_weights, "even") is tiny_weights
