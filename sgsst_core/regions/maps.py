"""Maps of a view: the fraction of each pixel's blend weights that belongs to each region or depth band."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor

from sgsst_core.constants import NEAR
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera, spread

#: Number of views from which the mean level of a scene is computed.
_LEVEL_VIEWS = 8
#: Number of Gaussians whose depths are computed at a time.
_CHUNK = 1 << 17


class ViewMaps(ABC):
    """Renderer of maps: the fraction of each pixel's blend weights that belongs to each of several parts of the scene.

    Blending is linear in the colors. If each Gaussian's color is its own fraction of a part, a rendering shows the
    part's fraction of each pixel; three channels give three parts per pass.
    """

    def __init__(self, count: int, rasterizer: Rasterizer) -> None:
        self.count = count
        self._rasterizer = rasterizer

    @abstractmethod
    def fractions(self, part: int, camera: Camera) -> Tensor:
        """Return the fraction of each Gaussian that belongs to a part, [N]: float64 in 0..1, or bool."""

    def render(self, camera: Camera) -> Tensor:
        """Return the maps [h, w, count] in 0..1 of a view.

        They are exactly 0 where a part is not visible.
        """
        background = self._pass(camera, range(0))
        parts = [
            self._pass(camera, range(first, min(first + 3, self.count))) - background
            for first in range(0, self.count, 3)
        ]
        return torch.cat(parts, dim=2)[:, :, : self.count].clamp(0, 1)

    def _pass(self, camera: Camera, parts: range) -> Tensor:
        """Render the masks of up to three regions; if `parts` is empty, render the background.

        The background is bit-identical in all passes, so it can be subtracted.
        """
        rasterizer = self._rasterizer
        colors = torch.zeros((len(rasterizer.scene), 3), dtype=rasterizer.dtype, device=rasterizer.device)
        for channel, part in enumerate(parts):
            colors[:, channel] = self.fractions(part, camera)
        return rasterizer.render(colors, camera)


class RegionMaps(ViewMaps):
    """Renderer of region maps.

    Args:
        labels: [N] uint8, region of each Gaussian of the rasterizer.
    """

    def __init__(self, labels: Tensor, active: tuple[int, ...], rasterizer: Rasterizer) -> None:
        super().__init__(len(active), rasterizer)
        self._labels, self._active = labels.to(rasterizer.device), active

    def fractions(self, part: int, camera: Camera) -> Tensor:  # noqa: ARG002 (base signature)
        """Return the mask [N] bool of the Gaussians of an active region."""
        return self._labels == self._active[part]


class ContentMaps(RegionMaps):
    """Renderer of the blended content weight of each pixel, relative to the largest one of a Gaussian.

    Regions are rendered one by one and then weighted, because a small weight would be lost in the rounding error of a
    large one.

    Args:
        weights: [N], content weight of each Gaussian of the rasterizer; at least one is not 0.
    """

    def __init__(self, weights: Tensor, rasterizer: Rasterizer) -> None:
        values, labels = weights.to(rasterizer.device).unique(return_inverse=True)
        super().__init__(labels, tuple(range(len(values))), rasterizer)
        self._values: Tensor = (values / values.max()).to(rasterizer.dtype)

    def render(self, camera: Camera) -> Tensor:
        """Return the weights [h, w, 1] in 0..1 of a view."""
        return (super().render(camera) * self._values).sum(dim=2, keepdim=True).clamp_max(1)


class DepthBands(ViewMaps):
    """Renderer of depth bands, one per scale of a view: the nearer, the coarser.

    Strokes of scale s are 2^s times as large on screen as those of full size. They have the same size in the scene if
    they are drawn where a scene unit covers 2^s times as many pixels. The level of a Gaussian is therefore the
    logarithm of pixels per scene unit at its depth, relative to that of the scene's mean, which gets the middle scale.
    A Gaussian between two levels belongs to both bands in proportion, so the bands add up to the coverage.

    Args:
        mean_level: Result of `mean_level`.
    """

    def __init__(self, count: int, mean_level: float, rasterizer: Rasterizer) -> None:
        super().__init__(count, rasterizer)
        self._finest_level = mean_level - (count - 1) / 2
        self._means = rasterizer.scene.means

    def fractions(self, part: int, camera: Camera) -> Tensor:
        """Return each Gaussian's fraction [N] float64 of a band; band 0 has the farthest Gaussians."""
        parts = []
        for means in self._means.split(_CHUNK):
            level = _levels(_in_camera(means, camera), camera) - self._finest_level
            parts.append((1 - (level.clamp(0, self.count - 1) - part).abs()).clamp_min(0))
        return torch.cat(parts)


def mean_level(means: Tensor, weights: Tensor, cameras: Sequence[Camera], near: float = NEAR) -> float:
    """Return the mean logarithm to base 2 of pixels per scene unit, over a few views and the Gaussians in them.

    Args:
        means: [N, 3], positions of the Gaussians.
        weights: [N] float64, total blend weights.
        cameras: Cameras of views that see something.
        near: Near plane in world units; nearer Gaussians do not count.
    """
    sums = torch.zeros(2, dtype=torch.float64)
    for camera in spread(cameras, _LEVEL_VIEWS):
        for rows in torch.arange(len(means)).split(_CHUNK):
            points = _in_camera(means[rows], camera)
            x, y, z = points.unbind(1)
            column, row = camera.fx * x + camera.cx * z, camera.fy * y + camera.cy * z
            inside = (z >= near) & (column > 0) & (column < camera.width * z) & (row > 0) & (row < camera.height * z)
            inside &= weights[rows] > 0
            own = weights[rows][inside]
            sums += torch.stack([own @ _levels(points[inside], camera), own.sum()])
    total, weight = sums.tolist()
    return total / weight if weight > 0 else math.log2(cameras[0].fx)


def _in_camera(means: Tensor, camera: Camera) -> Tensor:
    """Return positions [n, 3] float64 in camera coordinates; differences far from the origin need float64."""
    pose = camera.world_to_camera.to(means.device, torch.float64)
    return means.double() @ pose[:3, :3].T + pose[:3, 3]


def _levels(points: Tensor, camera: Camera) -> Tensor:
    """Return the logarithm to base 2 of pixels per scene unit at points [n, 3] in camera coordinates, [n]."""
    tiny = torch.finfo(torch.float64).tiny
    return math.log2(math.sqrt(camera.fx) * math.sqrt(camera.fy)) - points[:, 2].clamp_min(tiny).log2()
