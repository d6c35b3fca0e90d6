"""Splitting Gaussians into grids of smaller ones with the same appearance and moments.

Along an axis with standard deviation s, a parent is split into K children with deviation s / r, at equally spaced
positions x_i. Child i has the fraction w_i of the parent's weight; the w_i are values of a Gaussian function at the
x_i. K determines r, and the weights follow from

    sum_i w_i x_i = 0,    (s / r)^2 + sum_i w_i x_i^2 = s^2,

so the mixture of the children has the parent's mean and variance. The spacing is the one at which the mixture is
closest to the parent in L2: within 3 % for every K. (K = 2 is not used: with two children, the mixture is closest if
they are hardly smaller than the parent.) Axes are split independently, so the mixture of all children has the parent's
mean and covariance.

A child's opacity is the parent's times the product of w_i r over the axes. The factor r is due to the density, whose
peak is r times as high if the deviation is r times as small. As long as children do not hide each other completely,
their alphas add up to the parent's, to first order in the opacity. Opacities stay proportional to the weights, so the
opacity-weighted mixture keeps its moments at any opacity.

Two alternatives are no better (benchmarks/results/README.md). Children that add up in optical depth, with opacity
1 - (1 - a)^(w r), cover more than the parent in its tails. Children whose lattice has the parent's optical depth are
no closer to the parent than these.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rotations import rotations

#: Maximum number of pieces along one axis. Isotropic Gaussians get at most a third as many per axis, because the number
#: of their children is limited too (`choice.max_children`).
MAX_PIECES = 32
#: K pieces are smaller than the parent by the factor r = _SLOPE K + _START, for which the mixture is within 3 % of the
#: parent.
_SLOPE, _START = 0.35, 0.33
#: Candidate spacings of children, in units of their deviation.
_DISTANCES = np.linspace(1.0, 2.6, 33)
#: Number of children whose geometry is computed at a time; takes some tens of megabytes in float64.
_CHUNK = 1 << 18
#: Limits of log scale and position. Gaussians beyond them are not split, because their children could leave the range
#: of float32.
_LARGEST_LOG_SCALE, _SMALLEST_LOG_SCALE = 60.0, -60.0
_FARTHEST = 1e30


@dataclass(frozen=True)
class AxisSplit:
    """Division of one axis into pieces, for a parent with deviation 1.

    Attributes:
        ratio: Factor by which children are smaller.
        offsets: [K] float64, positions of the children, ascending and symmetric about 0.
        weights: [K] float64 with sum 1.
    """

    ratio: float
    offsets: NDArray[np.float64]
    weights: NDArray[np.float64]


@dataclass(frozen=True)
class Refinement:
    """Record of how a scene was refined, for display and to repeat the refinement.

    Attributes:
        pieces: [N, 3] uint8, number of pieces of each Gaussian along each of its axes; 1 if not split.
        split: Number of Gaussians that were split.
        gaussians: Number of Gaussians after splitting.
        size: Projected standard deviation in pixels to which Gaussians were split, as far as the budget allowed; None
            if none was split.
        psnr: PSNR in dB of unstylized renders of the refined scene against the original one, over all compared views;
            None if nothing was split.
        lowest_psnr: PSNR of the worst of these views.
        reverted: Number of Gaussians that were left whole because splitting them would have changed the image too
            much.
        sh_dc: [M, 3] float32, colors of the refined scene, fitted to renders of the original scene. None if children
            have their parents' colors.
    """

    pieces: Tensor
    split: int
    gaussians: int
    size: float | None = None
    psnr: float | None = None
    lowest_psnr: float | None = None
    reverted: int = 0
    sh_dc: Tensor | None = None

    def of(self, scene: Scene) -> Scene:
        """Return the refined scene."""
        refined = split(scene, self.pieces)
        return refined if self.sh_dc is None else replace(refined, sh_dc=self.sh_dc)


def piece_counts(pieces: Tensor) -> Tensor:
    """Return the number of Gaussians into which each Gaussian is split, [N] int64."""
    return pieces.long().prod(dim=1)


def parents_of(pieces: Tensor) -> Tensor:
    """Return the parent's index for each Gaussian of a split scene, [M] int64, ascending."""
    return torch.repeat_interleave(piece_counts(pieces))


def can_be_split(scene: Scene) -> Tensor:
    """Return the mask [N] bool of Gaussians whose children have finite positions and sizes for any number of pieces."""
    sane = (scene.scales < _LARGEST_LOG_SCALE).all(dim=1) & (scene.scales > _SMALLEST_LOG_SCALE).all(dim=1)
    return sane & (scene.means.abs() < _FARTHEST).all(dim=1) & (scene.quats != 0).any(dim=1)


def split(scene: Scene, pieces: Tensor) -> Scene:
    """Split Gaussians along their axes; children replace their parent in order.

    Gaussians with one piece per axis remain bit-identical. Children inherit color, spherical harmonics and orientation.

    Args:
        pieces: [N, 3] uint8, 1 or 3 to `MAX_PIECES`; more than 1 only for Gaussians with `can_be_split`.

    Raises:
        ValueError: If `pieces` has another shape or value, or a Gaussian cannot be split.
    """
    usable = (pieces == 1) | ((pieces >= 3) & (pieces <= MAX_PIECES))
    if pieces.shape != (len(scene), 3) or not bool(usable.all()):
        raise ValueError(f"pieces must be [{len(scene)}, 3] of 1, 3 to {MAX_PIECES}")
    counts = piece_counts(pieces)
    parents = (counts > 1).nonzero()[:, 0]
    if not len(parents):
        return scene
    if not bool(can_be_split(scene)[parents].all()):
        raise ValueError("Gaussians of extreme size or position cannot be split")
    first = counts.cumsum(0) - counts
    result = scene.subset(torch.repeat_interleave(counts))
    ends = counts[parents].cumsum(0)
    start = 0
    while start < len(parents):
        before = int(ends[start - 1]) if start else 0
        stop = max(int(torch.searchsorted(ends, before + _CHUNK, right=True)), start + 1)
        _place_children(scene, pieces, parents[start:stop], counts, first, result)
        start = stop
    return result


