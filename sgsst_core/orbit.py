"""Orbit cameras around a scene without cameras: its subject, its up direction, and rings of views that fit it."""

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
    def candidates(self) -> list[str]:
        """World axis nearest to the direction, or both conventions if the scene does not determine it."""
        return [Up(_nearest_axis(self.direction), "").name] if self.sure else [*_CONVENTIONS]

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
    broader = f"{max(ends) / min(ends):.1f} times as broad as" if max(ends) < 100 * min(ends) else "broader than"
    reason = f"the subject is {longer:.1f} times as tall as wide, and its foot is {broader} the other end"
    return Up(_snapped(long if ends[0] > ends[1] else -long, _SNAP_STANDING), reason)


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
    edges = scipy.spatial.ConvexHull(base.numpy()).equations
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
        return float(scipy.spatial.ConvexHull(points.numpy()).volume)  # in two dimensions, `volume` is the area
    except scipy.spatial.QhullError:
        return 0.0


def _across(up: Tensor) -> Tensor:
    """Return two unit vectors perpendicular to `up` and each other, [3, 2] as columns."""
    first = torch.zeros(3, dtype=torch.float64)
    first[int(up.abs().argmin())] = 1.0
    first = torch.linalg.cross(up, first)
    first = first / first.norm()
    return torch.stack([first, torch.linalg.cross(up, first)], dim=1)


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
#: Aspect ratios (width over height) are powers of `_STEP`, a quarter octave, so that an orbit has few different sizes.
#: They are at most `_MAX_STEPS` steps from square, which is 4 to 1.
_STEP, _MAX_STEPS = 2**0.25, 8
#: Minimum area of a frame as a fraction of the largest, so that stroke sizes stay within half an octave.
_SMALLEST = 0.5
#: Minimum distance of the subject's nearest point, as a multiple of the near plane.
_NEAR_MARGIN = 1.1
#: Tangent of the maximum half field of view, for cameras that an explicit radius places inside the subject.
_WIDEST = math.tan(math.radians(50))
#: If the ratio of the subject's smaller to its larger horizontal spread is at least this, it has no broad side.
_ROUND = 0.9


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
    """Return cameras on rings around the subject of a scene, all at the same distance, each framed to fit the subject.

    Stray Gaussians and background are ignored (`find_subject`). The cameras look at the center of the visible part of
    the subject. Aspect ratios follow its shape, and every frame has as many pixels as 1024x768.

    Args:
        count: Number of cameras, distributed over the rings so that neighbors are about equally far apart.
        up: World direction of up. Captures processed by COLMAP have y pointing down, so -y is up.
        elevations: Elevation of each ring above the scene's horizon in degrees, between -90 and 90.
        radius: Distance of the cameras from the center in world units; None for the smallest distance at which the
            subject fits in a field of view of 37 degrees from every camera.
        width: Width in pixels of every frame; None to follow the shape of the subject.
        height: Height in pixels of every frame; None to follow the shape of the subject.
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
    directions, middle = ring_directions(subject, count, axis, elevations), middle_of(subject, axis)
    if radius is None:
        radius = _distance(subject.hull - middle, directions, axis, near)
    frames = []
    for direction in directions:
        target, half = _frame(subject, middle, radius * direction, axis, near)
        shape = width / height if width and height else _shape(half)
        frames.append((middle + radius * direction, target, shape, _widened(half, shape)))
    least = _SMALLEST * max(x * y for *_, (x, y) in frames)
    cameras = []
    for i, (position, target, shape, (x, y)) in enumerate(frames):
        wider = math.sqrt(max(1.0, least / (x * y)))
        pixels = _PIXELS * RESOLUTION**2
        columns, rows = width or round(math.sqrt(pixels * shape)), height or round(math.sqrt(pixels / shape))
        focal = min(columns / (2 * x * wider), rows / (2 * y * wider))
        side = None if width else RESOLUTION
        cameras.append(
            look_at(f"orbit_{i:04d}", position, target, axis, width=columns, height=rows, focal=focal, resolution=side)
        )
    return cameras


def turntable(
    subject: Subject,
    count: int,
    *,
    up: Sequence[float],
    elevation: float = ELEVATION,
    radius: float | None = None,
    side: int = RESOLUTION,
    near: float = 0.2,
) -> list[Camera]:
    """Return the cameras of a video once around a subject: a ring of one frame size, focal length and target.

    The frame fits the subject from every camera, in the aspect ratio of `orbit`.

    Args:
        count: Number of cameras, all different: the video continues with the first one.
        elevation: Elevation in degrees above the scene's horizon, between -90 and 90.
        radius: Distance of the cameras from the center in world units; None for that of `orbit`.
        side: Length in pixels of the longer side.

    Raises:
        SettingsError: If a value is out of range; see `orbit`.
    """
    axis = _checked(count, up, (elevation,), radius, (side, side))
    directions, middle = ring_directions(subject, count, axis, (elevation,)), middle_of(subject, axis)
    if radius is None:
        radius = _distance(subject.hull - middle, directions, axis, near)
    halves = [_half_extents(subject, middle + radius * direction, middle, axis, near) for direction in directions]
    half = (max(x for x, _ in halves), max(y for _, y in halves))
    shape = _shape(half)
    x, y = _widened(half, shape)
    width, height = (max(1, round(side * min(1.0, ratio))) for ratio in (shape, 1 / shape))
    focal = min(width / (2 * x), height / (2 * y))
    return [
        look_at(f"turn_{index:05d}", middle + radius * direction, middle, axis, width=width, height=height, focal=focal)
        for index, direction in enumerate(directions)
    ]


def cameras_per_ring(count: int, elevations: Sequence[float]) -> list[int]:
    """Distribute `count` cameras over the rings by circumference, at least one per ring if there are enough cameras."""
    lengths = [math.cos(math.radians(elevation)) for elevation in elevations]
    quotas = [count * length / sum(lengths) for length in lengths]
    counts = [max(1, math.floor(quota)) for quota in quotas]
    order = sorted(range(len(quotas)), key=lambda ring: math.floor(quotas[ring]) - quotas[ring])
    for ring in order:
        counts[ring] += sum(counts) < count
    while sum(counts) > count:  # more rings than cameras
        counts[max(range(len(counts)), key=lambda ring: (counts[ring], ring))] -= 1
    return counts


def ring_directions(subject: Subject, count: int, up: Tensor, elevations: Sequence[float]) -> list[Tensor]:
    """Return unit vectors [3] from the center to the cameras, ring by ring.

    Every second ring is rotated by half the angle between its cameras.
    """
    start, side, _ = _level_frame(subject, up).T
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
    frame = _level_frame(subject, up)
    local = subject.hull @ frame
    return frame @ ((local.amin(0) + local.amax(0)) / 2)


def _level_frame(subject: Subject, up: Tensor) -> Tensor:
    """Return unit vectors as columns [3, 3]: horizontally to the first camera, horizontally to its side, and up."""
    front = _front(subject, up)
    return torch.stack([front, torch.linalg.cross(up, front), up], dim=1)


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
    unit: Tensor = axis / axis.norm()
    return unit


def _front(subject: Subject, up: Tensor) -> Tensor:
    """Return the horizontal direction [3] to the first camera, which faces the subject's broad side if it has one."""
    start = torch.zeros(3, dtype=torch.float64)
    start[2 if abs(float(up[2])) < 0.9 else 0] = 1.0  # any direction that is not (nearly) parallel to up
    start = torch.nn.functional.normalize(start - (start @ up) * up, dim=0)
    frame = torch.stack([start, torch.linalg.cross(up, start)], dim=1)
    flat = (subject.points - subject.points[0]) @ frame
    flat = flat - (subject.weights[:, None] * flat).sum(0)
    flat = flat / flat.abs().amax().clamp_min(1e-300)
    spreads, axes = torch.linalg.eigh((subject.weights[:, None] * flat).T @ flat)
    if not float(spreads[0]) < _ROUND**2 * float(spreads[1]):
        return start
    # Of the two broad sides, take the one from which more protrudes; if they are similar, the one on the positive z
    # side.
    skew = float((subject.weights * (flat @ axes[:, 0]) ** 3).sum()) / max(float(spreads[0]), 1e-100) ** 1.5
    sense = skew if abs(skew) > 0.05 else float(axes[0, 0]) or 1.0
    level: Tensor = math.copysign(1.0, sense) * (frame @ axes[:, 0])
    return level


