"""Orbit cameras around a scene without cameras: its subject, its up direction, and rings of views that fit it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy  # imports its modules at first use
import torch
from torch import Tensor

from sgsst_core.constants import NEAR
from sgsst_core.errors import SettingsError
from sgsst_core.progress import Decision
from sgsst_core.scene.camera import Camera, look_at
from sgsst_core.scene.gaussians import Scene, rotations, sampled_rows

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
#: Up in most captures; and in programs that model scenes, such as Blender, and most captures with other axes.
_CONVENTIONS = ("-y", "z")
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
#: A scene with a larger fraction of background or strays is not taken for a single object.
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
    labels, _ = scipy.ndimage.label((held > _MIN_CELL * held.sum()).reshape(cells, cells, cells), touching)
    by_piece = np.bincount(labels.ravel(), held)
    large = by_piece >= _MIN_PIECE * held.sum()
    large[0] = False  # the empty and light cells
    near = scipy.ndimage.binary_dilation(large[labels], touching)  # includes the faint fringe around
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
    """

    direction: Tensor
    reason: str
    sure: bool = True
    ground: bool = False

    @property
    def axis(self) -> str:
        """World axis nearest to the direction, such as "-y"."""
        axis = int(self.direction.abs().argmax())
        return ("-" if self.direction[axis] < 0 else "") + "xyz"[axis]

    @property
    def candidates(self) -> list[str]:
        """World axis nearest to the direction, or both conventions if the scene does not determine it."""
        return [self.axis] if self.sure else [*_CONVENTIONS]

    @property
    def name(self) -> str:
        """Axis such as "-y", or the three components of another direction."""
        if float(self.direction.abs().amax()) > 1 - 1e-9:
            return self.axis
        return "(" + ", ".join(f"{value:.2f}" for value in self.direction.tolist()) + ")"


