"""Splitting Gaussians into grids of smaller ones with the same appearance and moments.

Along an axis with standard deviation s, a parent is split into K children with deviation s / r, at equally spaced
positions x_i. Child i has the fraction w_i of the parent's weight; the w_i are values of a Gaussian function at the
x_i. K determines r, and the weights follow from

    sum_i w_i x_i = 0,    (s / r)^2 + sum_i w_i x_i^2 = s^2,

so the mixture of the children has the parent's mean and variance. The Gaussian function ends where the mixture is
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

Choice of the Gaussians to split before a job (`Settings.refine`), and of the number of pieces.

A Gaussian has a single color per viewing direction, so strokes cannot be finer than a Gaussian. Gaussians that are
large in the views are split if the gradient of the loss asks for different colors within them.
"""

import functools
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.progress import Decision
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene, rotations
from sgsst_core.settings import Settings

#: Maximum number of pieces along one axis. Isotropic Gaussians get at most a third as many per axis, because the number
#: of their children is limited too (`max_children`).
MAX_PIECES = 32
#: K pieces are smaller than the parent by the factor r = _SLOPE K + _START, for which the mixture is within 3 % of the
#: parent.
_SLOPE, _START = 0.35, 0.33
#: The weights of K pieces end at _END - _FEWER / K deviations of the Gaussian function; fitted to the best ends.
_END, _FEWER = 2.85, 4.2
#: Number of Gaussians that are split at a time. Their children, at most a million, take about 250 MB in float64.
_PARENTS = 1 << 10
#: Limits of log scale and position. Gaussians beyond them are not split, because their children could leave the range
#: of float32.
_LARGEST_LOG_SCALE, _SMALLEST_LOG_SCALE = 60.0, -60.0
_FARTHEST = 1e30


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
    for some in parents.split(_PARENTS):
        _place_children(scene, pieces, some, counts, first, result)
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


