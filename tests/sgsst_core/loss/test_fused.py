"""Tests of the Triton kernels for statistics and style loss against float64, on a GPU or in Triton's interpreter."""

import mmap

import pytest
import torch
from torch import Tensor

from benchmarks.stability.sos_reference import applied, layer_statistics_reference
from sgsst_core.features.statistics import LayerStatistics, fused_statistics
from sgsst_core.loss import terms as terms
from sgsst_core.loss.terms import (
    LayerTarget,
    StyleGradient,
    content_gradient,
    content_loss,
    fused_add_content_gradient,
    fused_add_style_gradient,
    fused_content_sum,
    fused_style_loss,
    style_loss,
)
from tests.sgsst_core.synthetic_images import relative_error

pytest.importorskip("triton")
DEVICE = "cuda" if torch.cuda.is_available() else "cpu"
pytestmark = [pytest.mark.gpu] if DEVICE == "cuda" else []
HALVES = [torch.bfloat16, torch.float16]
WEIGHTS = (terms.GRAM_WEIGHT, terms.MEAN_WEIGHT, terms.STD_WEIGHT)


def features(height: int, width: int, channels: int, seed: int, mean: float = 0.0) -> Tensor:
    """Return a non-contiguous crop of a float32 feature map with correlated channels, like a tile without its halo."""
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn((height + 3, width + 2, channels), generator=generator)
    mixed = (x @ torch.randn((channels, channels), generator=generator) / channels**0.5).relu() + mean
    return mixed.to(DEVICE)[1 : height + 1, 2:]


def position_weights(height: int, width: int) -> Tensor:
    """Return weights from 0 to 1, some of whose rows are all 0, as outside of an object's silhouette."""
    weights = torch.rand((height + 2, width), generator=torch.Generator().manual_seed(7))
    weights[:5] = 0
    return weights.to(DEVICE)[2:]


def target_of(channels: int) -> LayerTarget:
    reference = layer_statistics_reference(features(20, 30, channels, seed=9, mean=0.3).cpu())
    return LayerTarget(*(part.to(DEVICE) for part in (reference.gram(), reference.mean, reference.std())))


def on_cpu(statistics: LayerStatistics) -> LayerStatistics:
    return LayerStatistics(statistics.count.cpu(), statistics.mean.cpu(), statistics.centered.cpu())


def fused_gradient(x: Tensor, weights: Tensor | None, target: LayerTarget) -> tuple[Tensor, Tensor]:
    """Return terms [4] and gradient [h, w, c]. Check that the gradient is added, and only within the crop."""
    terms, map_ = fused_style_loss(
        fused_statistics(x, weights), (target.gram, target.mean, target.std), WEIGHTS, 2.0**-23, x.dtype
    )
    around = torch.zeros((x.shape[0] + 2, x.shape[1] + 2, x.shape[2]), dtype=x.dtype, device=x.device)
    gradient = around[1:-1, 1:-1]
    fused_add_style_gradient(gradient, x, map_, weights)
    once = gradient.clone()
    fused_add_style_gradient(gradient, x, map_, weights)
    assert torch.equal(gradient, 2 * once)
    gradient.zero_()
    assert not around.any()
    return terms.cpu(), once.cpu()


@pytest.mark.parametrize(
    ("channels", "height", "width", "weighted"),
    [(3, 70, 50, False), (16, 50, 40, True), (64, 70, 90, False), (128, 20, 33, True), (256, 5, 13, False)],
)
def test_agrees_with_float64(channels: int, height: int, width: int, weighted: bool) -> None:
    """With 64 channels, this size is summed in several spans."""
    x = features(height, width, channels, seed=1)
    a = position_weights(height, width) if weighted else None
    actual, exact = on_cpu(fused_statistics(x, a)), layer_statistics_reference(x.cpu(), None if a is None else a.cpu())
    assert float(actual.count) == pytest.approx(float(exact.count), rel=1e-6)
    assert relative_error(actual.mean, exact.mean) < 1e-6
    assert relative_error(actual.centered, exact.centered) < 3e-6
    assert torch.equal(actual.centered, actual.centered.T)
    target = target_of(channels)
    terms_, gradient = fused_gradient(x, a, target)
    exact_target = LayerTarget(target.gram.cpu(), target.mean.cpu(), target.std.cpu())
    expected, map_ = style_loss(exact, exact_target, feature_eps=2.0**-23)
    assert relative_error(terms_, expected) < 1e-5
    assert relative_error(gradient, applied(map_, x.cpu().double(), None if a is None else a.cpu())) < 1e-4


def test_survives_a_large_mean_to_sigma_ratio() -> None:
    generator = torch.Generator().manual_seed(0)
    x, style = (
        (1e4 + spread * torch.randn((60, 50, 16), generator=generator, dtype=torch.float64)).float()
        for spread in (1, 2)
    )
    exact = layer_statistics_reference(x)
    assert relative_error(on_cpu(fused_statistics(x.to(DEVICE))).std(), exact.std()) < 1e-6
    reference = layer_statistics_reference(style)
    target = LayerTarget(reference.gram(), reference.mean, reference.std())
    _, expected = style_loss(exact, target)
    on_device = LayerTarget(*(part.to(DEVICE) for part in (target.gram, target.mean, target.std)))
    actual, map_ = fused_style_loss(
        fused_statistics(x.to(DEVICE)), (on_device.gram, on_device.mean, on_device.std), WEIGHTS, 2.0**-23
    )
    gradient = torch.zeros_like(x, device=DEVICE)
    fused_add_style_gradient(gradient, x.to(DEVICE), map_)
    assert torch.isfinite(actual).all()
    assert relative_error(gradient.cpu(), applied(expected, x.double())) < 1e-4


