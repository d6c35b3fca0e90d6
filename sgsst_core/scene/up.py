"""Which way is up in a scene that says nothing about it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from scipy.spatial import ConvexHull, QhullError
from torch import Tensor

from sgsst_core.scene.subject import Subject, quantile

#: Up in most captures: COLMAP's y points down.
USUAL_UP = (0.0, -1.0, 0.0)
#: A direction so near to an axis of the world is that axis: captures are mostly turned upright by hand.
_SNAP = math.cos(math.radians(10))
#: Thickness of the layers that are looked at, as a share of the subject's size; how far from its end one may lie, as a
#: share of its size and of its height.
_LAYER, _END, _END_OF_HEIGHT = 0.01, 0.12, 0.25
#: A ground reaches under so much of the subject, and the layer at the other end over so much less of it.
_GROUND, _OTHER_END = 0.7, 0.6
#: Cells along the longer side of a grid over a layer.
_CELLS = 24
#: A scene of which more is background or stray is no object that could stand.
_WHOLE = 0.03
#: A subject stands where it is so many times as long (by standard deviation) as it is wide.
_STANDS = 1.6
#: What stands has a foot: thickness of the layer at its ends as a share of its length, and how much wider it is there
#: than at the other end, and which share of it a foot takes at least, seen from above.
_FOOT, _WIDER, _LEAST_FOOT = 0.015, 1.3, 0.05
#: What lies on its wheels has its foot under so much of it.
_LIES = 0.5


@dataclass(frozen=True)
class Up:
    """Which way is up, and why.

    Attributes:
        direction: [3] float64, unit length.
        reason: for people, such as "a flat layer lies under all of it".
        sure: False where only habit says so.
        ground: whether a ground lies under the subject, which hides it from below.
    """

    direction: Tensor
    reason: str
    sure: bool = True
    ground: bool = False

    @property
    def name(self) -> str:
        """An axis such as "-y", else the direction's three numbers."""
        place = int(self.direction.abs().argmax())
        sign = "-" if self.direction[place] < 0 else ""
        if float(self.direction[place].abs()) > 1 - 1e-9:
            return sign + "xyz"[place]
        return "(" + ", ".join(f"{value:.2f}" for value in self.direction.tolist()) + ")"


def find_up(subject: Subject) -> Up:
    """Up by the ground, else by the subject's long axis and the wider of its ends, else by habit (-y)."""
    axes = _principal_axes(subject)
    ground = _ground(subject, [*axes.T, *torch.eye(3, dtype=torch.float64)])
    if ground is not None:
        return Up(_snapped(ground), "a flat layer lies under all of it, and none above", ground=True)
    usual = torch.tensor(USUAL_UP, dtype=torch.float64)
    spreads = ((subject.points - _mean(subject)) @ axes).square().mul(subject.weights[:, None]).sum(0).sqrt()
    longer = float(spreads[2] / spreads[1].clamp_min(1e-300)) if float(spreads[2]) > 0 else 1.0
    if longer < _STANDS or subject.left_out > _WHOLE:
        return Up(usual, "nothing shows it, neither a ground nor a long axis, and most captures have it so", sure=False)
    long = axes[:, 2]
    ends = [_foot(subject, long), _foot(subject, -long)]
    lying = abs(float(long @ usual)) < 0.5 and _foot(subject, usual) >= max(_LIES, _WIDER * max(ends))
    if lying:
        return Up(usual, f"it is {longer:.1f} times as long as wide, and rests along its length on a broad foot there")
    stands = f"it stands {longer:.1f} times as tall as wide"
    if max(ends) > max(_LEAST_FOOT, _WIDER * min(ends)):
        up = long if ends[0] > ends[1] else -long
        return Up(_snapped(up), f"{stands}, and its foot is {_times(max(ends), min(ends))} its other end")
    up = long if _habit(long) > 0 else -long
    return Up(_snapped(up), f"{stands}; both ends are alike, and most captures have it so", sure=False)


def _times(larger: float, smaller: float) -> str:
    return f"{larger / smaller:.1f} times as broad as" if larger < 100 * smaller else "broader than"


def _habit(direction: Tensor) -> float:
    """Positive for the sense of an axis that captures use more: -y (COLMAP), z (Blender, nerfstudio), x."""
    x, y, z = (float(value) for value in direction)
    return -y if abs(y) >= max(abs(x), abs(z)) else z if abs(z) >= abs(x) else x


def _snapped(direction: Tensor) -> Tensor:
    """The world's axis where it is near, else the direction."""
    direction = direction / direction.norm()
    place = int(direction.abs().argmax())
    if float(direction[place].abs()) < _SNAP:
        return direction
    axis = torch.zeros(3, dtype=torch.float64)
    axis[place] = direction[place].sign()
    return axis


