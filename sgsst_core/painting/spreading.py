"""Change of the Gaussians that painted views do not determine, from the change of those that they do.

Two parts add up. A map of colors says how a color changes anywhere: an affine function of all colors, and one more for
each of some clusters of colors, blended smoothly. It carries night, or another hue of all blue things. What the
neighbors in place and color change beyond this map is local, such as a stroke: it is added, and fades with the distance
to them.
"""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

#: Clusters of colors, and the standard deviation in 0..1 over which their maps blend.
_CLUSTERS, _SOFTNESS = 16, 0.08
#: Resistance of a cluster's map to differing from that of all colors, relative to the confidence of its Gaussians, and
#: to that of so many more.
_RIDGE, _PRIOR = 0.01, 100.0
#: Neighbors of a Gaussian; distances in place are in `_PLACE` of the scene's extent, those in color in `_COLOR`.
_NEIGHBORS, _PLACE, _COLOR = 24, 0.2, 0.1
#: Size of a cell in these units, and how much farther than the nearest neighbors those that are used may be.
_CELL, _APPROXIMATION = 0.3, 2.0
#: Size of a cell of places alone, in the scene's extent.
_BLOCK = 0.01
#: Distance, in the scene's extent, of a number of known Gaussians over which the neighbors' own change fades.
_FADE, _NEAR = 0.1, 8
#: Confidence from which on a Gaussian is a neighbor, and the greatest number of such Gaussians, and of cells of one.
_LEAST, _MOST = 0.05, 200_000
#: Gaussians on which clusters are chosen, and rounds of k-means.
_SAMPLED, _ROUNDS = 20_000, 20
#: Gaussians processed at a time.
_CHUNK = 1 << 16


