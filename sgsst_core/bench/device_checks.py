"""Checks of a device: errors against float64, bit-identical repetitions, and memory that holds NaN."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.bench.synthetic import random_weights, surface_scene, texture, views
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.statistics import layer_statistics, layer_statistics_reference
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork, use_whole_float32
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import StyleTargets
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.rasterizer.reference import ReferenceRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.style import Style

#: Background of all renders.
BACKGROUND = (1.0, 0.25, 0.5)
#: Relative distance from an alpha or transmittance cutoff within which float32 rounding may change the decision, and
#: error bounds for images and for gradients.
_CLOSE, _IMAGE_BOUND, _GRADIENT_BOUND = 2e-5, 1e-5, 5e-6
#: Relative error bounds of float32 features, and of statistics of the same features.
_FEATURE_BOUND, _STATISTICS_BOUND = 1e-5, 1e-5
#: Number of freed blocks of memory that hold NaN, by size in bytes.
_FREED = {1 << 12: 64, 1 << 16: 64, 1 << 20: 32, 1 << 24: 8, 1 << 27: 4}
#: Size in bytes up to which the allocator of a CPU reuses freed blocks; larger ones go back to the system.
_REUSED_BY_CPU = 1 << 20


@dataclass(frozen=True)
class Check:
    """Result of a check.

    Attributes:
        error: Error, or the number of results that differ.
    """

    name: str
    error: float
    bound: float

    @property
    def passed(self) -> bool:
        """Whether the error is finite and within its bound."""
        return math.isfinite(self.error) and self.error <= self.bound


@dataclass(frozen=True)
class CheckSizes:
    """Sizes of the checks.

    Attributes:
        width, height: Size of their view in pixels.
        repeats: Number of repetitions that must be bit-identical.
        channels: Channels of the network's blocks; VGG's own if None.
    """

    gaussians: int = 2000
    width: int = 96
    height: int = 64
    repeats: int = 10
    channels: int | None = None

    @property
    def weights(self) -> BackboneWeights:
        """Random weights of VGG16."""
        return random_weights("vgg16") if self.channels is None else random_weights("vgg16", (self.channels,) * 5)


def check_device(name: str, device: torch.device, sizes: CheckSizes) -> Iterator[Check]:
    """Yield the result of each check, the most telling first.

    Args:
        name: Rasterizer that jobs on this device use.
    """
    use_whole_float32()
    scene, camera = surface_scene(sizes.gaussians, degree=1), views(1, sizes.width, sizes.height)[0]
    rasterizer = make_rasterizer(name, scene, background=BACKGROUND, device=device)
    yield from rasterizer_checks(rasterizer, scene, camera)
    weights = sizes.weights
    yield from network_checks(weights, device, sizes)
    step = Step.of(rasterizer, scene, camera, weights)
    yield Check("values changed by NaN in free memory", step.changed_by_nan(), 0.0)
    yield Check(f"different results of {sizes.repeats} repeated steps", step.different_repeats(sizes.repeats), 0.0)


def rasterizer_checks(fast: Rasterizer, scene: Scene, camera: Camera) -> Iterator[Check]:
    """Compare image, coverage and color gradient with the float64 reference, except at pixels close to a cutoff."""
    reference = ReferenceRasterizer(scene, background=BACKGROUND)
    colors = scene_colors(scene, camera)
    pixels = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    band = reference.near_cutoff(camera, _CLOSE)
    pixels[band] = 0
    image = _off(fast.render(colors, camera), reference.render(colors, camera)).amax(-1)
    yield Check("image", float(image[~band].max()) / max(1.0, float(colors.max())), _IMAGE_BOUND)
    coverage = _off(fast.coverage(camera), reference.coverage(camera))
    yield Check("coverage", float(coverage[~band].max()), _IMAGE_BOUND)
    expected = reference.color_gradient(pixels, camera)
    error = float(_off(fast.color_gradient(pixels, camera), expected).norm() / expected.norm())
    yield Check("gradient", error, _GRADIENT_BOUND)


def network_checks(weights: BackboneWeights, device: torch.device, sizes: CheckSizes) -> Iterator[Check]:
    """Compare float32 features and their statistics with float64, on synthetic weights."""
    image = texture(sizes.height, sizes.width)
    exact = FeatureNetwork(weights, STYLE_LAYERS, torch.float64).forward(image, cache=False).features
    actual = FeatureNetwork(weights, STYLE_LAYERS, device=device).forward(image.to(device), cache=False).features
    yield Check("features", max(_relative(actual[layer], exact[layer]) for layer in exact), _FEATURE_BOUND)
    errors = []
    for features in actual.values():
        if features.numel():
            reference = layer_statistics_reference(features.cpu().double())
            errors.append(_relative(layer_statistics(features).centered, reference.centered))
    yield Check("statistics", max(errors), _STATISTICS_BOUND)


def leave_nan(device: torch.device) -> None:
    """Fill memory with NaN and free it, so that tensors that are created without values are likely to contain NaN."""
    most = _REUSED_BY_CPU if device.type == "cpu" else max(_FREED)
    sizes = [size for size, count in _FREED.items() if size <= most for _ in range(count)]
    blocks = [torch.full((size // 4,), torch.nan, device=device) for size in sizes]
    del blocks


@dataclass(frozen=True)
class Step:
    """Render of a view, its loss, and the color gradient, whose results are compared bit by bit."""

    rasterizer: Rasterizer
    camera: Camera
    loss: SosLoss
    style: StyleTargets
    colors: Tensor

    @staticmethod
    def of(
        rasterizer: Rasterizer,
        scene: Scene,
        camera: Camera,
        weights: BackboneWeights,
        dtype: torch.dtype = torch.float32,
    ) -> Step:
        """Create a step whose network computes in `dtype` on the rasterizer's device, with a synthetic style."""
        loss = SosLoss(FeatureNetwork(weights, dtype=dtype, device=rasterizer.device), content_weight=0.0)
        size = camera.height, camera.width
        style = loss.targets.of_style(Style.of(texture(*size, seed=1)), size)
        return Step(rasterizer, camera, loss, style, scene_colors(scene, camera).to(rasterizer.device))

    def run(self) -> Tensor:
        """Return the values of the loss and the color gradient as one float64 tensor on the CPU."""
        image = self.rasterizer.render(self.colors, self.camera)
        result = self.loss.evaluate(image, self.style, self.loss.targets.of_view(image))
        assert result.image_gradient is not None
        gradient = self.rasterizer.color_gradient(result.image_gradient.to(image), self.camera)
        return torch.cat([result.values.flatten().cpu().double(), gradient.flatten().cpu().double()])

    def changed_by_nan(self) -> float:
        """Return the number of values that change if free memory holds NaN."""
        expected = self.run()
        leave_nan(self.rasterizer.device)
        return _different(self.run(), expected)

    def different_repeats(self, repeats: int) -> float:
        """Return how many repetitions have another result than the first run."""
        expected = self.run()
        return float(sum(_different(self.run(), expected) > 0 for _ in range(repeats)))


def _off(actual: Tensor, expected: Tensor) -> Tensor:
    return (actual.cpu().double() - expected).abs()


def _relative(actual: Tensor, expected: Tensor) -> float:
    return float((actual.cpu().double() - expected.cpu().double()).norm() / expected.cpu().double().norm())


def _different(actual: Tensor, expected: Tensor) -> float:
    """Return the number of values that are not equal; NaN differs from everything."""
    return float((actual != expected).sum())
