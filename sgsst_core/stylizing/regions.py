"""What a job draws its views to: one style, or one for each region of the scene."""

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
    """The styles of a job, as its settings want them.

    Attributes:
        own: of what no region says otherwise; of the only region, where one is everything.
        regions: None where there are none.
        each: style of each of the regions' `active`; empty where the views need no maps of them.
    """

    own: StyleMixture
    regions: Regions | None = None
    each: tuple[StyleMixture, ...] = ()

    @staticmethod
    def prepared(
        style: StyleMixture, regions: Regions | None, settings: Settings, sh_dc: Tensor, weights: Tensor
    ) -> JobStyles:
        """Styles as the settings want them: see `prepared_style`.

        Args:
            regions: as `Regions.resolved` gives them.
            sh_dc: [N, 3], of the scene; a region's style may take the colors of its own Gaussians.
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
        """Every style that something is drawn to, once."""
        found: list[StyleMixture] = []
        for style in self.each or (self.own,):
            if all(style is not other for other in found):
                found.append(style)
        return found

    def to(self, device: torch.device) -> JobStyles:
        """With their pictures on a device."""

        def move(style: StyleMixture) -> StyleMixture:
            return style.map(lambda picture: picture.to(device))

        return replace(self, own=move(self.own), each=tuple(map(move, self.each)))

    def targets(self, loss: SosLoss, view_size: Size) -> dict[int, ScaleTarget]:
        """What they ask of views of a size (height, width); see `SosLoss.style_targets`."""
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
        """Colors [n, 3] with the colors of their region's style: see `warm_start`.

        Args:
            sh_dc: [n, 3], of some of the scene's Gaussians.
            weights: [n] float64, total blend weights.
            rows: [N] bool, which they are.
            keep_chroma: in luminance alone.
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
        """Renders the share of each region in views; None where the views need none.

        Args:
            rows: [N] bool, Gaussians that the rasterizer has; None for all.
        """
        if not self.each:
            return None
        assert self.regions is not None
        labels = self.regions.labels if rows is None else self.regions.labels[rows]
        return RegionMaps(labels, self.regions.active, rasterizer)


class RegionMaps:
    """Renders what share of each pixel's blend weights the Gaussians of some regions have.

    Blending is linear in the colors: with 1 as the color of a region's Gaussians and 0 as that of all others, three
    regions come with each pass.

    Args:
        labels: [N] uint8, the region of each Gaussian of the rasterizer.
        active: the regions.
        rasterizer: of any kind.
    """

    def __init__(self, labels: Tensor, active: tuple[int, ...], rasterizer: Rasterizer) -> None:
        self.count = len(active)
        self._rasterizer = rasterizer
        self._labels, self._active = labels.to(rasterizer.device), active

    def render(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """[h, w, regions] in 0..1, of a view or some rows of it; exactly 0 where a region has no Gaussian."""
        behind = self._pass(camera, rows, ())
        parts = [
            self._pass(camera, rows, self._active[first : first + 3]) - behind for first in range(0, self.count, 3)
        ]
        return torch.cat(parts, dim=2)[:, :, : self.count].clamp(0, 1)

    def _pass(self, camera: Camera, rows: Rows | None, places: tuple[int, ...]) -> Tensor:
        """Up to three regions. Without any it is what lies behind them, which all have in common to the last bit."""
        rasterizer = self._rasterizer
        colors = torch.zeros((len(self._labels), 3), dtype=rasterizer.dtype, device=rasterizer.device)
        for channel, place in enumerate(places):
            colors[:, channel] = self._labels == place
        return rasterizer.render(colors, camera, rows)


def neighbors_change_by_region(means: Tensor, change: Tensor, weights: Tensor, regions: Regions) -> Tensor:
    """Color changes [N, 3] for the Gaussians that nothing optimizes: those of neighbors in the same region.

    In a region of which nothing is optimized, they are those of any neighbors. Kept Gaussians have none.

    Args:
        means, change: as for `neighbors_change`.
        weights: [N] float64, total blend weights of the optimized Gaussians; 0 for all others.
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
