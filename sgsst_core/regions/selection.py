"""Selection of Gaussians by image masks, position or property, as a mask [N] bool.

Gaussians vote on image masks with their blend weights. The vote of a Gaussian is the fraction of its blend weights in
the masked views that lies where masks are white. Most Gaussians are clearly inside or outside. Gaussians on which views
disagree, and those that no masked view shows, follow the majority of their neighbors. The border of the selection is
therefore smooth rather than scattered.

Positions are compared in float64, and boundaries are included. NaN is never selected.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera

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


def count_votes(
    rasterizer: Rasterizer, cameras: Sequence[Camera], masks: Sequence[Callable[[], Tensor]], gaussians: int
) -> tuple[Tensor, Tensor]:
    """Return each Gaussian's blend weights summed over white mask pixels, and over all pixels: two [N] float64.

    Args:
        rasterizer: Rasterizer of the scene.
        cameras: Cameras of the masked views.
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
        means: [N, 3].
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
    _, nearest = cKDTree(places[decided]).query(places[open_], k=count, workers=torch.get_num_threads())
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
