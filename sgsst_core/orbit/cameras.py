"""Orbit cameras: rings around a scene's subject, each camera framed to fit it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.orbit.subject import USUAL_UP, Subject, find_subject
from sgsst_core.scene.camera import Camera, look_at
from sgsst_core.scene.gaussians import Scene

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
