"""EWA projection of a scene onto one camera's image plane, in float64.

Zwicker, Pfister, van Baar, Gross, "EWA Splatting", IEEE TVCG 2002: a Gaussian with covariance V becomes a 2D Gaussian
with covariance J V J^T, J the derivative of the perspective at its center. What is done about the numbers:

* The 2x3 factor M = J R_camera R_quaternion diag(scales) is formed, never the 3x3 covariance. With the blur e,
  det(M M^T + e I) = (sum of the squared 2x2 minors of M) + e trace(M M^T) + e^2 (Cauchy-Binet): a sum of positive
  terms, which cannot cancel. p r - q^2 has no correct digit left for a needle a million times longer than wide.
* With the covariance [[p, q], [q, r]] the exponent is a sum of two squares, which cannot become negative either:
  w = dy / sqrt(r), u = (dx - (q / r) dy) sqrt(r / det), power = (u^2 + w^2) / 2.
* A Gaussian's support is exactly where its alpha is at least ALPHA_MIN: half extents t sqrt(p) and t sqrt(r) with
  t = sqrt(2 ln(opacity / ALPHA_MIN)). There is no other cut, so a renderer without any support agrees.
"""

# The types of compiled functions are those of their arguments.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum

import numba
import numpy as np
from numpy.typing import NDArray

from sgsst_core.compiled import compiled, kernel_threads
from sgsst_core.constants import ALPHA_MIN, EPS2D, FRUSTUM_MARGIN, NEAR
from sgsst_core.rasterizer.depth_order import depth_order
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

_LOG2_ALPHA_MIN = math.log2(ALPHA_MIN)
#: exp(-power) = 2^-(u'^2 + w'^2) when u and w are scaled by this: the kernels evaluate powers of two.
_TO_POWER_OF_TWO = math.sqrt(0.5 * math.log2(math.e))
#: More than float64 can be off in pixels of any image, and relative to an extent.
_ROUNDING = 1e-6
#: Parts of the scene that a thread projects, one after the other.
_PARTS = 16


class Column(IntEnum):
    """Columns of `Projection.values`; dx, dy are a pixel center's offsets from (X, Y) in pixels.

    alpha = 2^(LOG2_OPACITY - u^2 - w^2) with w = dy * W_SCALE, u = (dx - SKEW * dy) * U_SCALE.
    """

    X = 0
    Y = 1
    SKEW = 2
    U_SCALE = 3
    W_SCALE = 4
    LOG2_OPACITY = 5
    EXTENT_X = 6
    EXTENT_Y = 7


class Outcome(IntEnum):
    """What became of a Gaussian in a view."""

    VISIBLE = 0
    #: Depth below the near plane; a Gaussian exactly on it is kept.
    NEAR = 1
    #: Zero quaternion, or a value that overflows float64, and the center not far beside the image.
    INVALID = 2
    #: Opacity below ALPHA_MIN: contributes to no pixel.
    FAINT = 3
    #: No pixel center of the image inside its extents.
    OUTSIDE = 4


_VISIBLE, _NEAR, _INVALID, _FAINT, _OUTSIDE = (int(outcome) for outcome in Outcome)


@dataclass(frozen=True)
class Projection:
    """The Gaussians of a scene that a view can show, front to back.

    Attributes:
        gaussians: [V] int32 indices into the scene, by depth along the viewing axis; equal depths by index.
        values: [V, 8] float64, see `Column`.
        outcomes: how many Gaussians of the scene ended in which `Outcome`; of a subset's, the visible ones alone.
    """

    gaussians: NDArray[np.int32]
    values: NDArray[np.float64]
    outcomes: dict[Outcome, int]


@dataclass(frozen=True)
class Shapes:
    """What projecting a scene computes of its Gaussians whatever the view, in float64.

    Attributes:
        deviations: [N, 3], standard deviations in world units.
        log2_opacities: [N], of the opacity: -inf for logits under -709.
    """

    deviations: NDArray[np.float64]
    log2_opacities: NDArray[np.float64]

    @classmethod
    def of(cls, scene: Scene) -> Shapes:
        """The shapes of a scene: 32 bytes for each Gaussian."""
        shapes = cls(np.empty((len(scene), 3)), np.empty(len(scene)))
        scales, logits = (np.ascontiguousarray(t.numpy()) for t in (scene.scales, scene.opacities))
        with kernel_threads():
            _find_shapes(scales, logits, shapes.deviations, shapes.log2_opacities)
        return shapes


