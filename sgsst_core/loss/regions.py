"""Regions of a scene, each with a style of its own, or kept as it is.

Every Gaussian belongs to one region; those that no selection names are the rest. The loss of a view is the sum over its
regions of the SOS loss with the region's style, where positions weigh as much as the region's Gaussians have of their
blend weights: blending is linear in the colors, so that these weights are rendered, with 1 as the color of the
region's Gaussians and 0 as that of all others. Statistics of one region hold nothing of another, but for what features
see beyond its border.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.loss.mixture import StyleMixture
from sgsst_core.scene.split import Refinement, parents_of


@dataclass(frozen=True)
class Region:
    """One region, as it was asked for.

    Attributes:
        name: for people.
        select: which Gaussians it was to have, in words; empty for the rest.
        style: None for the job's own.
        weight: of its style in the loss, above 0.
        freeze: Whether its Gaussians keep their colors.
        selected: Gaussians that its own selection names, of which later regions may have taken some.
    """

    name: str
    select: str = ""
    style: StyleMixture | None = None
    weight: float = 1.0
    freeze: bool = False
    selected: int = 0


@dataclass(frozen=True)
class Regions:
    """The regions of a scene.

    Attributes:
        every: the rest, then the others in the order in which they were given.
        labels: [N] uint8, the place among them of the region that a Gaussian belongs to.
        active: places of those that have a loss of their own; known from `resolved` on.
        frozen_in_view: a view sees Gaussians that are kept; likewise.
    """

    every: tuple[Region, ...]
    labels: Tensor
    active: tuple[int, ...] = ()
    frozen_in_view: bool = False

    @property
    def frozen(self) -> Tensor:
        """Mask [N] bool of the Gaussians whose colors must not change."""
        by_region = torch.tensor([region.freeze for region in self.every])
        return by_region[self.labels.long()]

    @property
    def mapped(self) -> bool:
        """Whether views need a map of each active region; one region that is everything is an ordinary job."""
        return len(self.active) > 1 or self.frozen_in_view or self.every[self.active[0]].weight != 1

    def members(self, place: int) -> Tensor:
        """[N] bool, Gaussians of the region at a place."""
        return self.labels == place

    def refined(self, refinement: Refinement | None) -> Regions:
        """Of the scene as it was refined: the parts of a Gaussian are in its region."""
        if refinement is None:
            return self
        return replace(self, labels=self.labels[parents_of(refinement.pieces)])

    def resolved(self, weights: Tensor) -> Regions:
        """With the Gaussians of regions that no view sees added to the rest, but for those that are kept.

        Args:
            weights: [N] float64, total blend weights.

        Raises:
            SettingsError: every Gaussian that a view sees is frozen.
        """
        labels = self.labels.clone()
        for place, region in enumerate(self.every):
            own = labels == place
            if place and not region.freeze and not bool((weights[own] > 0).any()):
                labels[own] = 0
        seen = torch.bincount(labels[weights > 0].long(), minlength=len(self.every)) > 0
        active = tuple(place for place, region in enumerate(self.every) if seen[place] and not region.freeze)
        if not active:
            raise SettingsError(
                "Every Gaussian that a view sees is frozen: nothing would change. Freeze fewer regions."
            )
        kept = any(bool(seen[place]) for place, region in enumerate(self.every) if region.freeze)
        return replace(self, labels=labels, active=active, frozen_in_view=kept)


def check_regions(regions: Regions, sh_attenuation: float = 0.0) -> None:
    """Prove that there is something to stylize, as far as that is known without a look at the views.

    Args:
        sh_attenuation: by which spherical harmonics fade.

    Raises:
        SettingsError: every Gaussian is frozen, or some are and all are to fade.
    """
    if sh_attenuation and bool(regions.frozen.any()):
        raise SettingsError(
            f"--sh-attenuation {sh_attenuation:g} changes the Gaussians of every region, and some are frozen. "
            "Leave out one of the two."
        )
    if bool(regions.frozen.all()):
        names = ", ".join(region.name for region in regions.every if region.freeze)
        raise SettingsError(f"Every Gaussian is frozen ({names}): nothing would change. Freeze fewer regions.")