class Spreading:
    """Function from the change of known Gaussians to that of all, prepared once.

    In large scenes, what the neighbors add is computed once for all Gaussians in a cell of place and color, and its
    fading once for all in a cell of places.

    Args:
        means: [N, 3], places.
        colors: [N, 3], DC colors before the change.
        confidence: [N] in 0..1: how much the painted views determine a Gaussian's color.
    """

    def __init__(self, means: Tensor, colors: Tensor, confidence: Tensor) -> None:
        self._colors, confidence = colors.double().clamp(0, 1).cpu(), confidence.double().cpu()
        places = means.double().cpu()
        known = (confidence > min(_LEAST, 0.5 * float(confidence.max()))).nonzero()[:, 0]
        generator = torch.Generator().manual_seed(0)
        if len(known) > _MOST:
            known = known[torch.randperm(len(known), generator=generator)[:_MOST]].sort().values
        self._known, self._confidence = known, confidence[known]
        self._centers = _clusters(self._colors[known], self._confidence, generator)
        ordered = places[:: max(len(places) // 100_000, 1)]
        low, high = torch.quantile(ordered, torch.tensor([0.1, 0.9], dtype=torch.float64), dim=0)
        places = (places - low) / (float((high - low).norm()) or 1.0)
        features = torch.cat([places / _PLACE, self._colors / _COLOR], dim=1)
        self._cells, centers = _cells(features, _CELL)
        distance, self._nearest = _neighbors(features[known], centers, _NEIGHBORS)
        scale = distance[:, distance.shape[1] // 2, None].clamp_min(1e-9)
        votes = self._confidence[self._nearest] * torch.exp(-0.5 * (distance / scale).square())
        self._votes = votes / votes.sum(dim=1, keepdim=True).clamp_min(1e-300)
        blocks, centers = _cells(places, _BLOCK)
        away = _neighbors(places[known], centers, _NEAR)[0][blocks, -1:]
        self._fade = torch.exp(-(away / _FADE).square())

    def __call__(self, change: Tensor) -> Tensor:
        """Return the change [N, 3] of all Gaussians, given that of the known ones in rows of [N, 3]."""
        own = change.double().cpu()[self._known]
        maps = self._maps(own)
        beyond = own - self._mapped(self._colors[self._known], maps)
        blocks = zip(self._votes.split(_CHUNK), self._nearest.split(_CHUNK), strict=True)
        local = torch.cat([(votes[:, :, None] * beyond[nearest]).sum(dim=1) for votes, nearest in blocks])
        mapped = torch.cat([self._mapped(colors, maps) for colors in self._colors.split(_CHUNK)])
        return (mapped + self._fade * local[self._cells]).to(change)

    def _maps(self, change: Tensor) -> Tensor:
        """Return affine maps of color [1 + K, 4, 3], of all known Gaussians and of each cluster, that fit a change."""
        colors, weight = self._colors[self._known], self._confidence[:, None]
        everywhere = _fitted(colors, weight, change, (colors * weight).sum(dim=0) / weight.sum(), 1e-6)
        remaining, members = change - _terms(colors) @ everywhere, weight * _memberships(colors, self._centers)
        clusters = enumerate(self._centers)
        maps = [_fitted(colors, members[:, index, None], remaining, center, _RIDGE) for index, center in clusters]
        return torch.stack([everywhere, *maps])

    def _mapped(self, colors: Tensor, maps: Tensor) -> Tensor:
        """Return the change [n, 3] of colors by the maps."""
        blend = torch.cat([torch.ones_like(colors[:, :1]), _memberships(colors, self._centers)], dim=1)
        own = (blend @ maps.flatten(1)).view(-1, 4, 3)
        return (_terms(colors)[:, :, None] * own).sum(dim=1)


def _terms(colors: Tensor) -> Tensor:
    return torch.cat([colors, torch.ones_like(colors[:, :1])], dim=1)


def _fitted(colors: Tensor, weight: Tensor, change: Tensor, center: Tensor, ridge: float) -> Tensor:
    """Return the affine map of color [4, 3] that fits a change best, and hardly depends on color away from a center."""
    terms = _terms(colors - center)
    resist = ridge * (float(weight.sum()) + _PRIOR) * torch.eye(4, dtype=torch.float64)
    resist[3, 3] = ridge * _PRIOR
    map: Tensor = torch.linalg.solve((terms * weight).T @ terms + resist, (terms * weight).T @ change)
    map[3] -= center @ map[:3]
    return map


def _cells(features: Tensor, size: float) -> tuple[Tensor, Tensor]:
    """Return the cell of each row [N], and the mean row of each cell [M, d], given rows of up to six values.

    Up to `_MOST` rows have a cell each.
    """
    if len(features) <= _MOST:
        return torch.arange(len(features)), features
    steps = (features / size).floor().clamp(-512, 511).long() + 512
    keys = (steps * 1024 ** torch.arange(features.shape[1])).sum(dim=1)
    _, cells, counts = torch.unique(keys, return_inverse=True, return_counts=True)
    sums = torch.zeros(len(counts), features.shape[1], dtype=features.dtype).index_add_(0, cells, features)
    return cells, sums / counts[:, None]


def _neighbors(known: Tensor, rows: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Return distances and indices [M, k] of the nearest known rows, each at most 1 + `_APPROXIMATION` as far."""
    count = min(count, len(known))
    tree = cKDTree(known.numpy())
    results = tree.query(rows.numpy(), k=count, eps=_APPROXIMATION, workers=torch.get_num_threads())
    distance, nearest = (torch.as_tensor(each).reshape(-1, count) for each in results)
    return distance, nearest


def _memberships(colors: Tensor, centers: Tensor) -> Tensor:
    """Return how much each color [N, 3] belongs to each cluster, [N, K] with rows that add up to 1."""
    return torch.softmax(-torch.cdist(colors, centers).square() / (2 * _SOFTNESS**2), dim=1)


def _clusters(colors: Tensor, weights: Tensor, generator: torch.Generator) -> Tensor:
    """Return centers [K, 3] of weighted colors by k-means, seeded by k-means++ (Arthur and Vassilvitskii, 2007)."""
    rows = torch.randperm(len(colors), generator=generator)[:_SAMPLED]
    colors, weights = colors[rows], weights[rows]
    centers = colors[torch.multinomial(weights, 1, generator=generator)]
    while len(centers) < min(_CLUSTERS, len(colors)):
        away = torch.cdist(colors, centers).amin(dim=1).square()
        centers = torch.cat([centers, colors[torch.multinomial(weights * away + 1e-12, 1, generator=generator)]])
    for _ in range(_ROUNDS):
        own = torch.cdist(colors, centers).argmin(dim=1)
        total = torch.zeros(len(centers), dtype=colors.dtype).index_add_(0, own, weights)
        sums = torch.zeros_like(centers).index_add_(0, own, colors * weights[:, None])
        centers = torch.where(total[:, None] > 0, sums / total[:, None].clamp_min(1e-300), centers)
    return centers
