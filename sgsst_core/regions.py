"""Regions of a scene, each with its own style or frozen, their selection, and their maps in a view.

Every Gaussian belongs to exactly one region; Gaussians that no region selects form the rest. The loss of a view is the
sum of the SOS losses of its regions, each with its own style. In the loss of a region, the weight of a position is the
region's fraction of the blend weights there. Blending is linear in the colors, so this fraction is a rendering with
color 1 for the region's Gaussians and 0 for all others. Other regions affect the statistics of a region only where
receptive fields extend across the border.

A region that differs from the rest in its content weight only is compared with the style together with the rest.

Gaussians are selected by image masks, position, property, or a file of flags, as a mask [N] bool. They vote on image
masks with their blend weights. The vote of a Gaussian is the fraction of its blend weights in the masked views that
lies where masks are white. Most Gaussians are clearly inside or outside. Gaussians on which views disagree, and those
that no masked view shows, follow the majority of their neighbors. The border of the selection is therefore smooth
rather than scattered.

Positions are compared in float64, and boundaries are included. NaN is never selected.
"""

from __future__ import annotations

import operator
import tokenize
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy  # imports its modules at first use
import torch
from numpy.lib.format import open_memmap
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.errors import MaskError, SettingsError
from sgsst_core.files.advice import POINTER, refuse_known
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.progress import ANOTHER_LOSS, Decision
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.refine import Refinement, parents_of
from sgsst_core.scene.camera import Camera
from sgsst_core.style import Style


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
        return self if refinement is None else replace(self, labels=self.labels[parents_of(refinement.pieces)])

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


