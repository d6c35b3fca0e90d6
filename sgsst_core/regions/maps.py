"""Region maps: the fraction of each pixel's blend weights that belongs to each region."""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera


class RegionMaps:
    """Renderer of region maps: the fraction of each pixel's blend weights that belongs to each region.

    Blending is linear in the colors. With color 1 for the Gaussians of a region and 0 for all others, a rendering shows
    the region's fraction; three channels give three regions per pass.

    Args:
        labels: [N] uint8, region of each Gaussian of the rasterizer.
        active: Regions to render.
        rasterizer: Any rasterizer.
    """

    def __init__(self, labels: Tensor, active: tuple[int, ...], rasterizer: Rasterizer) -> None:
        self.count = len(active)
        self._rasterizer = rasterizer
        self._labels, self._active = labels.to(rasterizer.device), active

    def render(self, camera: Camera) -> Tensor:
        """Return the maps [h, w, regions] in 0..1 of a view.

        They are exactly 0 where a region is not visible.
        """
        background = self._pass(camera, ())
        parts = [self._pass(camera, self._active[first : first + 3]) - background for first in range(0, self.count, 3)]
        return torch.cat(parts, dim=2)[:, :, : self.count].clamp(0, 1)

    def _pass(self, camera: Camera, regions: tuple[int, ...]) -> Tensor:
        """Render up to three region masks; without regions, render the background.

        The background is bit-identical in all passes, so it can be subtracted.
        """
        rasterizer = self._rasterizer
        colors = torch.zeros((len(self._labels), 3), dtype=rasterizer.dtype, device=rasterizer.device)
        for channel, region in enumerate(regions):
            colors[:, channel] = self._labels == region
        return rasterizer.render(colors, camera)