def _distance(offsets: Tensor, directions: Sequence[Tensor], up: Tensor, near: float) -> float:
    """Return the smallest distance at which all cameras see all points, given their offsets [D, 3] from the center."""
    origin = torch.zeros(3, dtype=torch.float64)
    distance = 0.0
    for direction in directions:
        rotation = look_at("", direction, origin, up, width=1, height=1, focal=1.0).world_to_camera[:3, :3]
        x, y, z = (offsets @ rotation.T).unbind(1)
        # in view: |x| focal <= (distance + z) / 2, and the same for y; in front: distance + z >= near
        needed = (2 * _FOCAL * _MARGIN * torch.maximum(x.abs(), y.abs())).clamp_min(_NEAR_MARGIN * near)
        distance = max(distance, float((needed - z).max()))
    return distance


def _frame(
    subject: Subject, middle: Tensor, offset: Tensor, up: Tensor, near: float
) -> tuple[Tensor, tuple[float, float]]:
    """Return the target [3] in the middle of what a camera at an offset from the center sees of the subject.

    Returns:
        The target, and half the width and height at depth 1 that the camera must show.
    """
    position, target = middle + offset, middle
    half = (0.0, 0.0)
    for _ in range(5):
        rotation, slopes = _slopes(subject, position, target, up, near)
        if not len(slopes):
            break
        half = (float(slopes[:, 0].abs().amax()), float(slopes[:, 1].abs().amax()))
        aim = torch.cat([(slopes.amin(0) + slopes.amax(0)) / 2, torch.ones(1, dtype=torch.float64)])
        if float(aim[:2].abs().amax()) < 1e-3 * max(half):
            break
        target = position + float(offset.norm()) * (rotation.T @ aim)
    return target, _with_margin(half, subject, float(offset.norm()))