def project(scene: Scene, camera: Camera, *, near: float = NEAR, shapes: Shapes | None = None) -> Projection:
    """Project a scene (any N, also 0) onto a camera.

    Args:
        shapes: of the scene, from an earlier view.

    Raises:
        ValueError: `near` is not positive (depths of 0 and less have no projection).
    """
    if not near > 0:
        raise ValueError(f"near plane {near}: must be positive")
    shapes = shapes or Shapes.of(scene)
    count = len(scene)
    values, depths = np.empty((count, len(Column))), np.empty(count)
    gaussians = np.empty(count, dtype=np.int32)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height], dtype=np.float64)
    with kernel_threads():
        threads = numba.get_num_threads()
        parts = np.linspace(0, count, threads * _PARTS + 1).astype(np.int64)
        tallies = np.zeros((len(parts) - 1, len(Outcome)), dtype=np.int64)
        _project_parts(
            *(np.ascontiguousarray(t.numpy()) for t in (scene.means, scene.quats)),
            shapes.deviations,
            shapes.log2_opacities,
            np.ascontiguousarray(camera.world_to_camera.double().numpy()),
            intrinsics,
            near,
            parts,
            threads,
            values,
            depths,
            gaussians,
            tallies,
        )
        ends = parts[:-1] + tallies[:, Outcome.VISIBLE]
        packed = [np.arange(start, end) for start, end in zip(parts[:-1], ends, strict=True)]
        order = depth_order(depths, np.concatenate(packed))
        found = Projection(
            gaussians=np.empty(len(order), dtype=np.int32),
            values=np.empty((len(order), len(Column))),
            outcomes={outcome: int(tallies[:, outcome].sum()) for outcome in Outcome},
        )
        take_places(gaussians, order, found.gaussians)
        take_rows(values, order, found.values)
    return found


@compiled()
def _rotation(quat):
    """Rows of the rotation matrix of a quaternion wxyz of any length but zero."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@compiled()
def _row(focal, slope, axis, forward):
    """One row of J R_camera: focal / z times (camera axis - slope * viewing axis)."""
    a = focal * (axis[0] - slope * forward[0])
    b = focal * (axis[1] - slope * forward[1])
    c = focal * (axis[2] - slope * forward[2])
    return a, b, c


@compiled()
def _factor_row(row, rotation, deviation):
    """One row of M: turned into the Gaussian's own axes."""
    a, b, c = row
    return (
        (a * rotation[0][0] + b * rotation[1][0] + c * rotation[2][0]) * deviation[0],
        (a * rotation[0][1] + b * rotation[1][1] + c * rotation[2][1]) * deviation[1],
        (a * rotation[0][2] + b * rotation[1][2] + c * rotation[2][2]) * deviation[2],
    )


@compiled()
def _surely_outside(center, size, row, deviation, support):
    """Whether a Gaussian lies beside the image, whatever its orientation: no row of M is longer than that of a ball.

    Beside by more than any rounding of the extents that it will be cut with, else False.
    """
    beside = max(0.5 - center, center - (size - 0.5)) - _ROUNDING
    if not beside > 0:
        return False
    largest = max(deviation[0], deviation[1], deviation[2])
    trace = (row[0] * row[0] + row[1] * row[1] + row[2] * row[2]) * largest * largest + EPS2D
    return beside * beside * (_TO_POWER_OF_TWO * _TO_POWER_OF_TWO) > (1 + _ROUNDING) * support * trace


@compiled()
def _covariance(m0, m1):
    """p, q, r and the determinant of M M^T + EPS2D I, without cancellation (see the module's text)."""
    p = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2]
    q = m0[0] * m1[0] + m0[1] * m1[1] + m0[2] * m1[2]
    r = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2]
    minor0 = m0[1] * m1[2] - m0[2] * m1[1]
    minor1 = m0[2] * m1[0] - m0[0] * m1[2]
    minor2 = m0[0] * m1[1] - m0[1] * m1[0]
    minors = minor0 * minor0 + minor1 * minor1 + minor2 * minor2
    return p + EPS2D, q, r + EPS2D, minors + EPS2D * (p + r) + EPS2D * EPS2D


