"""Regions of a scene, each with its own style or frozen.

Every Gaussian belongs to exactly one region; Gaussians that no region selects form the rest. The loss of a view is the
sum of the SOS losses of its regions, each with its own style. In the loss of a region, the weight of a position is the
region's fraction of the blend weights there. Blending is linear in the colors, so this fraction is a rendering with
color 1 for the region's Gaussians and 0 for all others. Other regions affect the statistics of a region only where
receptive fields extend across the border.

A region that differs from the rest in its content weight only is compared with the style together with the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.progress import ANOTHER_LOSS, Decision
from sgsst_core.refine.split import Refinement, parents_of
from sgsst_core.scene.camera import Camera
from sgsst_core.style import Style

#: Number of region maps that are computed by one render, and bytes per pixel of a map at all scales.
_MAPS_PER_RENDER, _MAP_BYTES = 3, 16 / 3


@dataclass(frozen=True)
class Region:
    """Region as requested by the user.

    Attributes:
        select: Text of the selection; empty for the rest.
        style: Style of the region; None for the style of the job.
        weight: Weight of the region's style loss, above 0.
        freeze: Whether the colors of the region's Gaussians are frozen.
        selected: Number of Gaussians that the selection matches. Later regions may have taken over some of them.
        content_weight: Weight of the content term in the region; None for that of the job.
    """

    name: str
    select: str = ""
    style: Style | None = None
    weight: float = 1.0
    freeze: bool = False
    selected: int = 0
    content_weight: float | None = None


@dataclass(frozen=True)
class Regions:
    """All regions of a scene.

    Attributes:
        every: All regions: the rest, followed by the others in the order given by the user.
        labels: [N] uint8, index in `every` of each Gaussian's region.
        active: Indices of regions with a loss of their own; set by `resolved`.
        frozen_in_view: Whether some view sees frozen Gaussians; set by `resolved`.
    """

    every: tuple[Region, ...]
    labels: Tensor
    active: tuple[int, ...] = ()
    frozen_in_view: bool = False

    @property
    def frozen(self) -> Tensor:
        """Mask [N] bool of frozen Gaussians."""
        by_region = torch.tensor([region.freeze for region in self.every])
        return by_region[self.labels.long()]

    @property
    def mapped(self) -> bool:
        """Whether views need a weight map per active region.

        A job with a single active region of weight 1 and no visible frozen Gaussians needs none.
        """
        return len(self.active) > 1 or self.frozen_in_view or self.every[self.active[0]].weight != 1

    @property
    def style_labels(self) -> Tensor:
        """Index of the region with whose Gaussians each Gaussian is compared with the style, [N] uint8."""
        rest = self.every[0]
        indices = [
            0 if region.content_weight is not None and _style_of(region) == _style_of(rest) else index
            for index, region in enumerate(self.every)
        ]
        return torch.tensor(indices, dtype=torch.uint8)[self.labels.long()]

    def content_weights(self, default: float) -> Tensor | None:
        """Return the content weight of each Gaussian, [N] float32; None if all have the default."""
        weights = [default if region.content_weight is None else region.content_weight for region in self.every]
        by_gaussian = torch.tensor(weights)[self.labels.long()]
        return None if bool((by_gaussian == torch.tensor(default)).all()) else by_gaussian

    def members(self, index: int) -> Tensor:
        """Return the mask [N] bool of the Gaussians in the region with this index."""
        return self.labels == index

    def with_checked_styles(self) -> Regions:
        """Check the regions' styles, and convert their images; see `Style.given`."""
        every = [replace(each, style=each.style and Style.given(each.style)) for each in self.every]
        return replace(self, every=tuple(every))

    def refined(self, refinement: Refinement | None) -> Regions:
        """Return the regions after refinement: split Gaussians inherit the region of their parent."""
        if refinement is None:
            return self
        return replace(self, labels=self.labels[parents_of(refinement.pieces)])

    def resolved(self, weights: Tensor) -> Regions:
        """Return the regions with `active` and `frozen_in_view` set.

        If no view sees a region, its Gaussians move to the rest, unless they are frozen.

        Args:
            weights: [N] float64, blend weight of each Gaussian, summed over all views.

        Raises:
            SettingsError: If every Gaussian that a view sees is frozen.
        """
        labels = self.labels.clone()
        for index, region in enumerate(self.every):
            own = labels == index
            if index and not region.freeze and not bool((weights[own] > 0).any()):
                labels[own] = 0
        styled = replace(self, labels=labels).style_labels
        seen = torch.bincount(styled[weights > 0].long(), minlength=len(self.every)) > 0
        active = tuple(index for index, region in enumerate(self.every) if seen[index] and not region.freeze)
        if not active:
            raise SettingsError(
                "Every Gaussian that a view sees is frozen: nothing would change. Freeze fewer regions."
            )
        frozen_in_view = any(bool(seen[index]) for index, region in enumerate(self.every) if region.freeze)
        return replace(self, labels=labels, active=active, frozen_in_view=frozen_in_view)


