"""Colors of Gaussians that no view sees: they take the color change of their nearest seen neighbors."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sgsst_core.regions.definition import Regions

#: Number of seen neighbors that determine the color change of an unseen Gaussian.
NEIGHBORS = 8
#: Number of unseen Gaussians processed at a time; their neighbors' changes and weights take some tens of megabytes.
_CHUNK = 1 << 16
#: Cells along each axis of the grid that orders the searches.
_CELLS = 128


def neighbors_change(means: Tensor, change: Tensor, weights: Tensor) -> Tensor:
    """Return color changes for the Gaussians that no view sees.

    Each takes the mean change of its nearest seen neighbors, weighted by their total blend weights: the change of a
    hardly visible Gaussian is determined by only a few pixels.

    Args:
        means: [N, 3].
        change: [N, 3], change by the optimization; rows of unseen Gaussians are ignored.
        weights: [N] float64, total blend weights: 0 for the U unseen Gaussians, positive for at least one other.

    Returns:
        [U, 3] float32.
    """
    seen = weights > 0
    if bool(seen.all()):
        return torch.zeros((0, 3))
    count = min(NEIGHBORS, int(seen.sum()))
    tree = cKDTree(means[seen].double().numpy())
    weights, change, positions = weights[seen], change[seen], means[~seen]
    votes = torch.empty((len(positions), 3))
    for part in _near_each_other(positions).split(_CHUNK):
        _, nearest = tree.query(positions[part].double().numpy(), k=count, workers=torch.get_num_threads())
        votes[part] = _votes(torch.as_tensor(nearest).reshape(-1, count), change, weights).float()
    return votes


def _near_each_other(positions: Tensor) -> Tensor:
    """Return the indices [U] that sort points [U, 3] by the cells of a coarse grid.

    Consecutive neighbor searches then read the same part of the search tree.
    """
    positions = positions.double()
    lowest = positions.amin(dim=0)
    size = (positions.amax(dim=0) - lowest).clamp_min(1e-300)
    cells = ((positions - lowest) / size * (_CELLS - 1)).long()
    return torch.argsort((cells[:, 0] * _CELLS + cells[:, 1]) * _CELLS + cells[:, 2], stable=True)


def _votes(nearest: Tensor, change: Tensor, weights: Tensor) -> Tensor:
    """Return weighted mean changes [U, 3] float64 of seen Gaussians.

    `nearest` [U, K] are their indices into `change` [S, 3] and `weights` [S].
    """
    own = weights[nearest]
    # Relative to the largest weight, so that tiny weights do not underflow.
    fraction = own / own.amax(dim=1, keepdim=True)
    return (change[nearest].double() * fraction[:, :, None]).sum(dim=1) / fraction.sum(dim=1, keepdim=True)


def neighbors_change_by_region(means: Tensor, change: Tensor, weights: Tensor, regions: Regions) -> Tensor:
    """Return color changes for the Gaussians that are not optimized: those of their neighbors in the same region.

    If a region has no optimized Gaussians, neighbors in all regions count. The change of frozen Gaussians is 0.

    Args:
        means: [N, 3], see `neighbors_change`.
        change: [N, 3], see `neighbors_change`.
        weights: [N] float64, total blend weights of the optimized Gaussians; 0 for all others.
        regions: Regions of the scene.

    Returns:
        [N, 3].
    """
    result = torch.zeros_like(change)
    for region in regions.labels[~regions.frozen].unique().tolist():
        members = regions.members(region)
        voters = torch.where(members, weights, 0.0)
        if not bool((voters > 0).any()):
            voters = weights
        rows = members | (voters > 0)
        takes = rows & (voters <= 0)
        result[takes] = neighbors_change(means[rows], change[rows], voters[rows])
    return result
