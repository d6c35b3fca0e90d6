"""What a scene is about: its Gaussians without strays and background, and the room that these take."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial.transform import Rotation
from torch import Tensor

from sgsst_core.scene.gaussians import Scene

#: Gaussians that give the extent, to well under a percent, and those of them that are kept as its points.
_SAMPLE, _POINTS = 100_000, 20_000
#: Share of the weight up to which areas and lengths are taken as they are; larger ones count as that one, so that a few
#: needles or sheets decide nothing.
_LARGEST = 0.98
#: A point farther from the middle than this many weighted median distances is background. An object's own points lie
#: within 3 (a long thin stick reaches 2); a room or a sky behind an object reaches 10 to 1000.
_REACH = 4.0
#: Cells along the longest side of a grid in which an object hangs together, at most.
_CELLS = 32
#: Share of the weight that a cell holds at least: fainter ones connect nothing.
_LEAST_CELL = 1e-5
#: Share of the weight that a piece holds at least, or it is stray.
_LEAST_PIECE = 0.01
#: Share of the weight that is left at least; a scene of which more would go has no strays: it is made so.
_LEAST_LEFT = 0.5
#: A Gaussian reaches to where its alpha falls below this.
_VISIBLE = 0.03
#: Directions in which the extent is taken: 7 degrees apart, so that a ball's is right to 0.7 %.
_DIRECTIONS = 300


@dataclass(frozen=True)
class Subject:
    """What an orbit looks at. All float64, in world units.

    Attributes:
        points: [P, 3] means of a sample of its Gaussians.
        weights: [P], how much of its surface each stands for: opacity times area; they add up to 1.
        hull: [D, 3], the outermost points of these Gaussians, extents included, in directions all around.
        left_out: share of the scene's weight that is stray or background.
    """

    points: Tensor
    weights: Tensor
    hull: Tensor
    left_out: float

    @cached_property
    def size(self) -> float:
        """The largest distance of two of its points."""
        return float(torch.cdist(self.hull, self.hull).amax())

    def holds(self, means: Tensor) -> Tensor:
        """[N] bool: which of some points [N, 3] lie in the box around it."""
        low, high = self.hull.amin(0), self.hull.amax(0)
        return ((means >= low.to(means)) & (means <= high.to(means))).all(1)


def find_subject(scene: Scene) -> Subject:
    """The subject of a scene of at least one Gaussian."""
    rows = _sample(len(scene), _SAMPLE)
    points = scene.means[rows].double()
    # beyond e^60 a length is as good as infinite, and its square still fits
    lengths = scene.scales[rows].double().clamp(-60, 60).exp()
    opacities = torch.sigmoid(scene.opacities[rows].double())
    ordered = lengths.sort(dim=1).values
    areas = ordered[:, 1] * ordered[:, 2]
    weights = opacities * areas.clamp_max(quantile(areas, opacities + 1e-12, _LARGEST))
    # a scene of which all Gaussians are invisible is still looked at
    weights = weights / weights.amax().clamp_min(1e-300) + 1e-12
    weights = weights / weights.sum()
    kept = _without_strays(points, weights)
    longest = quantile(ordered[:, 2][kept], weights[kept], _LARGEST)
    turned = rotations(scene.quats[rows][kept].double()) * lengths[kept].clamp_max(longest)[:, None]
    reach = (2 * (opacities[kept] / _VISIBLE).clamp_min(1).log()).sqrt()
    hull = _hull(points[kept], turned, reach)
    left_out = float(weights[~kept].sum())
    points, weights = points[kept], weights[kept]
    some = _sample(len(points), _POINTS)
    return Subject(points[some], weights[some] / weights[some].sum(), hull, left_out)


def quantile(values: Tensor, weights: Tensor, share: float) -> float:
    """The smallest of `values` [P] at which the running sum of `weights` [P] reaches `share` of the whole."""
    ordered, order = values.sort()
    running = weights[order].cumsum(0)
    index = torch.searchsorted(running, share * running[-1])
    return float(ordered[index.clamp(max=len(values) - 1)])


def spread_directions(count: int) -> Tensor:
    """[count, 3] float64 unit vectors, evenly spread over the sphere (on a Fibonacci spiral, after Gonzalez 2010)."""
    place = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * place / count
    angle = place * math.pi * (1 + math.sqrt(5))
    across = (1 - height**2).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), height], dim=1)


def rotations(quats: Tensor) -> Tensor:
    """[P, 3, 3] of quaternions [P, 4], wxyz; of zeros, the identity."""
    nothing = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    given = torch.where((quats != 0).any(1, keepdim=True), quats, nothing)
    turned: Tensor = torch.from_numpy(Rotation.from_quat(given.roll(-1, 1).numpy()).as_matrix())
    return turned


def _sample(total: int, count: int) -> Tensor:
    """Rows of one of each so many Gaussians; which one is chance, seeded: files may hold them in a regular order."""
    step = -(-total // count)
    first = torch.arange(0, total, step)
    chance = torch.randint(step, first.shape, generator=torch.Generator().manual_seed(0))
    return (first + chance).clamp_max(total - 1)


def _without_strays(points: Tensor, weights: Tensor) -> Tensor:
    """[P] bool: which of the points [P, 3] are neither background nor pieces that float by themselves."""
    middle = torch.tensor([quantile(points[:, axis], weights, 0.5) for axis in range(3)], dtype=torch.float64)
    distances = (points - middle).norm(dim=1)
    median = quantile(distances, weights, 0.5)
    reach = _REACH * median if median > 0 else quantile(distances, weights, 0.99)
    kept: Tensor = distances <= reach
    while True:  # without what lies far away, the grid is finer and shows more
        rows = kept.nonzero()[:, 0]
        whole = _pieces(points[rows], weights[rows])
        if bool(whole.all()) or float(weights[rows[whole]].sum()) < _LEAST_LEFT * float(weights[rows].sum()):
            return kept
        kept[rows[~whole]] = False


def _pieces(points: Tensor, weights: Tensor) -> Tensor:
    """[P] bool: which points belong to pieces of some weight; pieces hang together in a grid's cells."""
    low = points.amin(0)
    side = float((points.amax(0) - low).amax())
    cells = min(_CELLS, max(4, round(len(points) ** (1 / 3))))  # so that random points still hang together
    if not side > 0:
        return torch.ones(len(points), dtype=torch.bool)
    place = ((points - low) / side * cells).long().clamp_max(cells - 1)
    flat = ((place[:, 0] * cells + place[:, 1]) * cells + place[:, 2]).numpy()
    held = np.bincount(flat, weights.numpy(), cells**3)
    touching = np.ones((3, 3, 3), dtype=bool)
    labels, _ = ndimage.label((held > _LEAST_CELL * held.sum()).reshape(cells, cells, cells), touching)
    by_piece = np.bincount(labels.ravel(), held)
    large = by_piece >= _LEAST_PIECE * held.sum()
    large[0] = False  # the empty and the faint cells
    near = ndimage.binary_dilation(large[labels], touching)  # with the faint fringe around
    return torch.from_numpy(near.ravel()[flat])


def _hull(points: Tensor, turned: Tensor, reach: Tensor) -> Tensor:
    """[D, 3]: the outermost points of ellipsoids in many directions.

    Args:
        points: [P, 3], the middles.
        turned: [P, 3, 3], half axes of one standard deviation as columns.
        reach: [P], standard deviations to the surface.
    """
    largest = reach * turned.norm(dim=1).amax(1)
    found = []
    for directions in spread_directions(_DIRECTIONS).split(16):  # a few, since each needs a number of every Gaussian
        along = points @ directions.T
        # the others end before another one's middle, in all of these directions
        rows = (along + largest[:, None] >= along.amax(0)).any(1).nonzero()[:, 0]
        ends = torch.einsum("pij,di->pdj", turned[rows], directions)
        widths = ends.norm(dim=2)
        best = (along[rows] + reach[rows, None] * widths).argmax(0)
        column = torch.arange(len(directions))
        outwards = ends[best, column] / widths[best, column].clamp_min(1e-300)[:, None]
        best = rows[best]
        found.append(points[best] + reach[best, None] * torch.einsum("dij,dj->di", turned[best], outwards))
    return torch.cat(found)
