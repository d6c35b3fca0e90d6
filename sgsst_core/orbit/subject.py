"""Subject of a scene: its Gaussians without strays and background, their extent, and its up direction."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import ConvexHull, QhullError
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
_MIN_CELL = 1e-5
#: Minimum fraction of the weight in a piece; lighter pieces are stray.
_MIN_PIECE = 0.01
#: Minimum fraction of the weight to keep. If more would be removed, the scene has no strays but consists of pieces.
_MIN_LEFT = 0.5
#: A Gaussian extends to where its alpha falls below this.
_VISIBLE = 0.03
#: Directions for computing the extent: 7 degrees apart, which is accurate to 0.7 % for a ball.
_DIRECTIONS = 300
#: Up in most captures, since COLMAP's y points down.
USUAL_UP = (0.0, -1.0, 0.0)
#: Up in programs that model scenes, such as Blender, and in most captures whose axes are not COLMAP's.
_SECOND_UP = (0.0, 0.0, 1.0)
#: Directions this close to a world axis are replaced by it, because captures are mostly aligned by hand. The longest
#: axis of a standing subject shows up less precisely than a ground does: a pose or a drapery tilts it.
_SNAP, _SNAP_STANDING = math.cos(math.radians(10)), math.cos(math.radians(15))
#: Thickness of a ground layer as a fraction of the subject's size, and its maximum distance from the subject's end, as
#: fractions of the subject's size and of its height.
_LAYER, _END, _END_OF_HEIGHT = 0.01, 0.12, 0.25
#: Minimum fraction of the subject's area, seen from above, that the ground must lie under. Maximum of the same fraction
#: for a layer at the opposite end, relative to the ground's.
_GROUND, _OTHER_END = 0.7, 0.6
#: Cells along the longer side of a grid over a layer.
_GROUND_CELLS = 24
#: A scene with a larger fraction of background or strays is not taken for a standing object.
_WHOLE = 0.03
#: A subject counts as standing if its length is at least this multiple of its width (by standard deviation).
_STANDS = 1.6
#: A standing subject has a foot at its lower end. Thickness of the layers at both ends as a fraction of the length,
#: minimum ratio of the foot's area to that of the other end, and minimum fraction of the whole subject's area seen from
#: above.
_FOOT, _WIDER, _MIN_FOOT = 0.015, 1.3, 0.05
#: Thickness of the base on which a subject rests as a fraction of its height, minimum balance of one that rests firmly,
#: and fraction of the largest balance from which on others are similar.
_BASE, _FIRM, _SIMILAR = 0.03, 0.25, 0.75
#: Minimum cosine between two directions that count as the same.
_SAME = 0.8


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
        if bool(connected.all()) or float(weights[rows[connected]].sum()) < _MIN_LEFT * float(weights[rows].sum()):
            return inside
        inside[rows[~connected]] = False


def _pieces(points: Tensor, weights: Tensor) -> Tensor:
    """Return the mask [P] bool of points in pieces with enough weight; a piece is a connected set of grid cells."""
    low, high = points.amin(0), points.amax(0)
    side = float((high - low).amax())
    cells = min(_CELLS, max(4, round(len(points) ** (1 / 3))))  # keeps random points connected
    if not side > 0:
        return torch.ones(len(points), dtype=torch.bool)
    # centered, so that a scene on its side has the same pieces
    cell = (((points - (low + high) / 2) / side + 0.5) * cells).long().clamp(0, cells - 1)
    flat = ((cell[:, 0] * cells + cell[:, 1]) * cells + cell[:, 2]).numpy()
    held = np.bincount(flat, weights.numpy(), cells**3)
    touching = np.ones((3, 3, 3), dtype=bool)
    labels, _ = ndimage.label((held > _MIN_CELL * held.sum()).reshape(cells, cells, cells), touching)
    by_piece = np.bincount(labels.ravel(), held)
    large = by_piece >= _MIN_PIECE * held.sum()
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


@dataclass(frozen=True)
class Up:
    """Up direction of a scene, with the reason for it.

    Attributes:
        direction: [3] float64, unit length.
        reason: Display text, such as "a flat layer lies under all of it".
        sure: Whether the scene determines the direction; False if it relies on the usual convention.
        ground: Whether there is a ground under the subject, which hides it from below.
        other: [3] float64, the second most likely direction if the scene does not determine it; None if it does.
    """

    direction: Tensor
    reason: str
    sure: bool = True
    ground: bool = False
    other: Tensor | None = None

    @property
    def candidates(self) -> list[str]:
        """World axes nearest to the direction and to the other one, such as ["-y", "z"]."""
        directions = [self.direction] if self.other is None else [self.direction, self.other]
        return [Up(_nearest_axis(each), "").name for each in directions]

    @property
    def name(self) -> str:
        """Axis such as "-y", or the three components of another direction."""
        axis = int(self.direction.abs().argmax())
        sign = "-" if self.direction[axis] < 0 else ""
        if float(self.direction[axis].abs()) > 1 - 1e-9:
            return sign + "xyz"[axis]
        return "(" + ", ".join(f"{value:.2f}" for value in self.direction.tolist()) + ")"


def find_up(subject: Subject) -> Up:
    """Estimate the up direction.

    A ground plane shows it, or the wider end of a long subject, unless the subject rests more firmly on another side.
    Without both, it is the only side on which the subject rests firmly. Else it is -y, the usual convention, or one of
    two sides on which it rests about as firmly.
    """
    axes = _axes_of(subject.points, subject.weights)
    world = torch.eye(3, dtype=torch.float64)
    # a subject in front of a background is cut off and doesn't balance
    balances = [(_balance(subject, up), up) for up in (*world, *-world)] if subject.left_out <= _WHOLE else []
    ground, standing = _ground(subject, [*axes.T, *world]), _standing(subject, axes)
    for shown, margin in ((ground, _SIMILAR), (standing, 1.0)):
        if shown is not None:
            others = [balance for balance, up in balances if float(up @ shown.direction) <= _SAME]
            same = [balance for balance, up in balances if float(up @ shown.direction) > _SAME]
            if margin * max([_balance(subject, shown.direction), *same]) >= max(others, default=0.0):
                return shown
    return _resting(balances)


def _resting(balances: Sequence[tuple[float, Tensor]]) -> Up:
    """Return the up direction of a subject without ground or foot, given how firmly it rests on each of its sides."""
    firmest = max((balance for balance, _ in balances), default=0.0)
    usual, second = (torch.tensor(up, dtype=torch.float64) for up in (USUAL_UP, _SECOND_UP))
    similar = [each for each in balances if each[0] >= _SIMILAR * firmest > 0]
    if len(similar) == 1 and firmest >= _FIRM:
        return Up(similar[0][1], "the subject rests firmly on this side, and on no other one")
    similar.sort(key=lambda each: (float(each[1] @ usual) < _SAME, -each[0]))
    likely = [up for _, up in similar] if len(similar) <= 2 else []
    if not likely or firmest < _FIRM or float(likely[0] @ likely[-1]) < 0:  # a panel may stand as well as lie
        likely = [usual, *likely]
    likely = [*likely, usual, second]
    other = next(up for up in likely if float(up @ likely[0]) < _SAME)
    sides = "the subject may rest on several sides" if similar else "neither a ground nor a side to rest on was found"
    return Up(likely[0], f"{sides}, and most captures point this way", sure=False, other=other)


def _standing(subject: Subject, axes: Tensor) -> Up | None:
    """Return the up direction of a subject that stands along the longest of its `axes`; None if it has no long one."""
    long = axes[:, 2]
    offsets = subject.points - (subject.weights[:, None] * subject.points).sum(0)
    spreads = (offsets @ axes).square().mul(subject.weights[:, None]).sum(0).sqrt()
    longer = float(spreads[2] / spreads[1].clamp_min(1e-300)) if float(spreads[2]) > 0 else 1.0
    if longer < _STANDS or subject.left_out > _WHOLE:
        return None
    ends = [_foot(subject, long), _foot(subject, -long)]
    stands = f"the subject is {longer:.1f} times as tall as wide"
    if max(ends) > max(_MIN_FOOT, _WIDER * min(ends)):
        up = long if ends[0] > ends[1] else -long
        broader = f"{max(ends) / min(ends):.1f} times as broad as" if max(ends) < 100 * min(ends) else "broader than"
        return Up(_snapped(up, _SNAP_STANDING), f"{stands}, and its foot is {broader} the other end")
    up = _snapped(long if _habit(long) > 0 else -long, _SNAP_STANDING)
    usual = torch.tensor(USUAL_UP, dtype=torch.float64)
    reason = f"{stands}; both ends are alike, and most captures point this way"
    return Up(up, reason, sure=False, other=usual if abs(float(up @ usual)) < _SNAP else -up)


def _habit(direction: Tensor) -> float:
    """Return a positive number if a direction is the usual one of its axis: -y (COLMAP), +z (Blender) or +x."""
    x, y, z = (float(value) for value in direction)
    return -y if abs(y) >= max(abs(x), abs(z)) else z if abs(z) >= abs(x) else x


def _snapped(direction: Tensor, close: float = _SNAP) -> Tensor:
    """Return the nearest world axis if the cosine to it is at least `close`, else the direction itself."""
    direction = direction / direction.norm()
    axis = _nearest_axis(direction)
    return axis if float(direction @ axis) >= close else direction


def _nearest_axis(direction: Tensor) -> Tensor:
    """Return the world axis [3] nearest to a direction [3]."""
    largest, axis = int(direction.abs().argmax()), torch.zeros(3, dtype=torch.float64)
    axis[largest] = direction[largest].sign()
    return axis


def _axes_of(points: Tensor, weights: Tensor) -> Tensor:
    """Return the principal axes [3, 3] of weighted points as unit columns, shortest first."""
    weights = weights / weights.sum()
    offsets = points - (weights[:, None] * points).sum(0)
    largest = offsets.abs().amax().clamp_min(1e-300)  # squares of very small or large scenes would under- or overflow
    offsets = offsets / largest
    axes: Tensor = torch.linalg.eigh((weights[:, None] * offsets).T @ offsets).eigenvectors
    return axes


def _ground(subject: Subject, candidates: Sequence[Tensor]) -> Up | None:
    """Return the up direction of a flat layer at an end of an axis; None if there is none, or if layers disagree."""
    layers: list[tuple[float, Tensor]] = []
    for axis in candidates:
        for up in (axis, -axis):
            level = _levelled(subject, up)
            if level is None:
                continue
            under, over = _layer(subject, level)[1], _layer(subject, -level)[1]
            if under >= _GROUND and over <= _OTHER_END * under:
                layers.append((under, level))
    if not layers:
        return None
    best = max(layers, key=lambda pair: pair[0])[1]
    if any(float(best @ up) <= 0.9 for _, up in layers):
        return None
    return Up(_snapped(best), "there is a flat layer below the whole subject, and none above", ground=True)


def _levelled(subject: Subject, up: Tensor) -> Tensor | None:
    """Return the normal [3] of the flat layer at the lower end; None if it deviates too much from `up` [3]."""
    level = up
    for _ in range(4):
        rows, _ = _layer(subject, level)
        if int(rows.sum()) < 3:
            return None
        normal = _axes_of(subject.points[rows], subject.weights[rows])[:, 0]
        level = normal if float(normal @ level) > 0 else -normal
    return level if float(level @ up) > 0.8 else None


def _layer(subject: Subject, up: Tensor) -> tuple[Tensor, float]:
    """Return the heaviest layer near the lower end: its points [P] bool, and the fraction of the area above it."""
    heights = subject.points @ up
    heights = heights - heights.amin()
    thickness = _LAYER * subject.size
    if float(heights.amax()) <= 2 * thickness:  # the subject is itself a layer
        return torch.ones_like(heights, dtype=torch.bool), 0.0
    ordered, order = heights.sort()
    running = torch.cat([torch.zeros(1, dtype=torch.float64), subject.weights[order].cumsum(0)])
    end = min(_END * subject.size, _END_OF_HEIGHT * float(heights.amax()))
    starts = torch.linspace(0, max(end - thickness, 0), 25, dtype=torch.float64)
    held = running[torch.searchsorted(ordered, starts + thickness)] - running[torch.searchsorted(ordered, starts)]
    start = float(starts[held.argmax()])
    rows = (heights >= start) & (heights <= start + thickness)
    return rows, _covered_fraction(subject.points, up, rows)


def _covered_fraction(points: Tensor, up: Tensor, rows: Tensor) -> float:
    """Return the area of some of the points [P, 3] (`rows` [P] bool) as a fraction of the area of all, seen from above.

    Areas are counted in grid cells.
    """
    flat = points @ _across(up)
    low = flat.amin(0)
    side = float((flat.amax(0) - low).amax())
    if not side > 0:
        return 0.0
    cell = ((flat - low) / side * _GROUND_CELLS).long().clamp_max(_GROUND_CELLS - 1)
    cells = cell[:, 0] * _GROUND_CELLS + cell[:, 1]
    return len(cells[rows].unique()) / len(cells.unique())


def _foot(subject: Subject, up: Tensor) -> float:
    """Return the area of the lowest points as a fraction of the subject's area: convex hulls, seen from above."""
    flat, base = _base(subject, up, _FOOT)
    return _area(base) / max(_area(flat), 1e-300)