def region_decisions(regions: Regions, weights: Tensor) -> list[Decision]:
    """Return the decisions about the regions as requested.

    Args:
        regions: Regions as requested, which have been `resolved` without an error.
        weights: [N] float64, blend weight of each Gaussian, summed over all views.
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
        decision = (
            f"statistics of {count} region{'' if count == 1 else 's'} are weighted by each region's fraction of a "
            "pixel's blend weights"
        )
        lines.append(
            Decision("regions", decision, "otherwise styles would leak into other regions", error=ANOTHER_LOSS)
        )
    return lines


#: A Gaussian is inside if its vote is above the first value, and outside if it is below the second.
IN, OUT = 0.6, 0.4
#: Number of neighbors whose majority an undecided or invisible Gaussian follows.
NEIGHBORS = 8
#: Comparisons of a property with a number.
COMPARISONS: dict[str, Callable[[Tensor, float], Tensor]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
    "=": operator.eq,
}


#: Suffix of masks of packed bits; every other file is read as .npy.
BITS_SUFFIX = ".bin"
#: Errors that NumPy raises for malformed headers, such as unclosed brackets, deep nesting and huge shapes.
_HEADER_ERRORS = (OSError, ValueError, TypeError, EOFError, OverflowError, MemoryError, tokenize.TokenError)


def count_votes(
    rasterizer: Rasterizer, cameras: Sequence[Camera], masks: Sequence[Callable[[], Tensor]], gaussians: int
) -> tuple[Tensor, Tensor]:
    """Return each Gaussian's blend weights summed over white mask pixels, and over all pixels: two [N] float64.

    Args:
        masks: Functions that load the mask [H, W] in 0..1 of each view.
        gaussians: N, number of Gaussians of the scene.
    """
    inside, total = (torch.zeros(gaussians, dtype=torch.float64) for _ in range(2))
    for camera, load in zip(cameras, masks, strict=True):
        mask = load().to(rasterizer.device, rasterizer.dtype)
        # The gradient of a rendered color is the contribution of each Gaussian to it: the transpose of blending.
        votes = rasterizer.color_gradient(torch.stack([mask, torch.ones_like(mask), mask], dim=2), camera).cpu()
        inside += votes[:, 0].double()
        total += votes[:, 1].double()
    return inside, total


def decide_by_votes(means: Tensor, inside: Tensor, total: Tensor) -> Tensor:
    """Return which Gaussians are inside, [N] bool.

    If no Gaussian is clearly inside or outside, those with a vote above 0.5 are inside. Gaussians that no masked view
    shows are then outside.

    Args:
        inside: [N], blend weights where masks are white, from `count_votes`.
        total: [N], all blend weights in the masked views.
    """
    share = inside / torch.where(total > 0, total, 1.0)
    shown = total > 0
    decided = shown & ((share > IN) | (share < OUT))
    result = shown & (share > 0.5)
    open_ = ~decided
    if not bool(decided.any()) or not bool(open_.any()):
        return result
    places = means.double().numpy()
    count = min(NEIGHBORS, int(decided.sum()))
    _, nearest = scipy.spatial.cKDTree(places[decided]).query(places[open_], k=count, workers=torch.get_num_threads())
    votes = result[decided][torch.as_tensor(nearest).reshape(-1, count)].double().mean(dim=1)
    result[open_] = torch.where(votes == 0.5, result[open_], votes > 0.5)
    return result


def in_box(means: Tensor, corners: Sequence[float]) -> Tensor:
    """Select positions between two opposite corners x0, y0, z0, x1, y1, z1, in any order."""
    first, second = torch.tensor([corners[:3], corners[3:]], dtype=torch.float64)
    positions = means.double()
    return ((positions >= torch.minimum(first, second)) & (positions <= torch.maximum(first, second))).all(dim=1)


def in_sphere(means: Tensor, sphere: Sequence[float]) -> Tensor:
    """Select positions within distance r of x, y, z."""
    *middle, radius = sphere
    distance: Tensor = (means.double() - torch.tensor(middle, dtype=torch.float64)).norm(dim=1)
    return distance <= radius


def in_half_space(means: Tensor, plane: Sequence[float]) -> Tensor:
    """Select positions with a x + b y + c z >= d."""
    *normal, distance = plane
    height: Tensor = means.double() @ torch.tensor(normal, dtype=torch.float64)
    return height >= distance


def where_property(values: Tensor, sign: str, number: float) -> Tensor:
    """Select values [N] by comparison with a number, which is converted to their dtype so that "=" can match."""
    return COMPARISONS[sign](values, torch.tensor(number).to(values).item()) & ~values.isnan()


def read_mask(path: Path, file: SceneFile) -> Tensor:
    """Read a mask with one flag per row of the scene's file, and return the flags of the scene's Gaussians, [N] bool.

    A file that ends in .bin holds one bit per row: bit `i % 8` (1 is the lowest) of byte `i // 8` is the flag of row
    `i`, and unused bits of the last byte are 0. Other files are .npy arrays of the values 0 and 1.

    Raises:
        MaskError: If the file cannot be read, has another length, or has values other than 0 and 1.
    """
    try:
        refuse_known(path, [POINTER], MaskError)
    except OSError as error:
        raise MaskError(f"{path}: cannot be read: {error.strerror}. Check the path.") from error
    rows = len(file.scene) if file.retained is None else len(file.retained)
    read = _read_bits if path.suffix.lower() == BITS_SUFFIX else _read_npy
    flags = read(path, rows, file.path)
    return torch.from_numpy(np.array(flags if file.retained is None else flags[file.retained]))


def _read_bits(path: Path, rows: int, scene: Path) -> NDArray[np.bool_]:
    expected = (rows + 7) // 8
    with path.open("rb") as file:
        content = file.read(expected + 1)
    size = len(content) if len(content) <= expected else path.stat().st_size
    if size != expected:
        raise MaskError(
            f"{path}: has {size:,} bytes, but {scene} has {rows:,} Gaussians. "
            f"One bit for each makes {expected:,} bytes."
        )
    bits = np.unpackbits(np.frombuffer(content, np.uint8), bitorder="little")
    if bits[rows:].any():
        raise MaskError(f"{path}: has bits after that of the last of {rows:,} Gaussians. They must be 0.")
    return bits[:rows].astype(bool)


def _read_npy(path: Path, rows: int, scene: Path) -> NDArray[np.bool_]:
    try:
        values = open_memmap(path, mode="r")  # reads neither pickles nor archives, as np.load does
    except _HEADER_ERRORS as error:
        raise MaskError(f"{path}: cannot be read as .npy: {error}. Write it with numpy.save.") from error
    if values.dtype.kind not in "biuf":
        raise MaskError(f"{path}: does not hold an array of flags or numbers. Write it with numpy.save.")
    if values.shape != (rows,):
        raise MaskError(
            f"{path}: has the shape {values.shape}, but {scene} has {rows:,} Gaussians. It must be ({rows},)."
        )
    flags: NDArray[np.bool_] = values == 1
    if not bool((flags | (values == 0)).all()):
        raise MaskError(f"{path}: has values other than 0 and 1. Give a flag for each Gaussian.")
    return flags


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