def _mean(subject: Subject) -> Tensor:
    return (subject.weights[:, None] * subject.points).sum(0)


def _principal_axes(subject: Subject) -> Tensor:
    """[3, 3]: unit vectors as columns, the shortest axis first."""
    return _axes_of(subject.points, subject.weights)


def _axes_of(points: Tensor, weights: Tensor) -> Tensor:
    """Principal axes [3, 3] of weighted points, as columns, the shortest first."""
    weights = weights / weights.sum()
    offsets = points - (weights[:, None] * points).sum(0)
    largest = offsets.abs().amax().clamp_min(1e-300)  # squares of very small or large scenes would vanish or overflow
    offsets = offsets / largest
    axes: Tensor = torch.linalg.eigh((weights[:, None] * offsets).T @ offsets).eigenvectors
    return axes


def _ground(subject: Subject, candidates: Sequence[Tensor]) -> Tensor | None:
    """Up [3] from a flat layer at one end of one of some axes; None where there is none, or more than one."""
    found: list[tuple[float, Tensor]] = []
    for axis in candidates:
        for up in (axis, -axis):
            level = _levelled(subject, up)
            if level is None:
                continue
            under, over = _layer(subject, level)[1], _layer(subject, -level)[1]
            if under >= _GROUND and over <= _OTHER_END * under:
                found.append((under, level))
    if not found:
        return None
    best = max(found, key=lambda pair: pair[0])[1]
    return best if all(float(best @ up) > 0.9 for _, up in found) else None


def _levelled(subject: Subject, up: Tensor) -> Tensor | None:
    """`up` [3] turned to the normal of the flat layer at the lower end; None where it turns away from there."""
    level = up
    for _ in range(4):
        rows, _ = _layer(subject, level)
        if int(rows.sum()) < 3:
            return None
        normal = _axes_of(subject.points[rows], subject.weights[rows])[:, 0]
        level = normal if float(normal @ level) > 0 else -normal
    return level if float(level @ up) > 0.8 else None


def _layer(subject: Subject, up: Tensor) -> tuple[Tensor, float]:
    """The layer of most weight near the lower end: its rows [P] bool, and the share of the subject that it is under."""
    heights = subject.points @ up
    heights = heights - heights.amin()
    thickness = _LAYER * subject.size
    if float(heights.amax()) <= 2 * thickness:  # it is a layer itself
        return torch.ones_like(heights, dtype=torch.bool), 0.0
    ordered, order = heights.sort()
    running = torch.cat([torch.zeros(1, dtype=torch.float64), subject.weights[order].cumsum(0)])
    end = min(_END * subject.size, _END_OF_HEIGHT * float(heights.amax()))
    starts = torch.linspace(0, max(end - thickness, 0), 25, dtype=torch.float64)
    held = running[torch.searchsorted(ordered, starts + thickness)] - running[torch.searchsorted(ordered, starts)]
    start = float(starts[held.argmax()])
    rows = (heights >= start) & (heights <= start + thickness)
    return rows, _share_under(subject.points, up, rows)


def _share_under(points: Tensor, up: Tensor, rows: Tensor) -> float:
    """Of the cells that all points [P, 3] fall into from above, the share that some of them ([P] bool) fall into."""
    flat = points @ _across(up)
    low = flat.amin(0)
    side = float((flat.amax(0) - low).amax())
    if not side > 0:
        return 0.0
    place = ((flat - low) / side * _CELLS).long().clamp_max(_CELLS - 1)
    cells = place[:, 0] * _CELLS + place[:, 1]
    return len(cells[rows].unique()) / len(cells.unique())


def _foot(subject: Subject, up: Tensor) -> float:
    """How much of the subject, seen from above, the hull of its lowest points takes, 0 to 1."""
    heights = subject.points @ up
    flat = subject.points @ _across(up)
    # the lowest of a few strays is no foot
    low, high = (quantile(heights, subject.weights, share) for share in (0.001, 0.999))
    return _area(flat[heights <= low + _FOOT * (high - low)]) / max(_area(flat), 1e-300)


def _area(points: Tensor) -> float:
    """Of the convex hull of points [n, 2]; 0 where they lie on a line."""
    if len(points) < 3:
        return 0.0
    try:
        return float(ConvexHull(points.numpy()).volume)  # in two dimensions the volume is the area
    except QhullError:
        return 0.0


def _across(up: Tensor) -> Tensor:
    """[3, 2]: two unit vectors at right angles to `up` and each other, as columns."""
    first = torch.zeros(3, dtype=torch.float64)
    first[int(up.abs().argmin())] = 1.0
    first = torch.linalg.cross(up, first)
    first = first / first.norm()
    return torch.stack([first, torch.linalg.cross(up, first)], dim=1)