def find_up(subject: Subject) -> Up:
    """Estimate the up direction.

    A ground plane shows it, or the wider end of a long subject, unless the subject rests more firmly on another side.
    Without both, it is the only side on which the subject rests firmly. Else it is -y, the usual convention.
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
    firmest = max((balance for balance, _ in balances), default=0.0)
    similar = [up for balance, up in balances if balance >= _SIMILAR * firmest > 0]
    if len(similar) == 1 and firmest >= _FIRM:
        return Up(similar[0], "the subject rests firmly on this side, and on no other one")
    reason = "neither a ground nor one side to rest on was found, and most captures point this way"
    return Up(torch.tensor(USUAL_UP, dtype=torch.float64), reason, sure=False)


def _standing(subject: Subject, axes: Tensor) -> Up | None:
    """Return the up direction of a subject that stands along the longest of its `axes`, on its wider end.

    None if it has no long one, or both ends are alike.
    """
    long = axes[:, 2]
    offsets = subject.points - (subject.weights[:, None] * subject.points).sum(0)
    spreads = (offsets @ axes).square().mul(subject.weights[:, None]).sum(0).sqrt()
    longer = float(spreads[2] / spreads[1].clamp_min(1e-300)) if float(spreads[2]) > 0 else 1.0
    if longer < _STANDS or subject.left_out > _WHOLE:
        return None
    ends = [_foot(subject, long), _foot(subject, -long)]
    if max(ends) <= max(_MIN_FOOT, _WIDER * min(ends)):
        return None
    reason = f"the subject is {longer:.1f} times as tall as wide, and its foot is broader than the other end"
    return Up(_snapped(long if ends[0] > ends[1] else -long, _SNAP_STANDING), reason)


def _snapped(direction: Tensor, close: float = _SNAP) -> Tensor:
    """Return the nearest world axis if the cosine to it is at least `close`, else the direction itself."""
    direction = direction / direction.norm()
    largest, axis = int(direction.abs().argmax()), torch.zeros(3, dtype=torch.float64)
    axis[largest] = direction[largest].sign()
    return axis if float(direction @ axis) >= close else direction


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
    flat = points @ _level_frame(up)[:, :2]
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
    edges = scipy.spatial.ConvexHull(base.numpy()).equations
    return -float((edges[:, :2] @ center + edges[:, 2]).max()) / math.sqrt(area)


def _base(subject: Subject, up: Tensor, thickness: float) -> tuple[Tensor, Tensor]:
    """Return all points [P, 2] and the lowest ones, seen from above; `thickness` is a fraction of the height."""
    heights = subject.points @ up
    flat = subject.points @ _level_frame(up)[:, :2]
    # quantiles, so that neither strays nor the few points of a hollow base below its rim count as a foot
    low, high = (quantile(heights, subject.weights, fraction) for fraction in (0.01, 0.99))
    return flat, flat[heights <= low + thickness * (high - low)]


def _area(points: Tensor) -> float:
    """Return the area of the convex hull of points [n, 2]; 0 if they lie on a line."""
    if len(points) < 3:
        return 0.0
    try:
        return float(scipy.spatial.ConvexHull(points.numpy()).volume)  # in two dimensions, `volume` is the area
    except scipy.spatial.QhullError:
        return 0.0


def _level_frame(up: Tensor) -> Tensor:
    """Return unit vectors as columns [3, 3]: horizontally to the first camera, horizontally to its side, and up.

    The first camera stands in the direction of world z, or of x if up is close to z.
    """
    first = torch.zeros(3, dtype=torch.float64)
    first[2 if abs(float(up[2])) < 0.9 else 0] = 1.0
    first = torch.nn.functional.normalize(first - (first @ up) * up, dim=0)
    return torch.stack([first, torch.linalg.cross(up, first), up], dim=1)


#: Default resolution of an orbit: its views have as many pixels as 1024x768.
RESOLUTION = 1024
#: Height of the 4:3 view that defines the number of pixels, relative to its width.
_PIXELS = 3 / 4
#: Default elevation of a ring in degrees.
ELEVATION = 10.0
#: Focal length relative to the longer side, which determines the distance of the cameras: a field of view of 37
#: degrees, about that of a 50 mm lens. For closer cameras, the front of the subject would hide more of the rest.
_FOCAL = 1.5
#: Margin around the subject, as a factor of its extent in the frame.
_MARGIN = 1.03
#: Aspect ratios (width over height) are powers of `_STEP`, a quarter octave. They are at most `_MAX_STEPS` steps from
#: square, which is 4 to 1.
_STEP, _MAX_STEPS = 2**0.25, 8
#: Minimum distance of the subject's nearest point, as a multiple of the near plane.
_NEAR_MARGIN = 1.1
#: Tangent of the maximum half field of view, for cameras that an explicit radius places inside the subject.
_WIDEST = math.tan(math.radians(50))


def orbit(
    scene: Scene | Subject,
    count: int,
    *,
    up: Sequence[float] = USUAL_UP,
    elevations: Sequence[float] = (ELEVATION,),
    radius: float | None = None,
    width: int | None = None,
    height: int | None = None,
    near: float = 0.2,
) -> list[Camera]:
    """Return cameras on rings around the subject of a scene, all at the same distance and with the same frame.

    Stray Gaussians and background are ignored (`find_subject`). The cameras look at the center of the subject. The
    frame fits it from every camera; its aspect ratio follows the subject's shape, and it has as many pixels as
    1024x768.

    Args:
        count: Number of cameras, distributed over the rings so that neighbors are about equally far apart.
        up: World direction of up. Captures processed by COLMAP have y pointing down, so -y is up.
        elevations: Elevation of each ring above the scene's horizon in degrees, between -90 and 90.
        radius: Distance of the cameras from the center in world units; None for the smallest distance at which the
            subject fits in a field of view of 37 degrees from every camera.
        width: Width of the frame in pixels; None to follow the shape of the subject.
        height: Height of the frame in pixels; None to follow the shape of the subject.
        near: Near plane of the rasterizer in world units; cameras stay at least that far from the subject.

    Raises:
        SettingsError: If count or size are below 1, `up` is zero or not finite, or elevation or radius are out of
            range.

    Example:
        >>> cameras = orbit(load_scene("scene.ply").scene, 8, width=320, height=240)
        >>> len(cameras), cameras[0].width
        (8, 320)
    """
    axis = _checked(count, up, elevations, radius, (width, height))
    subject = scene if isinstance(scene, Subject) else find_subject(scene)
    directions = ring_directions(count, axis, elevations)
    middle = middle_of(subject, axis)
    radius, x, y = _framing(subject, middle, directions, axis, radius, near)
    positions = [middle + radius * direction for direction in directions]
    pixels, shape = _PIXELS * RESOLUTION**2, _shape(x, y)
    columns, rows = width or round(math.sqrt(pixels * shape)), height or round(math.sqrt(pixels / shape))
    focal, side = min(columns / (2 * x), rows / (2 * y)), None if width else RESOLUTION
    return [
        look_at(f"orbit_{i:04d}", position, middle, axis, width=columns, height=rows, focal=focal, resolution=side)
        for i, position in enumerate(positions)
    ]


def cameras_per_ring(count: int, elevations: Sequence[float]) -> list[int]:
    """Distribute `count` cameras over the rings by circumference."""
    lengths = np.cos(np.radians(elevations))
    ends = np.rint(count * lengths.cumsum() / lengths.sum()).astype(int)
    counts: list[int] = np.diff(ends, prepend=0).tolist()
    return counts


def ring_directions(count: int, up: Tensor, elevations: Sequence[float]) -> list[Tensor]:
    """Return unit vectors [3] from the center to the cameras, ring by ring.

    Every second ring is rotated by half the angle between its cameras.
    """
    start, side, _ = _level_frame(up).T
    directions = []
    for ring, (number, elevation) in enumerate(zip(cameras_per_ring(count, elevations), elevations, strict=True)):
        tilt = math.radians(elevation)
        for index in range(number):
            azimuth = 2 * math.pi * (index + 0.5 * (ring % 2)) / number
            level = math.cos(azimuth) * start + math.sin(azimuth) * side
            directions.append(math.cos(tilt) * level + math.sin(tilt) * up)
    return directions


def middle_of(subject: Subject, up: Tensor) -> Tensor:
    """Return the center [3] of a subject's upright bounding box.

    A median would be unsuitable: that of a standing figure, for example, is not at half its height.
    """
    frame = _level_frame(up)
    local = subject.hull @ frame
    return frame @ ((local.amin(0) + local.amax(0)) / 2)


def _checked(
    count: int,
    up: Sequence[float],
    elevations: Sequence[float],
    radius: float | None,
    size: tuple[int | None, int | None],
) -> Tensor:
    """Validate the arguments, and return the normalized up vector."""
    axis = torch.tensor(up, dtype=torch.float64)
    if count < 1 or any(side is not None and side < 1 for side in size) or not elevations:
        raise SettingsError(
            f"An orbit of {count} views of {size[0]} x {size[1]} pixels is empty; give at least 1 of each."
        )
    if not (bool(torch.isfinite(axis).all()) and axis.norm() > 0 and all(abs(angle) < 90 for angle in elevations)):
        angles = ", ".join(f"{angle:g}" for angle in elevations)
        raise SettingsError(f"An orbit with up = {list(up)} and elevation = {angles} degrees has no direction.")
    if radius is not None and not (radius > 0 and math.isfinite(radius)):
        raise SettingsError(f"An orbit's radius is {radius:g}; give a number above 0.")
    return torch.nn.functional.normalize(axis, dim=0, eps=0.0)


def _framing(
    subject: Subject, middle: Tensor, directions: Sequence[Tensor], up: Tensor, radius: float | None, near: float
) -> tuple[float, float, float]:
    """Return the distance of cameras from the center, and half the width and height at depth 1 that all must show.

    A single point has no extent, so it gets a small one. With that of the pixel blur, it would look the same from any
    distance.

    Args:
        middle: [3], center, which the cameras look at.
        directions: Unit vectors [3] from the center to the cameras.
        radius: Distance of the cameras; None for the smallest one at which all of them see the subject.
    """
    origin = torch.zeros(3, dtype=torch.float64)
    poses = [look_at("", each, origin, up, width=1, height=1, focal=1.0).world_to_camera for each in directions]
    local = torch.stack([(subject.hull - middle) @ pose[:3, :3].T for pose in poses])
    across, z = local[:, :, :2].abs(), local[:, :, 2:]
    if radius is None:
        # in view: |x| focal <= (radius + z) / 2, and the same for y; in front: radius + z >= near
        needed = (2 * _FOCAL * _MARGIN * across.amax(2, keepdim=True)).clamp_min(_NEAR_MARGIN * near)
        radius = float((needed - z).max())
    depths = z + radius
    slopes = torch.where(depths > near, across / depths, 0.0).clamp_max(_WIDEST)
    x, y = slopes.amax((0, 1)).clamp_min(1e-3 * subject.size / radius + 1e-6).mul(_MARGIN).tolist()
    return radius, x, y


def _shape(x: float, y: float) -> float:
    """Return the permitted aspect ratio (width over height) that is nearest to that of the half extents."""
    steps = round(math.log(x / y) / math.log(_STEP))
    return float(_STEP ** max(-_MAX_STEPS, min(_MAX_STEPS, steps)))


#: Elevations in degrees of an orbit's rings, the most important first. Rings below the horizon are only for an isolated
#: subject, without ground or background.
_RINGS = (ELEVATION, 40.0, 70.0, -20.0)
#: Default number of views of a ring at elevation 0. All rings together then have 49 views.
_AROUND = 16
#: Minimum number of views per ring if there are several rings.
_MIN_VIEWS = 6


@dataclass(frozen=True)
class OrbitRequest:
    """Requested properties of an orbit; None to choose a value that suits the scene.

    Attributes:
        up: [3], world direction of up.
        elevation: Elevation in degrees of the orbit's only ring; None for as many rings as `count` suffices for.
        radius: Distance of the cameras from the center in world units.
    """

    count: int | None = None
    up: tuple[float, float, float] | None = None
    elevation: float | None = None
    radius: float | None = None
    near: float = NEAR


@dataclass(frozen=True)
class Orbit:
    """Cameras of an orbit, and the reasons for their choice.

    Attributes:
        cameras: Cameras, ring by ring.
        up: Up direction with its reason.
        elevations: Elevations of the rings in degrees.
        radius: Distance of the cameras from the center of the subject in world units.
        outside: Fraction of the scene that is not part of the subject.
    """

    cameras: list[Camera]
    up: Up
    elevations: tuple[float, ...]
    radius: float
    outside: float


def make_orbit(scene: Scene, request: OrbitRequest, remaining: Tensor | None = None) -> Orbit:
    """Create the requested orbit, and choose everything that was not specified.

    Args:
        remaining: [N] bool, Gaussians of a cropped scene that the orbit surrounds; None for all. The others may still
            show where up is.

    Raises:
        SettingsError: If an option is out of range; see `orbit`.
    """
    subject, up = find_upright_subject(scene, request.up, remaining)
    elevations: tuple[float, ...] = (request.elevation,) if request.elevation is not None else _RINGS
    if request.elevation is None and (up.ground or subject.left_out > _WHOLE):
        elevations = tuple(angle for angle in _RINGS if angle > 0)
    if request.count is not None:
        elevations = elevations[: max(1, request.count // _MIN_VIEWS)]
    by_ring = (max(_MIN_VIEWS, round(_AROUND * math.cos(math.radians(angle)))) for angle in elevations)
    count = sum(by_ring) if request.count is None else request.count
    axis, radius = up.direction.tolist(), request.radius
    cameras = orbit(subject, count, up=axis, elevations=elevations, radius=radius, near=request.near)
    radius = float((cameras[0].center - middle_of(subject, up.direction)).norm())
    return Orbit(cameras, up, elevations, radius, subject.left_out)


def find_upright_subject(
    scene: Scene, requested: tuple[float, float, float] | None, remaining: Tensor | None = None
) -> tuple[Subject, Up]:
    """Return the subject of a scene and its up direction.

    Args:
        requested: Up direction; None to estimate it.
        remaining: See `make_orbit`.
    """
    subject = whole = find_subject(scene)
    if remaining is not None:
        subject = find_subject(scene.subset(remaining))
    if requested is not None:
        axis = torch.tensor(requested, dtype=torch.float64)
        return subject, Up(axis / axis.norm().clamp_min(1e-300), "requested")
    up = find_up(subject)
    return subject, up if up.sure or subject is whole else find_up(whole)


def orbit_decisions(orbit: Orbit, count: int) -> list[Decision]:
    """Return the decisions about an orbit, of whose cameras `count` are used."""
    decisions = [Decision("up", orbit.up.name, orbit.up.reason)]
    *others, last = [f"{angle:g}" for angle in orbit.elevations]
    angles = f"{', '.join(others)} and {last}" if others else last
    rings = f"{len(orbit.elevations)} rings" if len(orbit.elevations) > 1 else "a ring"
    reason = "views from several heights show more of the surface" if others else "requested"
    views = f"{count} view{'s' if count > 1 else ''}"
    decisions.append(
        Decision("cameras", f"{views} in {rings} at {angles} degrees, {orbit.radius:.3g} from the center", reason)
    )
    if orbit.outside > _WHOLE:
        better = "it is not a single object; the cameras of its capture (--cameras) would show it better"
        text = f"warning: {orbit.outside:.0%} of the scene lies outside the frames"
        decisions.append(Decision("subject", text, better))
    return decisions
