"""Which Gaussians masks of some views show: each votes by its blend weights.

A Gaussian's share is that part of its blend weights in the masked views that lies where masks are white. Most are in or
out by a wide margin; those between, of which views disagree, follow the majority of their neighbors, and so do those
that no masked view shows: a border runs between Gaussians, not through a cloud of single votes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera

#: A Gaussian of more than the first share of votes is in, of less than the second out.
IN, OUT = 0.6, 0.4
#: Neighbors that decide about a Gaussian between, or not shown.
NEIGHBORS = 8


def count_votes(
    rasterizer: Rasterizer, cameras: Sequence[Camera], masks: Sequence[Callable[[], Tensor]], gaussians: int
) -> tuple[Tensor, Tensor]:
    """Blend weights that lie where masks are white, and all in the masked views: [N], [N] float64.

    Args:
        rasterizer: of a scene of so many Gaussians.
        cameras: of the masked views.
        masks: load the mask [H, W] in 0..1 of each.
    """
    inside, total = (torch.zeros(gaussians, dtype=torch.float64) for _ in range(2))
    for camera, load in zip(cameras, masks, strict=True):
        mask = load().to(rasterizer.device, rasterizer.dtype)
        # The gradient of a rendered color is what a Gaussian contributes to it: the transpose of blending.
        votes = rasterizer.color_gradient(torch.stack([mask, torch.ones_like(mask), mask], dim=2), camera).cpu()
        inside += votes[:, 0].double()
        total += votes[:, 1].double()
    return inside, total


def decide_by_votes(means: Tensor, inside: Tensor, total: Tensor) -> Tensor:
    """[N] bool, which Gaussians at means [N, 3] are in, by votes [N] of `count_votes`.

    Where nothing is decided by a margin, the larger share is; what nothing is known of is out.
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