def _half_extents(subject: Subject, position: Tensor, target: Tensor, up: Tensor, near: float) -> tuple[float, float]:
    """Return half the width and height at depth 1 that show a subject from a position toward a target."""
    slopes = _slopes(subject, position, target, up, near)[1]
    half = slopes.abs().amax(0).tolist() if len(slopes) else (0.0, 0.0)
    return _with_margin(half, subject, float((target - position).norm()))


def _slopes(subject: Subject, position: Tensor, target: Tensor, up: Tensor, near: float) -> tuple[Tensor, Tensor]:
    """Return a camera's rotation [3, 3], and the x and y [n, 2] of the visible subject at depth 1."""
    pose = look_at("", position, target, up, width=1, height=1, focal=1.0).world_to_camera
    local = subject.hull @ pose[:3, :3].T + pose[:3, 3]
    visible = local[local[:, 2] > near]
    return pose[:3, :3], (visible[:, :2] / visible[:, 2:]).clamp(-_WIDEST, _WIDEST)


def _with_margin(half: Sequence[float], subject: Subject, distance: float) -> tuple[float, float]:
    """Return half extents with a margin around the subject.

    A single point has no extent, so it gets a small one. With that of the pixel blur, it would look the same from any
    distance.
    """
    least = 1e-3 * subject.size / distance + 1e-6
    return _MARGIN * max(half[0], least), _MARGIN * max(half[1], least)


def _shape(half: tuple[float, float]) -> float:
    """Return the permitted aspect ratio (width over height) that is nearest to that of the half extents."""
    steps = round(math.log(half[0] / half[1]) / math.log(_STEP))
    return float(_STEP ** max(-_MAX_STEPS, min(_MAX_STEPS, steps)))


def _widened(half: tuple[float, float], shape: float) -> tuple[float, float]:
    """Return the half extents of the smallest frame of an aspect ratio that contains these half extents."""
    x, y = half
    return (max(x, y * shape), max(y, x / shape))


#: Elevations in degrees by the number of rings. On two statues, a brooch and a rider, and on two subjects above a
#: ground or before a background, each next ring added most of the surface, and a further one less than 3 %.
_ISOLATED = ((ELEVATION,), (ELEVATION, -20.0), (ELEVATION, 40.0, -20.0))
_WITH_GROUND = ((ELEVATION,), (ELEVATION, 70.0))
#: Default number of views of a ring at elevation 0. The default orbit then has 43 views, or 22 above a ground.
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
            hide them, and show where up is.

    Raises:
        SettingsError: If an option is out of range; see `orbit`.
    """
    subject, up = find_upright_subject(scene, request.up, remaining)
    rings: Sequence[Sequence[float]] = _ISOLATED if not up.ground and subject.left_out <= _WHOLE else _WITH_GROUND
    if request.elevation is not None:
        rings = ((request.elevation,),)
    count = request.count
    if count is None:
        elevations = rings[-1]
        count = sum(max(_MIN_VIEWS, round(_AROUND * math.cos(math.radians(angle)))) for angle in elevations)
    else:
        elevations = rings[max(1, min(count // _MIN_VIEWS, len(rings))) - 1]
    axis, radius = up.direction.tolist(), request.radius
    cameras = orbit(subject, count, up=axis, elevations=elevations, radius=radius, near=request.near)
    radius = float((cameras[0].center - middle_of(subject, up.direction)).norm())
    return Orbit(cameras, up, tuple(elevations), radius, subject.left_out)


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
        axis = axis / axis.norm().clamp_min(1e-300)
        ground = _ground(subject, [axis])
        return subject, Up(axis, "requested", ground=ground is not None and float(ground.direction @ axis) > 0)
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
        text = f"warning: {orbit.outside:.0%} of the scene lies outside the frames"
        better = "it is not a single object; the cameras of its capture (--cameras) would show it better"
        decisions.append(Decision("subject", text, better))
    return decisions