@compiled()
def _project_one(mean, quat, deviation, opacity, pose, intrinsics, near, value):
    """Fill one row of `Projection.values`; returns the outcome and the depth."""
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    width, height = intrinsics[4], intrinsics[5]
    x = pose[0, 0] * mean[0] + pose[0, 1] * mean[1] + pose[0, 2] * mean[2] + pose[0, 3]
    y = pose[1, 0] * mean[0] + pose[1, 1] * mean[1] + pose[1, 2] * mean[2] + pose[1, 3]
    z = pose[2, 0] * mean[0] + pose[2, 1] * mean[1] + pose[2, 2] * mean[2] + pose[2, 3]
    if z < near:
        return _NEAR, z
    support = opacity - _LOG2_ALPHA_MIN
    if support < 0:
        return _FAINT, z
    margin_x, margin_y = FRUSTUM_MARGIN * 0.5 * width / fx, FRUSTUM_MARGIN * 0.5 * height / fy
    slope_x = min((width - cx) / fx + margin_x, max(-cx / fx - margin_x, x / z))
    slope_y = min((height - cy) / fy + margin_y, max(-cy / fy - margin_y, y / z))
    row0 = _row(fx / z, slope_x, pose[0], pose[2])
    row1 = _row(fy / z, slope_y, pose[1], pose[2])
    u, v = fx * (x / z) + cx, fy * (y / z) + cy
    if _surely_outside(u, width, row0, deviation, support) or _surely_outside(v, height, row1, deviation, support):
        return _OUTSIDE, z
    rotation = _rotation(quat)
    m0 = _factor_row(row0, rotation, deviation)
    m1 = _factor_row(row1, rotation, deviation)
    p, q, r, det = _covariance(m0, m1)
    u_scale = _TO_POWER_OF_TWO * math.sqrt(r / det)
    reach = math.sqrt(support) / _TO_POWER_OF_TWO
    extent_x, extent_y = reach * math.sqrt(p), reach * math.sqrt(r)
    if not math.isfinite(u + v + q / r + u_scale + extent_x + extent_y + det):
        return _INVALID, z
    if np.ceil(u - extent_x - 0.5) > min(np.floor(u + extent_x - 0.5), width - 1) or u + extent_x < 0.5:
        return _OUTSIDE, z
    if np.ceil(v - extent_y - 0.5) > min(np.floor(v + extent_y - 0.5), height - 1) or v + extent_y < 0.5:
        return _OUTSIDE, z
    value[0], value[1], value[2], value[3] = u, v, q / r, u_scale
    value[4], value[5], value[6], value[7] = _TO_POWER_OF_TWO / math.sqrt(r), opacity, extent_x, extent_y
    return _VISIBLE, z


@compiled(parallel=True)
def _find_shapes(scales, logits, deviations, log2_opacities):
    """See `Shapes`, of [N, 3] and [N] as files store them."""
    for i in numba.prange(logits.size):
        for axis in range(3):
            deviations[i, axis] = math.exp(np.float64(scales[i, axis]))
        log2_opacities[i] = -math.log1p(math.exp(-np.float64(logits[i]))) / math.log(2.0)  # log2 of the sigmoid


@compiled(parallel=True)
def _project_parts(
    means, quats, deviations, opacities, pose, intrinsics, near, parts, threads, values, depths, gaussians, tallies
):
    """What is visible of each part, packed from its start on; how many of it ended in which outcome."""
    for step in numba.prange(parts.size - 1):
        part = step % _PARTS * threads + step // _PARTS  # so that every thread gets parts from all over the scene
        place = parts[part]
        for i in range(parts[part], parts[part + 1]):
            outcome, depth = _project_one(
                means[i], quats[i], deviations[i], opacities[i], pose, intrinsics, near, values[place]
            )
            tallies[part, outcome] += 1
            if outcome == _VISIBLE:
                depths[place], gaussians[place] = depth, i
                place += 1


@compiled(parallel=True)
def take_rows(values, places, out) -> None:
    """values[places] of [N, C] values, on all cores."""
    for i in numba.prange(places.size):
        for column in range(values.shape[1]):
            out[i, column] = values[places[i], column]


@compiled(parallel=True)
def take_places(values, places, out) -> None:
    """values[places] of [N] values, on all cores."""
    for i in numba.prange(places.size):
        out[i] = values[places[i]]
