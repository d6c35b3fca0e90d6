"""Tests of the SOS gradient with various partitions into tiles, against the untiled autograd reference."""

from dataclasses import replace

import pytest
import torch

from benchmarks.stability.sos_reference import sos_reference
from sgsst_core.features.vgg import CONTENT_LAYER, PIXELS, STYLE_LAYERS, Activations, FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import StyleTarget, layers_of
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


def test_compared_pixels_are_the_first_layer_without_gram_matrix(tiny_weights):
    """The pixel loss compares means and standard deviations of values from 0 to 256, times the squared factor."""
    weights = comparing_pixels(tiny_weights, 3.0)
    network = FeatureNetwork(weights, (PIXELS, "relu1_1"))
    loss = SosLoss(network, content_weight=0)
    image, style = synthetic_image(40, 56, seed=1).float(), synthetic_image(40, 56, seed=3).float()
    only = {
        scale: (StyleTarget({PIXELS: own[0].layers[PIXELS]}),)
        for scale, own in loss.targets.of_style(Style.of(style), (40, 56)).items()
    }
    result = loss.evaluate(image, only, loss.targets.of_view(image))
    values = [(256 * part.double()).flatten(0, 1) for part in (image, style)]
    means, deviations = (
        [own(part) for part in values] for own in (lambda x: x.mean(0), lambda x: x.std(0, correction=0))
    )
    assert result.terms[0]["gram"] == 0
    assert result.terms[0]["mean"] == pytest.approx(9e4 * float((means[0] - means[1]).square().mean()), rel=1e-5)
    assert result.terms[0]["std"] == pytest.approx(
        9e4 * float((deviations[0] - deviations[1]).square().mean()), rel=1e-5
    )
    matched = loss.evaluate(style, only, loss.targets.of_view(style))
    assert matched.loss < 1e-9 * result.loss


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


class DecisionsOf(FeatureNetwork):
    """Float64 network whose backward pass uses the ReLU masks and max pooling positions of a float32 network."""

    def __init__(self, weights, other: FeatureNetwork):
        super().__init__(weights, dtype=torch.float64)
        self.other = other
        self.flips = 0
        self.decisions = 0

    def forward(self, rgb, *, cache=True, until=None) -> Activations:
        own = super().forward(rgb, cache=cache, until=until)
        theirs = self.other.forward(rgb.float(), cache=cache, until=until)
        for mine, other in zip(own.decisions(), theirs.decisions(), strict=True):
            self.flips += int((mine != other).sum())
            self.decisions += mine.numel()
        own.outputs = [output.double() for output in theirs.outputs]
        return own


def test_float32_differs_from_float64_mostly_by_flips(vgg16_weights):
    case = setting((80, 112))
    image, style, content, _ = case
    _, exact = sos_reference(vgg16_weights, image, style, content)
    network = FeatureNetwork(vgg16_weights)
    actual = evaluate(network, case, None).image_gradient
    same_decisions = DecisionsOf(vgg16_weights, network)
    expected = evaluate(same_decisions, case, None).image_gradient
    with_flips, without = relative_error(actual, exact), relative_error(actual, expected)
    flipped = same_decisions.flips / same_decisions.decisions
    print(f"float32 against float64: {with_flips:.1e}, of it without flips {without:.1e}; {flipped:.1e} flipped")
    assert without < 1e-5
    assert same_decisions.flips > 0
    assert flipped < 1e-5
    assert with_flips < 5e-3


@pytest.mark.parametrize("held", [0, 1.5])
def test_memory_budget_changes_no_result(tiny_weights, held):
    """Gradients with recomputed forward passes are the same, whether no tile or some tiles are cached."""
    network = FeatureNetwork(tiny_weights)
    case = setting((200, 330))
    whole = evaluate(network, case, None, memory=1 << 34)
    tight = evaluate(network, case, None, memory=1 + int(held * 200 * 330 * network.held_bytes_per_pixel()))
    assert relative_error(tight.image_gradient, whole.image_gradient) < FLOAT32_TOLERANCE


def test_cached_and_recomputed_content_agree(tiny_weights):
    network = FeatureNetwork(tiny_weights)
    image, style, content, _ = (None if t is None else t.float() for t in setting((200, 300)))
    loss = SosLoss(network)
    targets = loss.targets.of_style(Style.of(style), (200, 300))
    cached = loss.evaluate(image, targets, loss.targets.of_view(content))
    again = loss.evaluate(image, targets, loss.targets.of_view(content, cache_content=False))
    assert cached.loss == again.loss
    assert torch.equal(cached.image_gradient, again.image_gradient)
    assert cached.terms[0]["content"] > 0


def test_unneeded_content_and_layers_are_not_computed(tiny_weights):
    """Without content weight, the content layer and layers beyond the deepest used one are not computed."""
    image, style, content, _ = (None if t is None else t.float() for t in setting((200, 300)))
    full = SosLoss(FeatureNetwork(tiny_weights, (*STYLE_LAYERS, CONTENT_LAYER)), content_weight=0)
    lean = SosLoss(FeatureNetwork(tiny_weights, STYLE_LAYERS), content_weight=0)
    results = [
        loss.evaluate(image, loss.targets.of_style(Style.of(style), (200, 300)), loss.targets.of_view(content))
        for loss in (full, lean)
    ]
    assert torch.equal(results[0].image_gradient, results[1].image_gradient)
    shallow = FeatureNetwork(tiny_weights, ("relu1_1", "relu2_1"))
    assert len(shallow.forward(image).outputs) == 4  # conv1_1, conv1_2, pool1, conv2_1


def test_loss_without_gradient_is_identical(tiny_weights):
    network = FeatureNetwork(tiny_weights)
    image, style, content, coverage = (t.float() for t in setting((200, 300), covered=True))
    loss = SosLoss(network)
    targets, view = loss.targets.of_style(Style.of(style), (200, 300)), loss.targets.of_view(content, coverage)
    only = loss.evaluate(image, targets, view, gradient=False)
    assert only.image_gradient is None
    assert only.terms == loss.evaluate(image, targets, view).terms


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


def test_scales_are_averaged(tiny_weights):
    size = (520, 600)
    assert scale_count(*size) == 2
    image, style, content, _ = (None if t is None else t.float() for t in setting(size))
    loss = SosLoss(FeatureNetwork(tiny_weights))
    targets, view = loss.targets.of_style(Style.of(style), size), loss.targets.of_view(content)
    both = loss.evaluate(image, targets, view)
    single = [loss.evaluate(image, targets, view, [scale]) for scale in (0, 1)]
    assert both.loss == pytest.approx((single[0].loss + single[1].loss) / 2, rel=1e-12)
    mean = (single[0].image_gradient + single[1].image_gradient) / 2
    assert relative_error(both.image_gradient, mean) < 1e-6
