"""Gaussians cut into smaller ones that look alike: a grid of children in place of each, its moments kept.

Along one axis with standard deviation s, K children have s / r, stand at x_i and share the parent's weight as w_i, a
Gaussian's weights at equal distances. r follows from K, the weights from

    sum_i w_i x_i = 0,    (s / r)^2 + sum_i w_i x_i^2 = s^2,

so that the children's mixture has the parent's mean and variance, and the distance is the one at which it is closest to
the parent in L2: within 3 % for every K (two children are closest where they are hardly smaller; there are none). Axes
are cut independently of each other: the mixture of all children has the parent's mean and covariance.

A child's opacity is the parent's times the product of w_i r over the axes: its share of the parent's density, which
has its peak r times as high where the deviation is r times as small. Where children cover each other less than fully
this adds up to the parent's alpha to first order in the opacity, and opacities stay in proportion to the weights, so
that the opacity-weighted mixture keeps its moments whatever the opacity. (Children that add up in optical depth,
1 - (1 - a)^(w r), cover more than the parent did in its flanks; those whose lattice has the parent's optical depth look
no more like it than these: docs/performance.md.)
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.subject import rotations

#: Along one axis; a Gaussian has its third at most where it is as thick as it is long.
MOST_PIECES = 32
#: How many times smaller K pieces are: r = _SLOPE K + _START, for which the mixture is within 3 % of the parent.
_SLOPE, _START = 0.35, 0.33
#: Distances of children, in their deviations, among which the best is looked for.
_DISTANCES = np.linspace(1.0, 2.6, 33)
#: Children whose geometry is computed at a time: some tens of megabytes in float64.
_CHUNK = 1 << 18
#: Deviations beyond which positions of children could leave float32 (logarithms): such Gaussians stay whole.
_LARGEST_LOG_SCALE, _SMALLEST_LOG_SCALE = 60.0, -60.0
_FARTHEST = 1e30


@dataclass(frozen=True)
class Cut:
    """One axis in pieces, for a deviation of 1.

    Attributes:
        ratio: by which the children are smaller.
        offsets: [K] float64, ascending, symmetric about 0.
        weights: [K] float64, their sum is 1.
    """

    ratio: float
    offsets: NDArray[np.float64]
    weights: NDArray[np.float64]


@dataclass(frozen=True)
class Refinement:
    """How a scene was refined, for people and to do it again.

    Attributes:
        pieces: [N, 3] uint8 of the scene's Gaussians, along each of their axes: 1 where it is not cut.
        split: Gaussians that were cut.
        gaussians: that there are then.
        size: standard deviation in the views, pixels, to which they were cut, where there was room.
        psnr: of the unstylized picture against that of before, dB, over all measured views; None where nothing was cut.
        lowest_psnr: of one of these views.
        taken_back: Gaussians that were not cut after all, because the picture would have changed too much.
        sh_dc: [M, 3] float32, colors of the refined scene: the parents', fitted to the picture; None for theirs.
    """

    pieces: Tensor
    split: int
    gaussians: int
    size: float | None = None
    psnr: float | None = None
    lowest_psnr: float | None = None
    taken_back: int = 0
    sh_dc: Tensor | None = None

    def of(self, scene: Scene) -> Scene:
        """The scene as it was refined."""
        found = split(scene, self.pieces)
        return found if self.sh_dc is None else replace(found, sh_dc=self.sh_dc)


def piece_counts(pieces: Tensor) -> Tensor:
    """[N] int64, how many Gaussians each becomes."""
    return pieces.long().prod(dim=1)


def parents_of(pieces: Tensor) -> Tensor:
    """[M] int64, of which Gaussian each of a split scene comes; ascending."""
    return torch.repeat_interleave(piece_counts(pieces))


def can_be_split(scene: Scene) -> Tensor:
    """[N] bool: Gaussians whose children have finite positions and sizes whatever their number."""
    sane = (scene.scales < _LARGEST_LOG_SCALE).all(dim=1) & (scene.scales > _SMALLEST_LOG_SCALE).all(dim=1)
    return sane & (scene.means.abs() < _FARTHEST).all(dim=1) & (scene.quats != 0).any(dim=1)


def split(scene: Scene, pieces: Tensor) -> Scene:
    """A scene with its Gaussians cut along their axes; children stand in their parent's place.

    What is in one piece stays as it is, to the bit. Colors, spherical harmonics and orientation are the parent's.

    Args:
        pieces: [N, 3] uint8, 1 to `MOST_PIECES` but not 2; more than 1 only of Gaussians that `can_be_split`.

    Raises:
        ValueError: pieces of another shape or number, or of a Gaussian that cannot be cut.
    """
    if pieces.shape != (len(scene), 3) or not bool(_is_number_of_pieces(pieces).all()):
        raise ValueError(f"pieces must be [{len(scene)}, 3] of 1, 3 to {MOST_PIECES}")
    counts = piece_counts(pieces)
    cut = (counts > 1).nonzero()[:, 0]
    if not len(cut):
        return scene
    if not bool(can_be_split(scene)[cut].all()):
        raise ValueError("Gaussians of extreme size or place cannot be cut")
    first = counts.cumsum(0) - counts
    found = scene.subset(torch.repeat_interleave(counts))
    ends = counts[cut].cumsum(0)
    start = 0
    while start < len(cut):
        before = int(ends[start - 1]) if start else 0
        stop = max(int(torch.searchsorted(ends, before + _CHUNK, right=True)), start + 1)
        _place_children(scene, pieces, cut[start:stop], counts, first, found)
        start = stop
    return found


def pieces_to(lengths: Tensor, size: Tensor | float) -> Tensor:
    """[n, 3] uint8: the fewest pieces with which lengths [n, 3] become no larger than a size, as far as there are any.

    Args:
        size: positive; a number, or [n, 1].
    """
    numbers = torch.tensor([1, *range(3, MOST_PIECES + 1)], dtype=torch.uint8)
    ratios = torch.tensor([1.0, *(ratio_of(int(number)) for number in numbers[1:])], dtype=torch.float64)
    place = torch.searchsorted(ratios, (lengths.double() / size).contiguous())
    return numbers[place.clamp_max(len(numbers) - 1)]


def ratio_of(number: int) -> float:
    """By how much so many pieces are smaller along their axis."""
    return 1.0 if number == 1 else _SLOPE * number + _START


@functools.cache
def cut_into(number: int) -> Cut:
    """How an axis is cut into so many pieces: 1, or 3 to `MOST_PIECES`."""
    if number == 1:
        return Cut(1.0, np.zeros(1), np.ones(1))
    ratio = ratio_of(number)
    cuts = [cut for distance in _DISTANCES if (cut := _cut_at(number, ratio, distance / ratio)) is not None]
    return min(cuts, key=mixture_error)


def mixture_error(cut: Cut) -> float:
    """L2 distance of the children's mixture from the normal density, relative to that density's norm; exactly."""
    own, both = 1 / cut.ratio**2, 1 + 1 / cut.ratio**2
    apart = cut.offsets[:, None] - cut.offsets
    mixed = cut.weights @ _normal(apart, 2 * own) @ cut.weights
    crossed = cut.weights @ _normal(cut.offsets, both)
    whole = _normal(np.zeros(1), 2.0)[0]
    return float(np.sqrt(max(mixed - 2 * crossed + whole, 0.0) / whole))


def _normal(offsets: NDArray[np.float64], variance: float) -> NDArray[np.float64]:
    density: NDArray[np.float64] = np.exp(-(offsets**2) / (2 * variance)) / np.sqrt(2 * np.pi * variance)
    return density


def _cut_at(number: int, ratio: float, distance: float) -> Cut | None:
    """Children at some distance from each other with a Gaussian's weights and the right variance; None if none has."""
    offsets = np.linspace(-1.0, 1.0, number) * ((number - 1) / 2 * distance)
    squares, wanted = offsets**2, 1 - 1 / ratio**2
    if not squares.min() < wanted < squares.mean():
        return None
    low, high = 0.0, 700 / squares.max()  # the variance falls from that of equal weights
    for _ in range(100):
        middle = (low + high) / 2
        weights = _shares(squares, middle)
        low, high = (middle, high) if weights @ squares > wanted else (low, middle)
    if abs(weights @ squares - wanted) > 1e-12:  # the bracket did not hold it
        return None
    return Cut(ratio, offsets, weights)