def _style_of(region: Region) -> tuple[int, float, bool]:
    """Return what determines how a region is compared with a style."""
    return id(region.style), region.weight, region.freeze


def check_regions(regions: Regions, sh_attenuation: float = 0.0, content_weight: float = 1.0) -> None:
    """Check that the regions leave something to stylize, without rendering any view.

    Raises:
        SettingsError: If every Gaussian is frozen, some are frozen while SH attenuation would change all of them, or a
            region has a content weight while the job has no content term.
    """
    if not content_weight and any(region.content_weight for region in regions.every):
        raise SettingsError(
            "--content-weight 0 disables the content term, also in regions with a content weight of their own. "
            "Use --content-weight 1, which is hardly visible."
        )
    if sh_attenuation and bool(regions.frozen.any()):
        raise SettingsError(
            f"--sh-attenuation {sh_attenuation:g} changes the Gaussians of every region, and some are frozen. "
            "Leave out one of the two."
        )
    if bool(regions.frozen.all()):
        names = ", ".join(region.name for region in regions.every if region.freeze)
        raise SettingsError(f"Every Gaussian is frozen ({names}): nothing would change. Freeze fewer regions.")


def region_decisions(regions: Regions, weights: Tensor, cameras: Sequence[Camera]) -> list[Decision]:
    """Return the decisions about the regions as requested, and the cost of their maps.

    Args:
        regions: Regions as requested, which have been `resolved` without an error.
        weights: [N] float64, blend weight of each Gaussian, summed over all views.
        cameras: Cameras of all views that are stylized.
    """
    resolved, lines = regions.resolved(weights), []
    for index, region in enumerate(regions.every):
        requested, members = int(regions.members(index).sum()), resolved.members(index)
        seen = bool((weights[members] > 0).any())
        reason = region.select or "not in any other region"
        lost = region.selected - requested
        if lost > 0:
            reason += f"; {lost:,} more are also in a later region, which takes precedence"
        if index and not requested:
            decision = f"warning: ignored, because it has no Gaussians{' of its own' if lost > 0 else ''}"
        elif region.freeze:
            decision = f"{requested:,} Gaussians stay unchanged"
        elif index and not seen:
            decision = f"warning: ignored, because no view sees its {requested:,} Gaussians; they count as rest"
        elif not seen:
            continue  # the rest is empty
        else:
            fraction = float(weights[members].sum() / weights.sum())
            decision = f"{int(members.sum()):,} of {len(weights):,} Gaussians, {fraction:.1%} of what the views show,"
            decision += f" use {region.style.text if region.style else 'the style'}"
            decision += f", with weight {region.weight:g}" if region.weight != 1 else ""
            decision += "" if region.content_weight is None else f", with content weight {region.content_weight:,g}"
        lines.append(Decision(f"region {region.name}", decision, reason, error=ANOTHER_LOSS))
    if resolved.mapped:
        count = len(resolved.active)
        pixels = sum(camera.width * camera.height for camera in cameras)
        renders = 1 + -(-count // _MAPS_PER_RENDER)  # plus one for the background
        decision = (
            f"statistics of {count} region{'' if count == 1 else 's'} are weighted by each region's fraction of a "
            f"pixel's blend weights; {renders} renders at a view's first visit, "
            f"{int(_MAP_BYTES * count * pixels) / 1e6:.1f} MB for all views"
        )
        lines.append(
            Decision("regions", decision, "otherwise styles would leak into other regions", error=ANOTHER_LOSS)
        )
    return lines
