"""Style targets of a job: one style, or one for each region of the scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.loss.mixture import StyleMixture
from sgsst_core.loss.regions import Regions
from sgsst_core.loss.sos import RegionTarget, ScaleTarget, SosLoss
from sgsst_core.parallel.division import Size
from sgsst_core.rasterizer import Rasterizer, Rows
from sgsst_core.scene.camera import Camera
from sgsst_core.settings import Settings
from sgsst_core.stylizing.style_picture import prepared_style
from sgsst_core.stylizing.unseen import neighbors_change
from sgsst_core.stylizing.warm_start import luminance_start, warm_start


@dataclass(frozen=True)
class JobStyles:
    """Styles of a job, prepared as its settings require.

    Attributes:
        own: Default style; if one region contains everything that the views show, the style of that region.
        regions: Regions of the scene; None if there are none.
        each: Style of each region in `Regions.active`; empty if views need no region maps.
    """

    own: StyleMixture
    regions: Regions | None = None
    each: tuple[StyleMixture, ...] = ()

    @staticmethod
    def prepared(
        style: StyleMixture, regions: Regions | None, settings: Settings, sh_dc: Tensor, weights: Tensor
    ) -> JobStyles:
        """Prepare styles as the settings require; see `prepared_style`.

        Args:
            style: Style of the job.
            regions: Result of `Regions.resolved`; None if there are no regions.
            settings: Settings of the job.
            sh_dc: [N, 3], colors of the scene. A region's style may be matched to the colors of the region's own
                Gaussians.
            weights: [N] float64, total blend weights.
        """
        if regions is None:
            return JobStyles(prepared_style(style, settings, sh_dc, weights))
        asked = [regions.every[place].style or style for place in regions.active]
        if not regions.mapped:
            return JobStyles(prepared_style(asked[0], settings, sh_dc, weights), regions)
        each = [
            prepared_style(own, settings, sh_dc, torch.where(regions.members(place), weights, 0.0))
            for place, own in zip(regions.active, asked, strict=True)
        ]
        rest = each[regions.active.index(0)] if 0 in regions.active else prepared_style(style, settings, sh_dc, weights)
        return JobStyles(rest, regions, tuple(each))

    @property
    def all(self) -> list[StyleMixture]:
        """All distinct styles in use."""
        found: list[StyleMixture] = []
        for style in self.each or (self.own,):
            if all(style is not other for other in found):
                found.append(style)
        return found

    def to(self, device: torch.device) -> JobStyles:
        """Return the styles with their images on a device."""

        def move(style: StyleMixture) -> StyleMixture:
            return style.map(lambda picture: picture.to(device))

        return replace(self, own=move(self.own), each=tuple(map(move, self.each)))

    def targets(self, loss: SosLoss, view_size: Size) -> dict[int, ScaleTarget]:
        """Compute the targets for views of a size (height, width); see `SosLoss.style_targets`."""
        if not self.each:
            return loss.style_targets(self.own, view_size)
        assert self.regions is not None
        weights = [self.regions.every[place].weight for place in self.regions.active]
        every = [loss.style_targets(style, view_size) for style in self.each]
        return {
            scale: ScaleTarget(
                {}, None, tuple(RegionTarget(own[scale], weight) for own, weight in zip(every, weights, strict=True))
            )
            for scale in every[0]
        }

    def transferred(self, sh_dc: Tensor, weights: Tensor, rows: Tensor, *, keep_chroma: bool = False) -> Tensor:
        """Transfer to each Gaussian the colors of its region's style; see `warm_start`.

        Args:
            sh_dc: [n, 3], colors of some of the scene's Gaussians.
            weights: [n] float64, total blend weights.
            rows: [N] bool, mask of these Gaussians.
            keep_chroma: Whether to change luminance only.

        Returns:
            [n, 3].
        """
        transfer = luminance_start if keep_chroma else warm_start
        if not self.each:
            return transfer(sh_dc, weights, self.own)
        assert self.regions is not None
        result, labels = sh_dc.clone(), self.regions.labels[rows]
        for place, style in zip(self.regions.active, self.each, strict=True):
            own = labels == place
            if bool((weights[own] > 0).any()):
                result[own] = transfer(sh_dc[own], weights[own], style)
        return result

    def maps(self, rasterizer: Rasterizer, rows: Tensor | None = None) -> RegionMaps | None:
        """Return the renderer of region maps; None if the views need none.

        Args:
            rasterizer: Rasterizer of the maps.
            rows: [N] bool, Gaussians that the rasterizer contains; None for all.
        """
        if not self.each:
            return None
        assert self.regions is not None
        labels = self.regions.labels if rows is None else self.regions.labels[rows]
        return RegionMaps(labels, self.regions.active, rasterizer)


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

    def render(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return the maps [h, w, regions] in 0..1 of a view, or of some of its rows.

        They are exactly 0 where a region is not visible.
        """
        behind = self._pass(camera, rows, ())
        parts = [
            self._pass(camera, rows, self._active[first : first + 3]) - behind for first in range(0, self.count, 3)
        ]
        return torch.cat(parts, dim=2)[:, :, : self.count].clamp(0, 1)

    def _pass(self, camera: Camera, rows: Rows | None, places: tuple[int, ...]) -> Tensor:
        """Render up to three region masks; without regions, render the background.

        The background is bit-identical in all passes, so it can be subtracted.
        """
        rasterizer = self._rasterizer
        colors = torch.zeros((len(self._labels), 3), dtype=rasterizer.dtype, device=rasterizer.device)
        for channel, place in enumerate(places):
            colors[:, channel] = self._labels == place
        return rasterizer.render(colors, camera, rows)


def neighbors_change_by_region(means: Tensor, change: Tensor, weights: Tensor, regions: Regions) -> Tensor:
    """Return color changes for the Gaussians that are not optimized: those of their neighbors in the same region.

    If a region has no optimized Gaussians, neighbors in all regions count. The change of frozen Gaussians is 0.

    Args:
        means: [N, 3], see `neighbors_change`.
        change: [N, 3], see `neighbors_change`.
        weights: [N] float64, total blend weights of the optimized Gaussians; 0 for all others.
        regions: Regions of the scene.

    Returns:
        [N, 3].
    """
    result = torch.zeros_like(change)
    kept = regions.frozen
    for place in regions.labels[~kept].unique().tolist():
        members = regions.members(place)
        voters = torch.where(members, weights, 0.0)
        if not bool((voters > 0).any()):
            voters = weights
        rows = members | (voters > 0)
        takes = rows & (voters <= 0)
        result[takes] = neighbors_change(means[rows], change[rows], voters[rows])
    return result
