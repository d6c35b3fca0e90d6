"""Subject of a scene: its Gaussians without strays and background, and their extent."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy import ndimage
from torch import Tensor

from sgsst_core.scene.gaussians import Scene, sampled_rows
from sgsst_core.scene.rotations import rotations

#: Number of Gaussians sampled to compute the extent, which is then accurate to well under 1 %, and maximum number of
#: points stored in a `Subject`.
_SAMPLE, _POINTS = 100_000, 20_000
#: Weight quantile at which areas and lengths are capped, so that a few needles or sheets do not dominate.
_LARGEST = 0.98
#: A point farther from the center than this many weighted median distances is background. An object's own points lie
#: within 3 (a long thin stick reaches 2); a room or a sky behind an object reaches 10 to 1000.
_REACH = 4.0
#: Maximum number of cells along the longest side of the grid that determines connected pieces.
_CELLS = 32
#: Minimum fraction of the weight in a cell; lighter cells connect nothing.
_LEAST_CELL = 1e-5
#: Minimum fraction of the weight in a piece; lighter pieces are stray.
_LEAST_PIECE = 0.01
#: Minimum fraction of the weight to keep. If more would be removed, the scene has no strays but consists of pieces.
_LEAST_LEFT = 0.5
#: A Gaussian extends to where its alpha falls below this.
_VISIBLE = 0.03
#: Directions for computing the extent: 7 degrees apart, which is accurate to 0.7 % for a ball.
_DIRECTIONS = 300


@dataclass(frozen=True)
class Subject:
    """Object that an orbit looks at. All values are float64, in world units.

    Attributes:
        points: [P, 3], means of a sample of its Gaussians.
        weights: [P], surface area that each point represents (opacity times area), normalized to a sum of 1.
        hull: [D, 3], outermost point of the subject in each of D directions, including the extents of Gaussians.
        left_out: Fraction of the scene's weight that is stray or background.
    """

    points: Tensor
    weights: Tensor
    hull: Tensor
    left_out: float

    @cached_property
    def size(self) -> float:
        """Largest distance between two points of the hull."""
        return float(torch.cdist(self.hull, self.hull).amax())

    def holds(self, means: Tensor) -> Tensor:
        """Return the mask [N] bool of points [N, 3] that lie in the bounding box of the subject."""
        low, high = self.hull.amin(0), self.hull.amax(0)
        return ((means >= low.to(means)) & (means <= high.to(means))).all(1)


def find_subject(scene: Scene) -> Subject:
    """Find the subject of a scene with at least one Gaussian."""
    rows = sampled_rows(len(scene), _SAMPLE)
    points = scene.means[rows].double()
    # a length of e^60 is practically infinite, and its square does not overflow
    lengths = scene.scales[rows].double().clamp(-60, 60).exp()
    opacities = torch.sigmoid(scene.opacities[rows].double())
    ordered = lengths.sort(dim=1).values
    areas = ordered[:, 1] * ordered[:, 2]
    weights = opacities * areas.clamp_max(quantile(areas, opacities + 1e-12, _LARGEST))
    # makes the result defined for a scene whose Gaussians are all invisible
    weights = weights / weights.amax().clamp_min(1e-300) + 1e-12
    weights = weights / weights.sum()
    inside = _without_strays(points, weights)
    longest = quantile(ordered[:, 2][inside], weights[inside], _LARGEST)
    half_axes = rotations(scene.quats[rows][inside].double()) * lengths[inside].clamp_max(longest)[:, None]
    reach = (2 * (opacities[inside] / _VISIBLE).clamp_min(1).log()).sqrt()
    hull = _hull(points[inside], half_axes, reach)
    left_out = float(weights[~inside].sum())
    points, weights = points[inside], weights[inside]
    some = sampled_rows(len(points), _POINTS)
    return Subject(points[some], weights[some] / weights[some].sum(), hull, left_out)


def quantile(values: Tensor, weights: Tensor, fraction: float) -> float:
    """Return the smallest of `values` [P] at which the cumulative `weights` [P] reach `fraction` of their sum."""
    ordered, order = values.sort()
    running = weights[order].cumsum(0)
    index = torch.searchsorted(running, fraction * running[-1])
    return float(ordered[index.clamp(max=len(values) - 1)])


def spread_directions(count: int) -> Tensor:
    """Return [count, 3] float64 unit vectors, evenly spread over the sphere (Fibonacci spiral, Gonzalez 2010)."""
    order = torch.arange(count, dtype=torch.float64) + 0.5
    height = 1 - 2 * order / count
    angle = order * math.pi * (1 + math.sqrt(5))
    across = (1 - height**2).sqrt()
    return torch.stack([across * angle.cos(), across * angle.sin(), height], dim=1)


def _without_strays(points: Tensor, weights: Tensor) -> Tensor:
    """Return the mask [P] bool of points [P, 3] that are neither background nor in isolated pieces."""
    middle = torch.tensor([quantile(points[:, axis], weights, 0.5) for axis in range(3)], dtype=torch.float64)
    distances = (points - middle).norm(dim=1)
    median = quantile(distances, weights, 0.5)
    reach = _REACH * median if median > 0 else quantile(distances, weights, 0.99)
    inside: Tensor = distances <= reach
    while True:  # each removal makes the grid finer, which may separate more pieces
        rows = inside.nonzero()[:, 0]
        connected = _pieces(points[rows], weights[rows])
        if bool(connected.all()) or float(weights[rows[connected]].sum()) < _LEAST_LEFT * float(weights[rows].sum()):
            return inside
        inside[rows[~connected]] = False


def _pieces(points: Tensor, weights: Tensor) -> Tensor:
    """Return the mask [P] bool of points in pieces with enough weight; a piece is a connected set of grid cells."""
    low = points.amin(0)
    side = float((points.amax(0) - low).amax())
    cells = min(_CELLS, max(4, round(len(points) ** (1 / 3))))  # keeps random points connected
    if not side > 0:
        return torch.ones(len(points), dtype=torch.bool)
    cell = ((points - low) / side * cells).long().clamp_max(cells - 1)
    flat = ((cell[:, 0] * cells + cell[:, 1]) * cells + cell[:, 2]).numpy()
    held = np.bincount(flat, weights.numpy(), cells**3)
    touching = np.ones((3, 3, 3), dtype=bool)
    labels, _ = ndimage.label((held > _LEAST_CELL * held.sum()).reshape(cells, cells, cells), touching)
    by_piece = np.bincount(labels.ravel(), held)
    large = by_piece >= _LEAST_PIECE * held.sum()
    large[0] = False  # the empty and light cells
    near = ndimage.binary_dilation(large[labels], touching)  # includes the faint fringe around
    return torch.from_numpy(near.ravel()[flat])


def _hull(points: Tensor, half_axes: Tensor, reach: Tensor) -> Tensor:
    """Return the outermost points of ellipsoids in many directions, [D, 3].

    Args:
        points: [P, 3], centers.
        half_axes: [P, 3, 3], half axes of one standard deviation as columns.
        reach: [P], standard deviations from the center to the surface.
    """
    largest = reach * half_axes.norm(dim=1).amax(1)
    hull = []
    # in batches, because each direction needs a value per Gaussian
    for directions in spread_directions(_DIRECTIONS).split(16):
        along = points @ directions.T
        # skip Gaussians that end before the center of another one in all of these directions
        rows = (along + largest[:, None] >= along.amax(0)).any(1).nonzero()[:, 0]
        ends = torch.einsum("pij,di->pdj", half_axes[rows], directions)
        widths = ends.norm(dim=2)
        best = (along[rows] + reach[rows, None] * widths).argmax(0)
        column = torch.arange(len(directions))
        outwards = ends[best, column] / widths[best, column].clamp_min(1e-300)[:, None]
        best = rows[best]
        hull.append(points[best] + reach[best, None] * torch.einsum("dij,dj->di", half_axes[best], outwards))
    return torch.cat(hull)