def _balance(subject: Subject, up: Tensor) -> float:
    """Return how firmly the subject rests on its lower end; negative if its center of mass is not above its base.

    It is the distance of the center of mass from the edge of the base, seen from above, relative to the square root of
    the subject's area.
    """
    flat, base = _base(subject, up, _BASE)
    area = _area(flat)
    if not _area(base) > 0:
        return -1.0 if area > 0 else 0.0
    center = (subject.weights[:, None] * flat).sum(0).numpy()
    edges = ConvexHull(base.numpy()).equations
    return -float((edges[:, :2] @ center + edges[:, 2]).max()) / math.sqrt(area)


def _base(subject: Subject, up: Tensor, thickness: float) -> tuple[Tensor, Tensor]:
    """Return all points [P, 2] and the lowest ones, seen from above; `thickness` is a fraction of the height."""
    heights = subject.points @ up
    flat = subject.points @ _across(up)
    # quantiles, so that neither strays nor the few points of a hollow base below its rim count as a foot
    low, high = (quantile(heights, subject.weights, fraction) for fraction in (0.01, 0.99))
    return flat, flat[heights <= low + thickness * (high - low)]


def _area(points: Tensor) -> float:
    """Return the area of the convex hull of points [n, 2]; 0 if they lie on a line."""
    if len(points) < 3:
        return 0.0
    try:
        return float(ConvexHull(points.numpy()).volume)  # in two dimensions, `volume` is the area
    except QhullError:
        return 0.0


def _across(up: Tensor) -> Tensor:
    """Return two unit vectors perpendicular to `up` and each other, [3, 2] as columns."""
    first = torch.zeros(3, dtype=torch.float64)
    first[int(up.abs().argmin())] = 1.0
    first = torch.linalg.cross(up, first)
    first = first / first.norm()
    return torch.stack([first, torch.linalg.cross(up, first)], dim=1)