def _shares(squares: NDArray[np.float64], slope: float) -> NDArray[np.float64]:
    """Of a Gaussian at some squared distances; their sum is 1."""
    weights = np.exp(-slope * (squares - squares.min()))
    shares: NDArray[np.float64] = weights / weights.sum()
    return shares


def _is_number_of_pieces(pieces: Tensor) -> Tensor:
    return (pieces == 1) | ((pieces >= 3) & (pieces <= MOST_PIECES))


@functools.cache
def _tables() -> tuple[Tensor, Tensor, Tensor]:
    """Offsets [P, P] of the children of so many pieces, logarithms [P, P] of their shares of density, and [P] of r."""
    offsets, shares = torch.zeros(2, MOST_PIECES + 1, MOST_PIECES, dtype=torch.float64)
    ratios = torch.zeros(MOST_PIECES + 1, dtype=torch.float64)
    for number in (1, *range(3, MOST_PIECES + 1)):
        cut = cut_into(number)
        offsets[number, :number] = torch.from_numpy(cut.offsets)
        shares[number, :number] = torch.from_numpy(np.log(cut.weights * cut.ratio))
        ratios[number] = np.log(cut.ratio)
    return offsets, shares, ratios


def _place_children(scene: Scene, pieces: Tensor, rows: Tensor, counts: Tensor, first: Tensor, found: Scene) -> None:
    """Write places, sizes and opacities of the children of some Gaussians into the split scene."""
    offsets, shares, ratios = _tables()
    parent = torch.repeat_interleave(rows, counts[rows])
    number = torch.arange(len(parent)) - torch.repeat_interleave(counts[rows].cumsum(0) - counts[rows], counts[rows])
    into = pieces[parent].long()
    place = torch.stack(
        (number % into[:, 0], number // into[:, 0] % into[:, 1], number // (into[:, 0] * into[:, 1])), 1
    )
    children = first[parent] + number
    sizes = scene.scales[rows].double().exp()
    axes = torch.repeat_interleave(rotations(scene.quats[rows].double()) * sizes[:, None, :], counts[rows], dim=0)
    shift = torch.einsum("nij,nj->ni", axes, offsets[into, place])
    found.means[children] = (scene.means[parent].double() + shift).float()
    found.scales[children] = (scene.scales[parent].double() - ratios[into]).float()
    # The logit of a product, from logarithms: it neither vanishes for a faint parent nor reaches 1 for an opaque one.
    logit = scene.opacities[parent].double()
    log = torch.nn.functional.logsigmoid(logit) + shares[into, place].sum(dim=1)
    found.opacities[children] = (log - torch.log(-torch.expm1(log))).float()
