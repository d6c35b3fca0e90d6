"""Choice of the Gaussians to split before a job (`Settings.refine`), and of the number of pieces.

A Gaussian has a single color per viewing direction, so strokes cannot be finer than a Gaussian. Gaussians that are
large in the views are split if the gradient of the loss asks for different colors within them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.progress import Decision
from sgsst_core.refine.split import MAX_PIECES, Refinement, piece_counts, pieces_to
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rotations import rotations
from sgsst_core.settings import Settings

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
        weights: [N] float64, blend weights summed over all pixels, in pixels.
        reach: [N] float64, maximum over views of the largest deviation divided by depth.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.weights = torch.zeros(len(scene), dtype=torch.float64)
        self.reach = torch.zeros(len(scene), dtype=torch.float64)
        self._squares = torch.zeros((len(scene), 3), dtype=torch.float64)

    def add(self, camera: Camera, weights: Tensor) -> None:
        """Add a view, given weights [N] of `Rasterizer.survey` on the CPU."""
        for rows in (weights > 0).nonzero()[:, 0].split(_CHUNK):
            lengths, reach = axes_in_view(self._scene, rows, camera)
            added = weights[rows].double()
            self.weights[rows] += added
            self._squares[rows] += added[:, None] * lengths.square()
            self.reach[rows] = torch.maximum(self.reach[rows], reach)

    @property
    def sums(self) -> tuple[Tensor, Tensor]:
        """Accumulated values to be reduced over ranks: [N, 4] by sum, and [N] by maximum."""
        return torch.cat([self.weights[:, None], self._squares], dim=1), self.reach

    def replace(self, sums: Tensor, reach: Tensor) -> None:
        """Replace the accumulated values by the reduced ones of all ranks, in the format of `sums`."""
        self.weights, self._squares, self.reach = sums[:, 0].contiguous(), sums[:, 1:].contiguous(), reach

    @property
    def lengths(self) -> Tensor:
        """[N, 3] float64, deviation of each axis in pixels: root mean square over the views, weighted by visibility."""
        return (self._squares / self.weights.clamp_min(1e-300)[:, None]).sqrt()


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
    back = f"; {refinement.reverted:,} are not split, because their parts would change the image"
    back = back if refinement.reverted else ""
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
