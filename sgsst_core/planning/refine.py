"""Which Gaussians are cut into smaller ones before a job (`Settings.refine`), and into how many.

A Gaussian can carry one color from each side, so that no stroke is finer than it. Those are cut that are large where
the views show them, as far as the loss's gradient asks for different colors within them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.planning.plan import Decision
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.split import MOST_PIECES, Refinement, piece_counts, pieces_to
from sgsst_core.scene.subject import rotations
from sgsst_core.settings import Settings

#: What the unstylized picture must keep, dB, in each measured view.
LEAST_PSNR = 40.0
#: Sizes that are tried, standard deviations in pixels of the views, from the coarsest. Finer than the last one, a
#: Gaussian is hardly larger than the pixels that are averaged in it.
SIZES = tuple(256 * 2 ** (-step / 4) for step in range(30))
#: Gaussians that all views together show in fewer pixels carry no stroke.
_LEAST_WEIGHT = 8.0
#: Of one Gaussian; a flat one in the most pieces along both axes.
_MOST_CHILDREN = MOST_PIECES**2
#: A Gaussian's deviation over its distance from a camera that shows it: beyond, its parts lie elsewhere in the picture
#: than the projection of the whole, which takes the perspective as linear about the center.
_LARGEST_REACH = 1.0
#: Of the gradient's magnitude under a Gaussian, what must cancel in its sum; with less, it asks for one color.
_LEAST_DISAGREEMENT = 0.1
#: Gaussians whose sizes are computed together: some tens of megabytes in float64.
_CHUNK = 1 << 17


class Footprints:
    """What views show of each Gaussian, added up view by view in memory that does not grow with their number.

    Attributes:
        weights: [N] float64, blend weights over all pixels, in pixels.
        reach: [N] float64, its largest deviation over its depth, in the view where that is most.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        self.weights = torch.zeros(len(scene), dtype=torch.float64)
        self.reach = torch.zeros(len(scene), dtype=torch.float64)
        self._squares = torch.zeros((len(scene), 3), dtype=torch.float64)

    def add(self, camera: Camera, weights: Tensor) -> None:
        """Count a view; weights [N] of `Rasterizer.survey` on the CPU."""
        for part in (weights > 0).nonzero()[:, 0].split(_CHUNK):
            lengths, reach = axes_in_view(self._scene, part, camera)
            own = weights[part].double()
            self.weights[part] += own
            self._squares[part] += own[:, None] * lengths.square()
            self.reach[part] = torch.maximum(self.reach[part], reach)

    @property
    def parts(self) -> tuple[Tensor, Tensor]:
        """What adds up over views: [N, 4]; and what is the largest: [N]."""
        return torch.cat([self.weights[:, None], self._squares], dim=1), self.reach

    def take(self, sums: Tensor, reach: Tensor) -> None:
        """Have the `parts` of all ranks together."""
        self.weights, self._squares, self.reach = sums[:, 0].contiguous(), sums[:, 1:].contiguous(), reach

    @property
    def lengths(self) -> Tensor:
        """[N, 3] float64: deviation of each axis in pixels, root of the mean square over what the views show of it."""
        return (self._squares / self.weights.clamp_min(1e-300)[:, None]).sqrt()


