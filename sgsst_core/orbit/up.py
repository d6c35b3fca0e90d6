"""Estimate of a scene's up direction, for files that do not store one."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from sgsst_core.orbit.subject import Subject, quantile

#: Up in most captures, since COLMAP's y points down.
USUAL_UP = (0.0, -1.0, 0.0)
#: Directions this close to a world axis are replaced by it, because captures are mostly aligned by hand.
_SNAP = math.cos(math.radians(10))
#: Thickness of a ground layer as a fraction of the subject's size, and its maximum distance from the subject's end, as
#: fractions of the subject's size and of its height.
_LAYER, _END, _END_OF_HEIGHT = 0.01, 0.12, 0.25
#: Minimum fraction of the subject's area, seen from above, that the ground must lie under. Maximum of the same fraction
#: for a layer at the opposite end, relative to the ground's.
_GROUND, _OTHER_END = 0.7, 0.6
#: Cells along the longer side of a grid over a layer.
_CELLS = 24
#: A scene with a larger fraction of background or strays is not taken for a standing object.
_WHOLE = 0.03
#: A subject counts as standing if its length is at least this multiple of its width (by standard deviation).
_STANDS = 1.6
#: A standing subject has a foot at its lower end. Thickness of the layers at both ends as a fraction of the length,
#: minimum ratio of the foot's area to that of the other end, and minimum fraction of the whole subject's area seen from
#: above.
_FOOT, _WIDER, _LEAST_FOOT = 0.015, 1.3, 0.05
#: Minimum foot area, as a fraction of the whole, of a subject that lies along its length, such as a car on its wheels.
_LIES = 0.5


@dataclass(frozen=True)
class Up:
    """Up direction of a scene, with the reason for it.

    Attributes:
        direction: [3] float64, unit length.
        reason: Display text, such as "a flat layer lies under all of it".
        sure: Whether the scene determines the direction; False if it relies on the usual convention.
        ground: Whether there is a ground under the subject, which hides it from below.
    """

    direction: Tensor
    reason: str
    sure: bool = True
    ground: bool = False

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

    The ground plane determines it. Without one, the long axis of the subject and its wider end do; else it is -y, the
    usual convention.
    """
    axes = _principal_axes(subject)
    ground = _ground(subject, [*axes.T, *torch.eye(3, dtype=torch.float64)])
    if ground is not None:
        return Up(_snapped(ground), "there is a flat layer below the whole subject, and none above", ground=True)
    usual = torch.tensor(USUAL_UP, dtype=torch.float64)
    spreads = ((subject.points - _mean(subject)) @ axes).square().mul(subject.weights[:, None]).sum(0).sqrt()
    longer = float(spreads[2] / spreads[1].clamp_min(1e-300)) if float(spreads[2]) > 0 else 1.0
    if longer < _STANDS or subject.left_out > _WHOLE:
        return Up(usual, "neither a ground nor a long axis was found, and most captures point this way", sure=False)
    long = axes[:, 2]
    ends = [_foot(subject, long), _foot(subject, -long)]
    lying = abs(float(long @ usual)) < 0.5 and _foot(subject, usual) >= max(_LIES, _WIDER * max(ends))
    if lying:
        return Up(usual, f"the subject is {longer:.1f} times as long as wide, and rests lengthwise on a broad foot")
    stands = f"the subject is {longer:.1f} times as tall as wide"
    if max(ends) > max(_LEAST_FOOT, _WIDER * min(ends)):
        up = long if ends[0] > ends[1] else -long
        return Up(_snapped(up), f"{stands}, and its foot is {_times(max(ends), min(ends))} the other end")
    up = long if _habit(long) > 0 else -long
    return Up(_snapped(up), f"{stands}; both ends are alike, and most captures point this way", sure=False)


def _times(larger: float, smaller: float) -> str:
    return f"{larger / smaller:.1f} times as broad as" if larger < 100 * smaller else "broader than"


def _habit(direction: Tensor) -> float:
    """Return a positive number if a direction is the usual one of its axis: -y (COLMAP), +z (Blender) or +x."""
    x, y, z = (float(value) for value in direction)
    return -y if abs(y) >= max(abs(x), abs(z)) else z if abs(z) >= abs(x) else x


def _snapped(direction: Tensor) -> Tensor:
    """Return the nearest world axis if it is close, else the direction itself."""
    direction = direction / direction.norm()
    largest = int(direction.abs().argmax())
    if float(direction[largest].abs()) < _SNAP:
        return direction
    axis = torch.zeros(3, dtype=torch.float64)
    axis[largest] = direction[largest].sign()
    return axis


def _mean(subject: Subject) -> Tensor:
    return (subject.weights[:, None] * subject.points).sum(0)


def _principal_axes(subject: Subject) -> Tensor:
    """Return the principal axes [3, 3] as unit column vectors, shortest axis first."""
    return _axes_of(subject.points, subject.weights)


def _axes_of(points: Tensor, weights: Tensor) -> Tensor:
    """Return the principal axes [3, 3] of weighted points as columns, shortest first."""
    weights = weights / weights.sum()
    offsets = points - (weights[:, None] * points).sum(0)
    largest = offsets.abs().amax().clamp_min(1e-300)  # squares of very small or large scenes would under- or overflow
    offsets = offsets / largest
    axes: Tensor = torch.linalg.eigh((weights[:, None] * offsets).T @ offsets).eigenvectors
    return axes


def _ground(subject: Subject, candidates: Sequence[Tensor]) -> Tensor | None:
    """Return up [3] from a flat layer at an end of an axis; None if there is none, or if layers disagree."""
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
    return best if all(float(best @ up) > 0.9 for _, up in layers) else None


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
    cell = ((flat - low) / side * _CELLS).long().clamp_max(_CELLS - 1)
    cells = cell[:, 0] * _CELLS + cell[:, 1]
    return len(cells[rows].unique()) / len(cells.unique())


def _foot(subject: Subject, up: Tensor) -> float:
    """Return the area of the lowest points as a fraction of the subject's area: convex hulls, seen from above."""
    heights = subject.points @ up
    flat = subject.points @ _across(up)
    # quantiles, so that a few strays do not count as a foot
    low, high = (quantile(heights, subject.weights, fraction) for fraction in (0.001, 0.999))
    return _area(flat[heights <= low + _FOOT * (high - low)]) / max(_area(flat), 1e-300)


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
