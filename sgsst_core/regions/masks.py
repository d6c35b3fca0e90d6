"""Selection of Gaussians by image masks: each Gaussian votes with its blend weights.

The vote of a Gaussian is the fraction of its blend weights in the masked views that lies where masks are white. Most
Gaussians are clearly inside or outside. Gaussians on which views disagree, and those that no masked view shows, follow
the majority of their neighbors. The border of the selection is therefore smooth rather than scattered.
"""

from __future__ import annotations

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
