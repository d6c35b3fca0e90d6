"""Tests of compiled kernels at production block sizes against references."""

from __future__ import annotations

import mmap
from dataclasses import replace

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.stability.sos_reference import layer_statistics_reference
from sgsst_core.constants import ALPHA_MIN
from sgsst_core.features.layers import (
    fused_max_pool,
    fused_max_pool_backward,
    max_pool_backward_reference,
)
from sgsst_core.features.statistics import fused_statistics
from sgsst_core.loss.terms import StyleGradient, fused_add_style_gradient
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.rasterizer.triton import CachedRasterizer
from sgsst_core.scene.rendering import CLASSIC, Rendering
from tests.ptx.driver import compiled_kernels
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import ball, cameras


@pytest.mark.parametrize(
    ("capability", "rendering"), [(80, CLASSIC), (90, CLASSIC), (80, Rendering("antialiased", 0.1))]
)
def test_images_and_gradients_agree_with_reference(capability: int, rendering: Rendering) -> None:
    scene, camera = replace(ball(150), rendering=rendering), cameras(1, 45, 37)[0]
    reference = make_rasterizer("reference", scene)
    colors = torch.rand((len(scene), 3), generator=torch.Generator().manual_seed(0))
    image_gradient = synthetic_image(37, 45, dtype=torch.float32) - 0.5
    image, gradient = (
        reference.render(colors.double(), camera),
        reference.color_gradient(image_gradient.double(), camera),
    )
    with compiled_kernels(capability):
        uncached = make_rasterizer("triton", scene)
        for rasterizer in (uncached, CachedRasterizer(scene, uncached=uncached)):
            assert relative_error(rasterizer.render(colors, camera), image) < 3e-7
            assert relative_error(rasterizer.color_gradient(image_gradient, camera), gradient) < 5e-7


def test_only_pixels_near_a_cutoff_have_larger_errors() -> None:
    """The nearest Gaussian has, in one pixel, a value of alpha that is just above its cutoff, or just below it."""
    scene, camera = replace(ball(60), opacities=torch.linspace(-2, 3, 60)), cameras(1, 19, 17)[0]
    nearest = scene.means[:, 2].argmin()
    alpha = make_rasterizer("reference", scene.subset(nearest[None])).coverage(camera)
    at_cutoff = torch.logit(scene.opacities[nearest].double().sigmoid() * ALPHA_MIN / alpha[alpha > 0].min())
    colors, image_gradient = torch.rand((60, 3)), synthetic_image(17, 19, dtype=torch.float32) - 0.5
    errors = []
    for change in (3e-7, -3e-7):
        opacities = scene.opacities.clone()
        opacities[nearest] = at_cutoff + change
        changed = replace(scene, opacities=opacities)
        reference = ReferenceRasterizer(changed)
        near = reference.near_cutoff(camera, 1e-6)
        assert int(near.sum()) == 1
        elsewhere = image_gradient * ~near[..., None]
        image, gradient = (
            reference.render(colors.double(), camera),
            reference.color_gradient(elsewhere.double(), camera),
        )
        with compiled_kernels(90):
            rasterizer = make_rasterizer("triton", changed)
            actual = rasterizer.render(colors, camera)
            assert relative_error(rasterizer.color_gradient(elsewhere, camera), gradient) < 3e-7
        assert relative_error(actual[~near], image[~near]) < 3e-7
        errors.append(relative_error(actual, image))
    assert max(errors) > 1e-5, "a Gaussian is blended in one of them only"
    assert min(errors) < 3e-7


def test_statistics_of_many_spans_agree_with_float64() -> None:
    image = 255 * synthetic_image(150, 151, dtype=torch.float32)  # 12 spans, the last one incomplete
    exact = layer_statistics_reference(image)
    with compiled_kernels(80):
        statistics = fused_statistics(image)
    assert relative_error(statistics.mean, exact.mean) < 1e-6
    assert relative_error(statistics.centered, exact.centered) < 1e-6


@pytest.mark.parametrize("capability", [80, 90])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("size", [(12, 10), (13, 11), (1, 5)])
def test_pooling_and_its_gradients_are_those_of_the_reference(
    capability: int, dtype: torch.dtype, size: tuple[int, int]
) -> None:
    """Values on a coarse grid, so that most windows have ties, and some are all zero."""
    generator = torch.Generator().manual_seed(0)
    source = torch.randn((1, *size, 64), generator=generator).round().to(dtype).permute(0, 3, 1, 2).relu_()
    gradient = torch.randn((1, size[0] // 2, size[1] // 2, 64), generator=generator).to(dtype).permute(0, 3, 1, 2)
    with compiled_kernels(capability):
        actual, pooled = fused_max_pool_backward(gradient, source), fused_max_pool(source)
    assert torch.equal(pooled, torch.zeros_like(gradient) if min(size) < 2 else F.max_pool2d(source, 2))
    assert pooled.is_contiguous(memory_format=torch.channels_last)
    expected = torch.zeros_like(source) if min(size) < 2 else max_pool_backward_reference(gradient, source)
    assert actual.is_contiguous(memory_format=torch.channels_last)
    assert torch.equal(actual, expected)


def sparse(shape: tuple[int, ...], strides: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Return zeros with large strides; only accessed pages take memory."""
    count = sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True)) + 1
    mapping = mmap.mmap(-1, count * dtype.itemsize, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | 0x4000)  # NORESERVE
    return torch.frombuffer(mapping, dtype=dtype, count=count).as_strided(shape, strides)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_offsets_beyond_32_bits_are_correct(dtype: torch.dtype) -> None:
    """The last row starts after 2.5e9 values."""
    generator = torch.Generator().manual_seed(0)
    small = (2 + torch.randn((6, 9, 16), generator=generator)).to(dtype)
    features, gradient = (sparse((6, 9, 16), (500_000_000, 16, 1), dtype) for _ in range(2))
    features.copy_(small)
    matrix, mean, offset = (torch.randn(shape, generator=generator) for shape in ((16, 16), (16,), (16,)))
    matrix = matrix + matrix.T
    exact = layer_statistics_reference(small)
    expected = (small.double() - mean.double()) @ matrix.double() + offset.double()
    tolerance = 1e-6 if dtype == torch.float32 else 4e-3
    with compiled_kernels(80):
        assert relative_error(fused_statistics(features).centered, exact.centered) < tolerance
        fused_add_style_gradient(gradient, features, StyleGradient(matrix, mean, offset))
    assert relative_error(gradient.double(), expected) < tolerance


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
@pytest.mark.parametrize("channels", [64, 128])
def test_products_of_16_bit_features_are_not_rounded(channels: int, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    features = torch.randn((13, 29, channels), generator=generator).relu().to(dtype)
    weights = torch.rand((13, 29), generator=generator)
    exact = layer_statistics_reference(features, weights.to(dtype))
    matrix, mean, offset = (torch.randn(shape, generator=generator) for shape in (2 * (channels,), channels, channels))
    matrix = matrix + matrix.T
    expected = ((features.double() - mean.double()) @ matrix.double() + offset.double()) * weights[..., None]
    gradient = torch.zeros_like(features)
    with compiled_kernels(80) as driver:
        assert relative_error(fused_statistics(features, weights).centered, exact.centered) < 1e-6
        instructions = driver.kernels["shifted_moments"].program.instructions
        assert any(one.opcode[:2] == ("cp", "async") for one in instructions), "loads do not overlap with products"
        fused_add_style_gradient(gradient, features, StyleGradient(matrix, mean, offset), weights)
    assert relative_error(gradient.double(), expected) < torch.finfo(dtype).eps / 2
