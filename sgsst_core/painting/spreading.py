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
#: Distance, in the scene's extent, over which the neighbors' own change fades.
_FADE = 0.1
#: Confidence from which on a Gaussian is a neighbor, and the greatest number of such Gaussians.
_LEAST, _MOST = 0.05, 200_000
#: Gaussians on which clusters are chosen, and rounds of k-means.
_SAMPLED, _ROUNDS = 20_000, 20
#: Gaussians processed at a time.
_CHUNK = 1 << 16


class Spreading:
    """Function from the change of known Gaussians to that of all, prepared once.

    Args:
        means: [N, 3], places.
        colors: [N, 3], DC colors before the change.
        confidence: [N] in 0..1: how much the painted views determine a Gaussian's color.
    """

    def __init__(self, means: Tensor, colors: Tensor, confidence: Tensor) -> None:
        self._colors, self._confidence = colors.double().clamp(0, 1).cpu(), confidence.double().cpu()
        places = means.double().cpu()
        known = (self._confidence > _LEAST).nonzero()[:, 0]
        generator = torch.Generator().manual_seed(0)
        if len(known) > _MOST:
            known = known[torch.randperm(len(known), generator=generator)[:_MOST]].sort().values
        self._known = known
        self._centers = _clusters(self._colors[known], self._confidence[known], generator)
        ordered = places[:: max(len(places) // 100_000, 1)]
        low, high = torch.quantile(ordered, torch.tensor([0.1, 0.9], dtype=torch.float64), dim=0)
        extent = float((high - low).norm()) or 1.0
        features = torch.cat([places / (_PLACE * extent), self._colors / _COLOR], dim=1)
        count = min(_NEIGHBORS, len(known))
        workers = torch.get_num_threads()
        distances, nearest = cKDTree(features[known].numpy()).query(features.numpy(), k=count, workers=workers)
        distance, self._nearest = (torch.as_tensor(each).reshape(-1, count) for each in (distances, nearest))
        scale = distance[:, count // 2, None].clamp_min(1e-9)
        votes = self._confidence[known][self._nearest] * torch.exp(-0.5 * (distance / scale).square())
        self._votes = votes / votes.sum(dim=1, keepdim=True).clamp_min(1e-300)
        near = cKDTree(places[known].numpy()).query(places.numpy(), k=min(8, len(known)), workers=workers)[0]
        away = torch.as_tensor(near).reshape(len(places), -1)[:, -1] / extent
        self._fade = torch.exp(-(away / _FADE).square())[:, None]

    def __call__(self, change: Tensor) -> Tensor:
        """Return the change [N, 3] of all Gaussians, given that of the known ones in rows of [N, 3]."""
        known = self._known
        mapped = self._mapped(change.double().cpu())
        beyond = (change.double().cpu() - mapped)[known]
        local = torch.cat(
            [
                (votes[:, :, None] * beyond[nearest]).sum(dim=1)
                for votes, nearest in zip(self._votes.split(_CHUNK), self._nearest.split(_CHUNK), strict=True)
            ]
        )
        return (mapped + self._fade * local).to(change)

    def _mapped(self, change: Tensor) -> Tensor:
        """Return the change [N, 3] float64 by the map of colors that fits the known Gaussians."""
        known, blend = self._known, _memberships(self._colors, self._centers)
        everything = torch.ones_like(change[:, :1])
        middle = (self._colors[known] * self._confidence[known, None]).sum(dim=0) / self._confidence[known].sum()
        result = self._fitted(change, everything, middle, 1e-6)
        remaining = change - result
        for cluster, center in enumerate(self._centers):
            result += self._fitted(remaining, blend[:, cluster, None], center, _RIDGE)
        return result

    def _fitted(self, change: Tensor, membership: Tensor, center: Tensor, ridge: float) -> Tensor:
        """Return the part [N, 3] of a change that an affine function of color explains, for members of a cluster."""
        terms = torch.cat([self._colors - center, torch.ones_like(change[:, :1])], dim=1)
        weight, own = (self._confidence[:, None] * membership)[self._known], terms[self._known]
        resist = ridge * (float(weight.sum()) + _PRIOR) * torch.eye(4, dtype=torch.float64)
        resist[3, 3] = ridge * _PRIOR
        map = torch.linalg.solve((own * weight).T @ own + resist, (own * weight).T @ change[self._known])
        part: Tensor = membership * (terms @ map)
        return part


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