def split_axis(number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Divide an axis of a parent with deviation 1 into `number` pieces, which is 1, or 3 to `MAX_PIECES`.

    Returns:
        Positions of the children [K] float64, ascending and symmetric about 0, and their weights [K] with sum 1.
    """
    ratio, positions = ratio_of(number), np.linspace(-1.0, 1.0, number) * (_END - _FEWER / number)
    weights = np.exp(-(positions**2) / 2)
    weights = weights / weights.sum()
    return positions * np.sqrt((1 - 1 / ratio**2) / (weights @ positions**2)), weights


@functools.cache
def _tables() -> tuple[Tensor, Tensor, Tensor]:
    """Return tables indexed by piece count: child offsets [P + 1, P], log(w r) [P + 1, P] and log(r) [P + 1]."""
    offsets, log_weights = torch.zeros(2, MAX_PIECES + 1, MAX_PIECES, dtype=torch.float64)
    ratios = torch.zeros(MAX_PIECES + 1, dtype=torch.float64)
    for number in (1, *range(3, MAX_PIECES + 1)):
        positions, weights = split_axis(number)
        offsets[number, :number] = torch.from_numpy(positions)
        log_weights[number, :number] = torch.from_numpy(np.log(weights * ratio_of(number)))
        ratios[number] = np.log(ratio_of(number))
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


#: Minimum PSNR of the unstylized image in dB, in each measured view.
MIN_PSNR = 40.0
#: Candidate target sizes: projected standard deviations in pixels, coarsest first. A Gaussian below the last one is
#: hardly larger than a pixel.
SIZES = tuple(256 * 2 ** (-step / 4) for step in range(30))
#: Size of the finest strokes: with "auto", Gaussians are not split to smaller ones.
STROKE_SIZE = 4.0
#: Minimum total blend weight of a Gaussian over all views, in pixels; smaller ones are too small for a stroke.
_MIN_WEIGHT = 8.0
#: Maximum number of children: those of a flat Gaussian split into the most pieces along both axes.
_MAX_CHILDREN = MAX_PIECES**2
#: Maximum ratio of a Gaussian's deviation to its distance from a camera that shows it. Beyond it, pieces would be
#: projected elsewhere than the unsplit Gaussian, whose projection linearizes the perspective at its center.
_LARGEST_REACH = 1.0
#: Minimum fraction of the gradient's magnitude under a Gaussian that cancels in its sum. Below it, the Gaussian needs
#: only one color.
_MIN_DISAGREEMENT = 0.1
#: Number of Gaussians whose sizes are computed at a time; takes some tens of megabytes in float64.
_CHUNK = 1 << 17


class Footprints:
    """Sizes of each Gaussian in the views, accumulated view by view in constant memory.

    Attributes:
        sums: [N, 4] float64, to be summed over ranks: blend weights of all pixels, and squared deviations by them.
        reach: [N] float64, maximum over views of the largest deviation divided by depth.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.sums = torch.zeros((len(scene), 4), dtype=torch.float64)
        self.reach = torch.zeros(len(scene), dtype=torch.float64)

    def add(self, camera: Camera, weights: Tensor) -> None:
        """Add a view, given weights [N] of `Rasterizer.survey` on the CPU."""
        for rows in (weights > 0).nonzero()[:, 0].split(_CHUNK):
            lengths, reach = axes_in_view(self._scene, rows, camera)
            added = weights[rows].double()
            self.sums[rows, 0] += added
            self.sums[rows, 1:] += added[:, None] * lengths.square()
            self.reach[rows] = torch.maximum(self.reach[rows], reach)

    @property
    def weights(self) -> Tensor:
        """[N] float64, blend weights summed over all pixels, in pixels."""
        return self.sums[:, 0].contiguous()

    @property
    def lengths(self) -> Tensor:
        """[N, 3] float64, deviation of each axis in pixels: root mean square over the views, weighted by visibility."""
        return (self.sums[:, 1:] / self.weights.clamp_min(1e-300)[:, None]).sqrt()


def axes_in_view(scene: Scene, rows: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return Gaussians' projected axis deviations in pixels [n, 3], and their largest deviation divided by depth [n].

    The projection is the rasterizer's, but does not clamp directions far outside the image. Values that overflow
    float64 (huge Gaussians) become infinite.
    """
    pose = camera.world_to_camera.double()
    centers = scene.means[rows].double() @ pose[:3, :3].T + pose[:3, 3]
    deviations = scene.scales[rows].double().exp()
    axes = pose[:3, :3] @ rotations(scene.quats[rows].double()) * deviations[:, None, :]  # [n, camera axis, own axis]
    depth = centers[:, 2:].clamp_min(torch.finfo(torch.float64).tiny)
    across = camera.fx / depth * (axes[:, 0] - centers[:, :1] / depth * axes[:, 2])
    down = camera.fy / depth * (axes[:, 1] - centers[:, 1:2] / depth * axes[:, 2])
    lengths = torch.hypot(across, down)
    reach = deviations.amax(dim=1) / depth[:, 0]
    return lengths.nan_to_num(torch.inf), reach.nan_to_num(torch.inf)


def finest_size(settings: Settings) -> float:
    """Return the smallest target size in pixels: with "auto", that of the strokes of the finest scale in the loss."""
    if settings.refine != "auto":
        return SIZES[-1]
    finest = next(scale for scale, weight in enumerate(settings.scales or (1.0,)) if weight > 0)
    return STROKE_SIZE * 2.0**finest


def candidates(footprints: Footprints, splittable: Tensor, cancels: Tensor, magnitude: Tensor) -> Tensor:
    """Return the mask [N] bool of Gaussians that may be split.

    Args:
        footprints: Sizes in the views.
        splittable: [N] bool, see `can_be_split`.
        cancels: [N], portion of the gradient that cancels, summed over all views; see `disagreement`.
        magnitude: [N], total of the gradient's magnitude, summed over all views; see `disagreement`.
    """
    disagree = cancels > _MIN_DISAGREEMENT * magnitude
    large = footprints.weights >= _MIN_WEIGHT
    return splittable & disagree & large & (footprints.reach <= _LARGEST_REACH)


def max_children(weights: Tensor) -> Tensor:
    """Return the maximum number of children of each Gaussian, [N]; smaller children would be too small for a stroke.

    Args:
        weights: [N], blend weights over all pixels of all views.
    """
    return (weights / _MIN_WEIGHT).clamp(1, _MAX_CHILDREN)


def choose_pieces(
    lengths: Tensor, allowed: Tensor, cancels: Tensor, most: Tensor, budget: int, finest: float = SIZES[-1]
) -> tuple[Tensor, float | None]:
    """Choose the number of pieces of each Gaussian within a budget.

    In every round, all allowed Gaussians are split to a smaller size, except those that would exceed their maximum
    number of children. (These are mostly isotropic Gaussians, which are split along three axes.) In the round that
    would exceed the budget, Gaussians with the largest disagreement per new Gaussian are split first.

    Args:
        lengths: [N, 3], see `Footprints`.
        allowed: [N] bool, Gaussians that may be split.
        cancels: [N], see `disagreement`.
        most: [N], maximum number of children, see `max_children`.
        budget: Maximum total number of Gaussians.
        finest: Smallest target size in pixels.

    Returns:
        Pieces [N, 3] uint8, and the size in pixels to which Gaussians were split; None if none is split.
    """
    rows = allowed.nonzero()[:, 0]
    allowed_lengths, rest = lengths[rows], budget - (len(lengths) - len(rows))
    chosen, size = torch.ones((len(rows), 3), dtype=torch.uint8), None
    for smaller in (size for size in SIZES if size >= finest):
        following = pieces_to(allowed_lengths, smaller)
        following = torch.where((piece_counts(following) <= most[rows])[:, None], following, chosen)
        more = piece_counts(following) - piece_counts(chosen)
        capacity = rest - int(piece_counts(chosen).sum())
        if int(more.sum()) <= capacity:
            size = smaller if bool((more > 0).any()) else size
            chosen = following
            continue
        order = torch.argsort(cancels[rows] / more.clamp_min(1), descending=True, stable=True)
        taken = order[more[order].cumsum(0) <= capacity]
        taken = taken[more[taken] > 0]
        chosen[taken] = following[taken]
        size = smaller if len(taken) else size
        break
    pieces = torch.ones((len(lengths), 3), dtype=torch.uint8)
    pieces[rows] = chosen
    return pieces, size if bool((pieces > 1).any()) else None


def refine_decision(refinement: Refinement, settings: Settings) -> Decision:
    """Return the plan's line about split Gaussians."""
    before, item = len(refinement.pieces), "refined Gaussians"
    left_whole = f"; {refinement.reverted:,} are not split, because their parts would change the image"
    back = left_whole if refinement.reverted else ""
    if not refinement.split or refinement.psnr is None:
        return Decision(item, "none is split", f"none is large where the gradient calls for several colors{back}")
    budget = "are allowed" if settings.refine == "auto" else "were requested"
    return Decision(
        item,
        f"{refinement.split:,} are split, which turns {before:,} Gaussians into {refinement.gaussians:,}",
        f"they are larger than {refinement.size:.2g} pixels in the views, and the gradient calls for several colors "
        f"in them; at most {settings.growth:g} times as many {budget}{back}",
        error=f"unstylized renders have {refinement.psnr:.1f} dB PSNR against those of the original scene, each "
        f"measured view at least {refinement.lowest_psnr:.1f} dB",
    )
