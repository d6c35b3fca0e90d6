"""Maps of a view: the fraction of each pixel's blend weights that belongs to each region."""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera


class RegionMaps:
    """Renderer of region maps: the fraction of each pixel's blend weights that belongs to each region of the scene.

    Blending is linear in the colors. If each Gaussian's color is 1 in its own region, a rendering shows the region's
    fraction of each pixel; three channels give three regions per pass.

    Args:
        labels: [N] uint8, region of each Gaussian of the rasterizer.
    """

    def __init__(self, labels: Tensor, active: tuple[int, ...], rasterizer: Rasterizer) -> None:
        self.count = len(active)
        self._labels, self._active, self._rasterizer = labels.to(rasterizer.device), active, rasterizer

    def render(self, camera: Camera) -> Tensor:
        """Return the maps [h, w, count] in 0..1 of a view.

        They are exactly 0 where a region is not visible.
        """
        background = self._pass(camera, range(0))
        maps = [
            self._pass(camera, range(first, min(first + 3, self.count))) - background
            for first in range(0, self.count, 3)
        ]
        return torch.cat(maps, dim=2)[:, :, : self.count].clamp(0, 1)

    def _pass(self, camera: Camera, parts: range) -> Tensor:
        """Render the masks of up to three regions; if `parts` is empty, render the background.

        The background is bit-identical in all passes, so it can be subtracted.
        """
        rasterizer = self._rasterizer
        colors = torch.zeros((len(rasterizer.scene), 3), dtype=rasterizer.dtype, device=rasterizer.device)
        for channel, part in enumerate(parts):
            colors[:, channel] = self._labels == self._active[part]
        return rasterizer.render(colors, camera)


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