def pieces_to(lengths: Tensor, size: Tensor | float) -> Tensor:
    """Return the smallest piece counts [n, 3] uint8 that reduce lengths to a size, or the maximum if none suffices.

    Args:
        lengths: [n, 3].
        size: Positive target length; a number, or [n, 1].
    """
    numbers = torch.tensor([1, *range(3, MAX_PIECES + 1)], dtype=torch.uint8)
    ratios = torch.tensor([1.0, *(ratio_of(int(number)) for number in numbers[1:])], dtype=torch.float64)
    index = torch.searchsorted(ratios, (lengths.double() / size).contiguous())
    return numbers[index.clamp_max(len(numbers) - 1)]


def ratio_of(number: int) -> float:
    """Return r, the factor by which children are smaller along an axis that is split into `number` pieces."""
    return 1.0 if number == 1 else _SLOPE * number + _START


@functools.cache
def split_axis(number: int) -> AxisSplit:
    """Return the division of an axis into `number` pieces, which is 1, or 3 to `MAX_PIECES`."""
    if number == 1:
        return AxisSplit(1.0, np.zeros(1), np.ones(1))
    ratio = ratio_of(number)
    divisions = [
        division for distance in _DISTANCES if (division := _split_axis_at(number, ratio, distance / ratio)) is not None
    ]
    return min(divisions, key=mixture_error)


def mixture_error(division: AxisSplit) -> float:
    """Return the L2 distance of the children's mixture from the normal density, relative to that density's norm.

    It is computed in closed form.
    """
    child, both = 1 / division.ratio**2, 1 + 1 / division.ratio**2
    apart = division.offsets[:, None] - division.offsets
    mixed = division.weights @ _normal(apart, 2 * child) @ division.weights
    crossed = division.weights @ _normal(division.offsets, both)
    parent = _normal(np.zeros(1), 2.0)[0]
    return float(np.sqrt(max(mixed - 2 * crossed + parent, 0.0) / parent))


def _normal(offsets: NDArray[np.float64], variance: float) -> NDArray[np.float64]:
    density: NDArray[np.float64] = np.exp(-(offsets**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    return density


def _split_axis_at(number: int, ratio: float, distance: float) -> AxisSplit | None:
    """Return the division with spacing `distance` that preserves the parent's variance; None if there is none."""
    offsets = np.linspace(-1.0, 1.0, number) * ((number - 1) / 2 * distance)
    squares, wanted = offsets**2, 1 - 1 / ratio**2
    if not squares.min() < wanted < squares.mean():
        return None
    low, high = 0.0, 700 / squares.max()  # the variance decreases from that of equal weights
    for _ in range(100):
        middle = (low + high) / 2
        weights = np.exp(-middle * (squares - squares.min()))
        weights = weights / weights.sum()
        low, high = (middle, high) if weights @ squares > wanted else (low, middle)
    if abs(weights @ squares - wanted) > 1e-12:  # the solution was outside the bracket
        return None
    return AxisSplit(ratio, offsets, weights)


@functools.cache
def _tables() -> tuple[Tensor, Tensor, Tensor]:
    """Return tables indexed by piece count: child offsets [P + 1, P], log(w r) [P + 1, P] and log(r) [P + 1]."""
    offsets, log_weights = torch.zeros(2, MAX_PIECES + 1, MAX_PIECES, dtype=torch.float64)
    ratios = torch.zeros(MAX_PIECES + 1, dtype=torch.float64)
    for number in (1, *range(3, MAX_PIECES + 1)):
        division = split_axis(number)
        offsets[number, :number] = torch.from_numpy(division.offsets)
        log_weights[number, :number] = torch.from_numpy(np.log(division.weights * division.ratio))
        ratios[number] = np.log(division.ratio)
    return offsets, log_weights, ratios


def _place_children(scene: Scene, pieces: Tensor, rows: Tensor, counts: Tensor, first: Tensor, result: Scene) -> None:
    """Write positions, sizes and opacities of the children of some Gaussians to the split scene."""
    offsets, log_weights, ratios = _tables()
    parent = torch.repeat_interleave(rows, counts[rows])
    number = torch.arange(len(parent)) - torch.repeat_interleave(counts[rows].cumsum(0) - counts[rows], counts[rows])
    into = pieces[parent].long()
    position = torch.stack(
        (number % into[:, 0], number // into[:, 0] % into[:, 1], number // (into[:, 0] * into[:, 1])), 1
    )
    children = first[parent] + number
    sizes = scene.scales[rows].double().exp()
    axes = torch.repeat_interleave(rotations(scene.quats[rows].double()) * sizes[:, None, :], counts[rows], dim=0)
    shift = torch.einsum("nij,nj->ni", axes, offsets[into, position])
    result.means[children] = (scene.means[parent].double() + shift).float()
    result.scales[children] = (scene.scales[parent].double() - ratios[into]).float()
    # Logit of a product, computed from logarithms, so that the opacity neither vanishes for a faint parent nor reaches
    # 1 for an opaque one.
    logit = scene.opacities[parent].double()
    log = torch.nn.functional.logsigmoid(logit) + log_weights[into, position].sum(dim=1)
    result.opacities[children] = (log - torch.log(-torch.expm1(log))).float()
