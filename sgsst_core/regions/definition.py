"""Regions of a scene, each with its own style or frozen.

Every Gaussian belongs to exactly one region; Gaussians that no region selects form the rest. The loss of a view is the
sum of the SOS losses of its regions, each with its own style. In the loss of a region, the weight of a position is the
region's fraction of the blend weights there. Blending is linear in the colors, so this fraction is a rendering with
color 1 for the region's Gaussians and 0 for all others. Other regions affect the statistics of a region only where
receptive fields extend across the border.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.refine.split import Refinement, parents_of
from sgsst_core.style import Style


@dataclass(frozen=True)
class Region:
    """Region as requested by the user.

    Attributes:
        name: Display name.
        select: Text of the selection; empty for the rest.
        style: Style of the region; None for the style of the job.
        weight: Weight of the region's style loss, above 0.
        freeze: Whether the colors of the region's Gaussians are frozen.
        selected: Number of Gaussians that the selection matches. Later regions may have taken over some of them.
    """

    name: str
    select: str = ""
    style: Style | None = None
    weight: float = 1.0
    freeze: bool = False
    selected: int = 0


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
        seen = torch.bincount(labels[weights > 0].long(), minlength=len(self.every)) > 0
        active = tuple(index for index, region in enumerate(self.every) if seen[index] and not region.freeze)
        if not active:
            raise SettingsError(
                "Every Gaussian that a view sees is frozen: nothing would change. Freeze fewer regions."
            )
        frozen_in_view = any(bool(seen[index]) for index, region in enumerate(self.every) if region.freeze)
        return replace(self, labels=labels, active=active, frozen_in_view=frozen_in_view)


def check_regions(regions: Regions, sh_attenuation: float = 0.0) -> None:
    """Check that the regions leave something to stylize, without rendering any view.

    Args:
        regions: Regions of the scene.
        sh_attenuation: SH attenuation, 0 to 1.

    Raises:
        SettingsError: If every Gaussian is frozen, or some are frozen while SH attenuation would change all of them.
    """
    if sh_attenuation and bool(regions.frozen.any()):
        raise SettingsError(
            f"--sh-attenuation {sh_attenuation:g} changes the Gaussians of every region, and some are frozen. "
            "Leave out one of the two."
        )
    if bool(regions.frozen.all()):
        names = ", ".join(region.name for region in regions.every if region.freeze)
        raise SettingsError(f"Every Gaussian is frozen ({names}): nothing would change. Freeze fewer regions.")