@pytest.mark.parametrize("dead_in", ["view", "style", "both"])
def test_dead_and_constant_channels_give_finite_gradients(dead_in: str) -> None:
    view, style = features(17, 23, 16, seed=1), features(17, 23, 16, seed=2)
    for name, x in (("view", view), ("style", style)):
        if dead_in in (name, "both"):
            x[..., :3] = 0
            x[..., 3:6] = 123.4
    reference = layer_statistics_reference(style.cpu())
    target = LayerTarget(*(part.to(DEVICE) for part in (reference.gram(), reference.mean, reference.std())))
    terms_, gradient = fused_gradient(view, None, target)
    assert torch.isfinite(gradient).all()
    assert torch.isfinite(terms_).all()
    assert float(terms_.sum()) > 0


@pytest.mark.parametrize(("channels", "height", "width", "weighted"), [(32, 20, 30, True), (128, 20, 33, False)])
@pytest.mark.parametrize("dtype", HALVES)
def test_products_of_16_bit_features_are_not_rounded(
    dtype: torch.dtype, channels: int, height: int, width: int, weighted: bool
) -> None:
    x = features(height, width, channels, seed=3).to(dtype)
    a = position_weights(height, width) if weighted else None
    exact = layer_statistics_reference(x.cpu(), None if a is None else a.to(dtype).cpu())
    actual = on_cpu(fused_statistics(x, a))
    assert relative_error(actual.count, exact.count) < 1e-6
    assert relative_error(actual.mean, exact.mean) < 1e-6
    assert relative_error(actual.centered, exact.centered) < 5e-6
    target = target_of(channels)
    _, gradient = fused_gradient(x, a, target)
    cpu_target = LayerTarget(target.gram.cpu(), target.mean.cpu(), target.std.cpu())
    exact_gradient = style_loss(exact, cpu_target)[1]
    expected = applied(exact_gradient, x.cpu().double(), None if a is None else a.cpu())
    assert relative_error(gradient.double(), expected) < torch.finfo(dtype).eps / 2


def sparse(shape: tuple[int, ...], strides: tuple[int, ...]) -> Tensor:
    """Return float32 zeros with large strides; only accessed pages take memory."""
    count = sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True)) + 1
    mapping = mmap.mmap(-1, 4 * count, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x4000)  # NORESERVE
    return torch.frombuffer(mapping, dtype=torch.float32, count=count).as_strided(shape, strides)


@pytest.mark.skipif(DEVICE == "cuda", reason="a GPU has no memory that is not accessed")
def test_offsets_beyond_32_bits_are_correct() -> None:
    """The last row starts after 2.5e9 values."""
    values = features(6, 9, 16, seed=4, mean=2.0)
    x, gradient = (sparse((6, 9, 16), (500_000_000, 16, 1)) for _ in range(2))
    x.copy_(values)
    target = target_of(16)
    style = fused_style_loss(fused_statistics(values), (target.gram, target.mean, target.std), WEIGHTS, 2.0**-23)[1]
    assert torch.equal(fused_statistics(x).centered, fused_statistics(values).centered)
    fused_add_style_gradient(gradient, x, style)
    assert relative_error(gradient, applied(style, values)) < 1e-5


@pytest.mark.parametrize("dtype", [torch.float32, *HALVES])
@pytest.mark.parametrize(("channels", "weighted"), [(8, True), (128, False)])
def test_gradient_passes_the_relu_of_the_features(dtype: torch.dtype, channels: int, weighted: bool) -> None:
    x, a = features(20, 33, channels, seed=3).to(dtype), position_weights(20, 33) if weighted else None
    x[0, 0, 0], x[0, 1, 0] = torch.nan, -0.0
    assert 0.3 < float((x == 0).float().mean()) < 0.7
    generator = torch.Generator().manual_seed(0)
    matrix, mean, offset = (
        torch.randn(shape, generator=generator) for shape in ((channels, channels), channels, channels)
    )
    style = StyleGradient((matrix + matrix.T).to(DEVICE), mean.to(DEVICE), offset.to(DEVICE))
    before = torch.randn(x.shape, generator=generator).to(DEVICE, dtype)
    gradient, expected = before.clone(), before.clone()
    fused_add_style_gradient(gradient, x, style, a, relu=True)
    fused_add_style_gradient(expected, x, style, a)
    expected = torch.ops.aten.threshold_backward(expected, x, 0)
    assert torch.equal(gradient.cpu().nan_to_num(), expected.cpu().nan_to_num())
    assert gradient[0, 0].isnan().any()


@pytest.mark.parametrize("dtype", [torch.float32, *HALVES])
@pytest.mark.parametrize(("channels", "weighted"), [(8, True), (512, False)])
def test_content_term_agrees_with_float64(dtype: torch.dtype, channels: int, weighted: bool) -> None:
    x, content = (features(9, 13, channels, seed=seed).to(dtype) for seed in (1, 2))
    a, factor = position_weights(9, 13) if weighted else None, torch.tensor(0.7, dtype=torch.float64, device=DEVICE)
    exact = x.double(), content.double(), a, factor
    assert float(factor * fused_content_sum(x, content, a)) == pytest.approx(float(content_loss(*exact)), rel=1e-6)
    before = torch.randn(x.shape, generator=torch.Generator().manual_seed(0)).to(DEVICE, dtype)
    for relu in (False, True):
        gradient, expected = before.clone(), before.double() + content_gradient(*exact)
        fused_add_content_gradient(gradient, x, content, a, factor, relu=relu)
        expected = expected * (x > 0) if relu else expected
        assert relative_error(gradient.cpu().double(), expected.cpu()) < (1e-6 if dtype == torch.float32 else 4e-3)