def axes_in_view(scene: Scene, rows: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Of some Gaussians that a view shows, the axes' deviations in pixels [n, 3], and the largest over depth [n].

    As the rasterizer projects them, but for its limit on directions far beside the image. What float64 cannot hold
    (huge Gaussians) is infinite.
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


def disagreement(rasterizer: Rasterizer, camera: Camera, image_gradient: Tensor) -> tuple[Tensor, Tensor]:
    """How much of a picture's gradient [H, W, 3] cancels under each Gaussian, and how much there is: both [N] float64.

    There is sum |g| w over pixels and channels, w the blend weights; of it |sum g w| reaches the Gaussian's color. The
    difference is what its pixels disagree about. Two passes of the rasterizer, of |g| and of g: G-Style (Kovács,
    Hermosilla, Raidou 2024) cuts by the magnitude of gradients, too, which it accumulates over steps.
    """
    whole = rasterizer.color_gradient(image_gradient.abs(), camera).double()
    summed = rasterizer.color_gradient(image_gradient, camera).double().abs()
    return (whole - summed).clamp_min(0).sum(dim=1).cpu(), whole.sum(dim=1).cpu()


def candidates(footprints: Footprints, splittable: Tensor, cancels: Tensor, there_is: Tensor) -> Tensor:
    """[N] bool, Gaussians that may be cut.

    Args:
        splittable: see `can_be_split`.
        cancels, there_is: of the gradient, see `disagreement`, over all views.
    """
    asked = cancels > _LEAST_DISAGREEMENT * there_is
    large = footprints.weights >= _LEAST_WEIGHT
    return splittable & asked & large & (footprints.reach <= _LARGEST_REACH)


def most_children(weights: Tensor) -> Tensor:
    """[N], what each Gaussian may become: those that views show in so few pixels carry no stroke.

    Args:
        weights: [N], blend weights over all pixels of all views.
    """
    return (weights / _LEAST_WEIGHT).clamp(1, _MOST_CHILDREN)


def choose_pieces(
    lengths: Tensor, allowed: Tensor, cancels: Tensor, most: Tensor, budget: int
) -> tuple[Tensor, float | None]:
    """Pieces [N, 3] uint8 of each Gaussian, and the size in pixels to which they were cut; None where none is.

    Round after round all that are allowed are cut to a smaller size, but for those that would become more than they
    may: blobs, which are cut along three axes where views need two. In the round that the budget does not hold, those
    go first that disagree most for each Gaussian that they would become.

    Args:
        lengths: [N, 3], see `Footprints`.
        allowed: [N] bool.
        cancels: [N], see `disagreement`.
        most: [N], what each may become at most, see `most_children`.
        budget: Gaussians that there may be.
    """
    rows = allowed.nonzero()[:, 0]
    own, rest = lengths[rows], budget - (len(lengths) - len(rows))
    found, size = torch.ones((len(rows), 3), dtype=torch.uint8), None
    for smaller in SIZES:
        following = pieces_to(own, smaller)
        following = torch.where((piece_counts(following) <= most[rows])[:, None], following, found)
        more = piece_counts(following) - piece_counts(found)
        room = rest - int(piece_counts(found).sum())
        if int(more.sum()) <= room:
            size = smaller if bool((more > 0).any()) else size
            found = following
            continue
        order = torch.argsort(cancels[rows] / more.clamp_min(1), descending=True, stable=True)
        taken = order[more[order].cumsum(0) <= room]
        taken = taken[more[taken] > 0]
        found[taken] = following[taken]
        size = smaller if len(taken) else size
        break
    pieces = torch.ones((len(lengths), 3), dtype=torch.uint8)
    pieces[rows] = found
    return pieces, size if bool((pieces > 1).any()) else None


def refine_decision(refinement: Refinement, settings: Settings) -> Decision:
    """The line of a plan that tells what was cut."""
    before, item = len(refinement.pieces), "refined Gaussians"
    back = f"; {refinement.taken_back:,} stay whole, whose parts would change the picture"
    back = back if refinement.taken_back else ""
    if not refinement.split or refinement.psnr is None:
        return Decision(item, "none is cut", f"none is large where the gradient asks for several colors{back}")
    return Decision(
        item,
        f"{refinement.split:,} are cut, which makes {refinement.gaussians:,} of {before:,}",
        f"they are larger than {refinement.size:.2g} pixels in the views, and the gradient asks for several colors "
        f"in them; at most {settings.refine:g} times as many were asked for{back}",
        error=f"the unstylized picture has {refinement.psnr:.1f} dB against that of before, no measured view less than "
        f"{refinement.lowest_psnr:.1f} dB",
    )
