"""`cpu`: float32 rasterizer on all CPU cores, with its projection in float64, depth sort, and tile intersections.

Zwicker, Pfister, van Baar, Gross, "EWA Splatting", IEEE TVCG 2002: a Gaussian with covariance V becomes a 2D Gaussian
with covariance J V J^T, where J is the Jacobian of the perspective at its center. For numerical accuracy:

* The 2x3 factor M = J R_camera R_quaternion diag(scales) is computed, never the 3x3 covariance. With the blur e, the
  2D covariance is M M^T + e I = [[p, q], [q, r]].
* Its determinant is (sum of the squared 2x2 minors of M) + e trace(M M^T) + e^2 (Cauchy-Binet), a sum of positive
  terms, which cannot cancel. The formula p r - q^2 would have no correct digit for a Gaussian a million times longer
  than wide.
* An antialiased scene multiplies the opacity by the square root of the minors' fraction of the determinant. Both are
  sums of positive terms, so the fraction is between 0 and 1.
* The exponent is computed as a sum of two squares, so it cannot become negative:
  w = dy / sqrt(r), u = (dx - (q / r) dy) sqrt(r / det), power = (u^2 + w^2) / 2.
* The support of a Gaussian is exactly the area where its alpha is at least ALPHA_MIN: half extents t sqrt(p) and
  t sqrt(r) with t = sqrt(2 ln(opacity / ALPHA_MIN)). There is no other cutoff, so a renderer that evaluates alpha at
  every pixel gives the same image.

The depth sort is PyTorch's stable sort, on all cores, of positive float64 numbers by their bits: these have the same
order as integers. Gaussians of equal depth keep the order of the file.

Tile intersections are the depth-sorted Gaussians of each raster tile. They are cached per view, because geometry is
frozen. Blend weights are recomputed in every call: storing them would save 0.6 % of a step.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core import container
from sgsst_core.compiled import compiled, kernel_threads
from sgsst_core.constants import ALPHA_MAX, LOG2_ALPHA_MIN, NEAR, RASTER_TILE, TO_POWER_OF_TWO
from sgsst_core.errors import TooManyIntersectionsError
from sgsst_core.rasterizer import kernels
from sgsst_core.rasterizer.base import TiledRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Upper bound of float64 rounding errors: in pixels for positions in an image, and relative for extents.
_ROUNDING = 1e-6
#: Number of chunks of the scene that each thread projects, one after the other.
_CHUNKS = 16


@dataclass(frozen=True)
class Projection:
    """Gaussians of a scene that can be visible in a view, front to back.

    Attributes:
        gaussians: [V] int32, indices into the scene, sorted by depth along the viewing axis and then by index.
        values: [V, 8] float64: X, Y, SKEW, U_SCALE, W_SCALE, LOG2_OPACITY, EXTENT_X and EXTENT_Y. With offsets dx, dy
            of a pixel center from (X, Y) in pixels, alpha = 2^(LOG2_OPACITY - u^2 - w^2), where w = dy * W_SCALE and
            u = (dx - SKEW * dy) * U_SCALE.
    """

    gaussians: NDArray[np.int32]
    values: NDArray[np.float64]


@dataclass(frozen=True)
class Shapes:
    """Standard deviations and opacities of a scene's Gaussians, which do not depend on the view, in float64.

    Attributes:
        deviations: [N, 3], standard deviations in world units.
        log2_opacities: [N], log2 of the opacities; -inf for logits below -709.
    """

    deviations: NDArray[np.float64]
    log2_opacities: NDArray[np.float64]

    @classmethod
    def of(cls, scene: Scene) -> "Shapes":
        """Compute the shapes of a scene; they take 32 bytes per Gaussian."""
        shapes = cls(np.empty((len(scene), 3)), np.empty(len(scene)))
        scales, logits = (np.ascontiguousarray(t.numpy()) for t in (scene.scales, scene.opacities))
        with kernel_threads():
            _compute_shapes(scales, logits, shapes.deviations, shapes.log2_opacities)
        return shapes


class _Blur(NamedTuple):
    """Blur of projected Gaussians, as an argument of kernels.

    Attributes:
        variance: Variance in square pixels.
        squared: Square of the variance. Computed in advance, so that it is not fused with a sum, which would change the
            rounding.
        compensated: Whether opacities are compensated for the blur.
    """

    variance: float
    squared: float
    compensated: bool


def project(scene: Scene, camera: Camera, *, near: float = NEAR, shapes: Shapes | None = None) -> Projection:
    """Project a scene onto a camera. The scene may be empty.

    Args:
        near: Distance of the near plane, above 0: depths of 0 and less have no projection.
        shapes: Shapes of the scene from an earlier view; None to compute them.
    """
    shapes, eps2d = shapes or Shapes.of(scene), scene.rendering.eps2d
    count = len(scene)
    values, depths = np.empty((count, 8)), np.empty(count)
    gaussians = np.empty(count, dtype=np.int32)
    intrinsics = np.array(
        [camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height, *camera.slope_limits],
        dtype=np.float64,
    )
    with kernel_threads():
        threads = numba.get_num_threads()
        chunks = np.linspace(0, count, threads * _CHUNKS + 1).astype(np.int64)
        counts = np.zeros(len(chunks) - 1, dtype=np.int64)
        _project_chunks(
            *(np.ascontiguousarray(t.numpy()) for t in (scene.means, scene.quats)),
            shapes.deviations,
            shapes.log2_opacities,
            np.ascontiguousarray(camera.world_to_camera.double().numpy()),
            intrinsics,
            near,
            _Blur(eps2d, eps2d * eps2d, scene.rendering.antialiased),
            chunks,
            threads,
            values,
            depths,
            gaussians,
            counts,
        )
        visible = [np.arange(start, start + own) for start, own in zip(chunks[:-1], counts, strict=True)]
        order = np.concatenate(visible)
        # Depths are positive, because the near plane is at a positive depth.
        bits = torch.from_numpy(depths.view(np.int64)[order])
        order = order[torch.sort(bits, stable=True).indices.numpy()]
    return Projection(gaussians[order], torch.from_numpy(values).index_select(0, torch.from_numpy(order)).numpy())


@compiled()
def _rotation(quat):
    """Return the rows of the rotation matrix of a wxyz quaternion of any non-zero norm."""
    w, x, y, z = np.float64(quat[0]), np.float64(quat[1]), np.float64(quat[2]), np.float64(quat[3])
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / norm, x / norm, y / norm, z / norm
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@compiled()
def _write_row(focal, slope, axis, forward):
    """Return one row of J R_camera: focal / z times (camera axis - slope * viewing axis)."""
    a = focal * (axis[0] - slope * forward[0])
    b = focal * (axis[1] - slope * forward[1])
    c = focal * (axis[2] - slope * forward[2])
    return a, b, c


@compiled()
def _factor_row(row, rotation, deviation):
    """Return one row of M: the row rotated into the Gaussian's axes and scaled."""
    a, b, c = row
    return (
        (a * rotation[0][0] + b * rotation[1][0] + c * rotation[2][0]) * deviation[0],
        (a * rotation[0][1] + b * rotation[1][1] + c * rotation[2][1]) * deviation[1],
        (a * rotation[0][2] + b * rotation[1][2] + c * rotation[2][2]) * deviation[2],
    )


@compiled()
def _surely_outside(center, size, row, deviation, support, blur):
    """Return whether a Gaussian is certain to lie outside the image, whatever its orientation.

    Its extent is bounded by that of a ball whose standard deviation is the largest of the Gaussian's. Return True only
    if the distance to the image exceeds this bound by more than the rounding error of the exact test that follows.
    """
    distance = max(0.5 - center, center - (size - 0.5)) - _ROUNDING
    if not distance > 0:
        return False
    largest = max(deviation[0], deviation[1], deviation[2])
    trace = (row[0] * row[0] + row[1] * row[1] + row[2] * row[2]) * largest * largest + blur.variance
    return distance * distance * (TO_POWER_OF_TWO * TO_POWER_OF_TWO) > (1 + _ROUNDING) * support * trace


@compiled()
def _covariance(m0, m1, blur):
    """Return p, q, r and the determinant of the blurred M M^T, and the determinant without blur.

    Nothing cancels (see the module docstring).
    """
    p = m0[0] * m0[0] + m0[1] * m0[1] + m0[2] * m0[2]
    q = m0[0] * m1[0] + m0[1] * m1[1] + m0[2] * m1[2]
    r = m1[0] * m1[0] + m1[1] * m1[1] + m1[2] * m1[2]
    minor0 = m0[1] * m1[2] - m0[2] * m1[1]
    minor1 = m0[2] * m1[0] - m0[0] * m1[2]
    minor2 = m0[0] * m1[1] - m0[1] * m1[0]
    minors = minor0 * minor0 + minor1 * minor1 + minor2 * minor2
    e = blur.variance
    return p + e, q, r + e, minors + e * (p + r) + blur.squared, minors


@compiled()
def _project_one(mean, quat, deviation, opacity, pose, intrinsics, near, blur, value):
    """Fill one row of `Projection.values`, and return the depth; 0 if the Gaussian contributes to no pixel.

    A Gaussian exactly on the near plane is visible. Those with a zero quaternion, or that overflow float64, are not.
    """
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    width, height = intrinsics[4], intrinsics[5]
    x = pose[0, 0] * mean[0] + pose[0, 1] * mean[1] + pose[0, 2] * mean[2] + pose[0, 3]
    y = pose[1, 0] * mean[0] + pose[1, 1] * mean[1] + pose[1, 2] * mean[2] + pose[1, 3]
    z = pose[2, 0] * mean[0] + pose[2, 1] * mean[1] + pose[2, 2] * mean[2] + pose[2, 3]
    if z < near:
        return 0.0
    support = opacity - LOG2_ALPHA_MIN
    if support < 0:
        return 0.0
    slope_x = min(intrinsics[7], max(intrinsics[6], x / z))
    slope_y = min(intrinsics[9], max(intrinsics[8], y / z))
    row0 = _write_row(fx / z, slope_x, pose[0], pose[2])
    row1 = _write_row(fy / z, slope_y, pose[1], pose[2])
    u, v = fx * (x / z) + cx, fy * (y / z) + cy
    if _surely_outside(u, width, row0, deviation, support, blur):
        return 0.0
    if _surely_outside(v, height, row1, deviation, support, blur):
        return 0.0
    rotation = _rotation(quat)
    m0 = _factor_row(row0, rotation, deviation)
    m1 = _factor_row(row1, rotation, deviation)
    p, q, r, det, unblurred = _covariance(m0, m1, blur)
    if blur.compensated:
        opacity += 0.5 * np.log2(unblurred / det)
        support = opacity - LOG2_ALPHA_MIN
        if support < 0:
            return 0.0
    u_scale = TO_POWER_OF_TWO * math.sqrt(r / det)
    reach = math.sqrt(support) / TO_POWER_OF_TWO
    extent_x, extent_y = reach * math.sqrt(p), reach * math.sqrt(r)
    if not math.isfinite(u + v + q / r + u_scale + extent_x + extent_y + det):
        return 0.0
    if np.ceil(u - extent_x - 0.5) > min(np.floor(u + extent_x - 0.5), width - 1) or u + extent_x < 0.5:
        return 0.0
    if np.ceil(v - extent_y - 0.5) > min(np.floor(v + extent_y - 0.5), height - 1) or v + extent_y < 0.5:
        return 0.0
    value[0], value[1], value[2], value[3] = u, v, q / r, u_scale
    value[4], value[5], value[6], value[7] = TO_POWER_OF_TWO / math.sqrt(r), opacity, extent_x, extent_y
    return z


@compiled(parallel=True)
def _compute_shapes(scales, logits, deviations, log2_opacities):
    """Compute `Shapes` from log scales [N, 3] and logits [N], as files store them."""
    for i in numba.prange(logits.size):
        for axis in range(3):
            deviations[i, axis] = math.exp(np.float64(scales[i, axis]))
        log2_opacities[i] = -math.log1p(math.exp(-np.float64(logits[i]))) / math.log(2.0)  # log2 of the sigmoid


@compiled(parallel=True)
def _project_chunks(
    means, quats, deviations, opacities, pose, intrinsics, near, blur, chunks, threads, values, depths, gaussians,
    counts,
):  # fmt: skip
    """Project each chunk of the scene, and count its visible Gaussians.

    Results of visible Gaussians are written contiguously from the start of each chunk.
    """
    for step in numba.prange(chunks.size - 1):
        chunk = step % _CHUNKS * threads + step // _CHUNKS  # gives every thread chunks from all over the scene
        position = chunks[chunk]
        for i in range(chunks[chunk], chunks[chunk + 1]):
            depth = _project_one(
                means[i], quats[i], deviations[i], opacities[i], pose, intrinsics, near, blur, values[position]
            )
            if depth > 0:
                depths[position], gaussians[position] = depth, i
                position += 1
        counts[chunk] = position - chunks[chunk]


#: Maximum number of pairs of Gaussian and raster tile, since their positions are 32-bit integers.
MAX_INTERSECTIONS = 2**31 - 1
#: Bytes per pair of Gaussian and raster tile: rank, slot, and the slot's gradient in the backward pass.
_PAIR_BYTES = 4 + 4 + 12
#: Number of chunks of the scene that each thread processes, one after the other.
_CHUNKS_OF_TILES = 4
_TILE = RASTER_TILE


@dataclass(frozen=True)
class TileIntersections:
    """Tile intersections of a view.

    A Gaussian intersects a raster tile if its support overlaps a pixel row of the tile within the tile's columns. Every
    pair of Gaussian and tile has an *entry*, its index in tile order, and a *slot*, its index in Gaussian order: the
    slots of one Gaussian are contiguous.

    Attributes:
        projection: V Gaussians, front to back. The index of a Gaussian in this depth order is its *rank*.
        starts: [tiles + 1] int64, first entry of each tile; tiles are in row-major order.
        ranks: [E] int32, rank of each entry's Gaussian, front to back within a tile.
        slots: [E] int32, slot of each entry.
        first_slots: [V + 1] int64, first slot of each rank.
    """

    projection: Projection
    starts: NDArray[np.int64]
    ranks: NDArray[np.int32]
    slots: NDArray[np.int32]
    first_slots: NDArray[np.int64]

    @property
    def nbytes(self) -> int:
        """Memory use in bytes, including the projection."""
        projection = self.projection.gaussians, self.projection.values
        return sum(array.nbytes for array in (*projection, self.starts, self.ranks, self.slots, self.first_slots))


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Return the number of raster tiles of a view as (across, down)."""
    return -(-camera.width // RASTER_TILE), -(-camera.height // RASTER_TILE)


def build_tile_intersections(
    scene: Scene, camera: Camera, *, near: float = NEAR, shapes: Shapes | None = None
) -> TileIntersections:
    """Project a scene, sort its Gaussians by depth, and compute the tile intersections.

    Args:
        shapes: Shapes of the scene from an earlier view; None to compute them.

    Raises:
        TooManyIntersectionsError: If there are more pairs of Gaussian and tile than 32-bit positions can address or
            free memory can hold. The pairs are counted before memory for them is allocated.
    """
    projection = project(scene, camera, near=near, shapes=shapes)
    values, size = projection.values, (camera.width, camera.height)
    across, down = tile_grid(camera)
    counts = np.empty(len(values), dtype=np.int64)
    with kernel_threads():
        threads = numba.get_num_threads()
        chunks = np.linspace(0, len(values), threads * _CHUNKS_OF_TILES + 1).astype(np.int64)
        positions = np.zeros((len(chunks) - 1, across * down), dtype=np.int64)
        _count_tiles(values, *size, chunks, threads, counts, positions)
    first_slots = run_starts(counts)
    total = int(first_slots[-1])
    check_intersections(total, len(counts), camera, free=container.memory().available)
    starts = run_starts(positions.sum(axis=0))
    # First position that each chunk writes to in each tile: after the entries of all preceding chunks.
    positions = starts[:-1] + np.cumsum(positions, axis=0) - positions
    ranks, slots = np.empty(total, dtype=np.int32), np.empty(total, dtype=np.int32)
    with kernel_threads():
        _fill_tiles(values, *size, chunks, threads, first_slots, positions, ranks, slots)
    return TileIntersections(projection, starts, ranks, slots, first_slots)


def run_starts(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the start offsets of consecutive runs with these lengths, and the end of the last one."""
    return np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts, dtype=np.int64)])


def check_intersections(total: int, gaussians: int, camera: Camera, *, free: int | None = None) -> None:
    """Raise TooManyIntersectionsError if `total` pairs of Gaussian and raster tile cannot be addressed.

    If the number of free bytes is given, raise it also if they do not fit. Without this check, the allocation would
    succeed, and the process would be killed when it writes to the memory.
    """
    needed = total * _PAIR_BYTES
    if total > MAX_INTERSECTIONS:
        reason = f"more than the {MAX_INTERSECTIONS:,} that can be addressed"
    elif free is not None and needed > free:
        reason = f"which takes {needed / 1e9:.1f} GB where {free / 1e9:.1f} GB are free"
    else:
        return
    raise TooManyIntersectionsError(
        f"view {camera.name!r} ({camera.width}x{camera.height}): its {gaussians:,} visible Gaussians touch raster "
        f"tiles {total:,} times, {reason}. Render at a lower resolution, or remove Gaussians so large that they cover "
        "much of the view."
    )


@compiled()
def _tile_rows(value, height):
    """Return the pixel rows (first, last) of the image within a Gaussian's extents; last < first if there are none."""
    # Use np.ceil: in compiled code, math.ceil returns int64, which overflows for extents above 9e18 pixels.
    first = max(0.0, np.ceil(value[1] - value[7] - 0.5))
    last = min(height - 1.0, np.floor(value[1] + value[7] - 0.5))
    return int(first), int(max(last, -1.0))


@compiled()
def _tile_span(value, first, last, width):
    """Return the range (begin, end) of tile columns that a Gaussian's support reaches in pixel rows first..last.

    These rows must be within the Gaussian's extents. The right edge of an ellipse is concave in y, with its maximum at
    dy = SKEW * EXTENT_Y^2 / EXTENT_X; the left edge is its point reflection. In an interval of rows, an edge is extreme
    at this point or, if it is outside the interval, at the nearer end.
    """
    top, bottom = first + 0.5 - value[1], last + 0.5 - value[1]
    widest = value[2] * value[7] * (value[7] / value[6]) if value[6] > 0 else 0.0
    support = value[5] - LOG2_ALPHA_MIN
    right = min(max(widest, top), bottom)
    left = min(max(-widest, top), bottom)
    half_right = math.sqrt(max(support - (right * value[4]) ** 2, 0.0)) / value[3]
    half_left = math.sqrt(max(support - (left * value[4]) ** 2, 0.0)) / value[3]
    begin = max(0.0, np.ceil(value[0] + value[2] * left - half_left - 0.5))
    end = min(width - 1.0, np.floor(value[0] + value[2] * right + half_right - 0.5))
    if end < begin:
        return 0, 0
    return int(begin) // _TILE, int(end) // _TILE + 1


@compiled()
def _chunk_of(step, threads):
    """Return the chunk of the Gaussians for a step of a parallel loop.

    Every thread gets chunks from all depths, because nearer chunks take more work.
    """
    return step % _CHUNKS_OF_TILES * threads + step // _CHUNKS_OF_TILES


@compiled(parallel=True)
def _count_tiles(values, width, height, chunks, threads, counts, positions):
    """Count the tiles that each Gaussian intersects, and the Gaussians of each chunk that intersect each tile."""
    across = (width + _TILE - 1) // _TILE
    for step in numba.prange(chunks.size - 1):
        chunk = _chunk_of(step, threads)
        for rank in range(chunks[chunk], chunks[chunk + 1]):
            first, last = _tile_rows(values[rank], height)
            total = 0
            for down in range(first // _TILE, last // _TILE + 1):
                top, bottom = max(first, down * _TILE), min(last, down * _TILE + _TILE - 1)
                begin, end = _tile_span(values[rank], top, bottom, width)
                total += end - begin
                for tile in range(down * across + begin, down * across + end):
                    positions[chunk, tile] += 1
            counts[rank] = total


@compiled(parallel=True)
def _fill_tiles(values, width, height, chunks, threads, first_slots, positions, ranks, slots):
    """Sort all pairs of Gaussian and tile by tile (counting sort).

    Gaussians are processed in depth order, so the entries of every tile are sorted by depth.
    """
    across = (width + _TILE - 1) // _TILE
    for step in numba.prange(chunks.size - 1):
        chunk = _chunk_of(step, threads)
        for rank in range(chunks[chunk], chunks[chunk + 1]):
            first, last = _tile_rows(values[rank], height)
            slot = first_slots[rank]
            for down in range(first // _TILE, last // _TILE + 1):
                top, bottom = max(first, down * _TILE), min(last, down * _TILE + _TILE - 1)
                begin, end = _tile_span(values[rank], top, bottom, width)
                for tile in range(down * across + begin, down * across + end):
                    position = positions[chunk, tile]
                    ranks[position], slots[position] = rank, slot
                    positions[chunk, tile] = position + 1
                    slot += 1


class CpuRasterizer(TiledRasterizer[TileIntersections]):
    """Rasterizer in compiled float32 code.

    The order of summation is fixed, so results are bit-identical for any number of threads.
    """

    name = "cpu"
    title = "compiled code"
    default_intersection_bytes = 1 << 30  # 15 to 20 bytes per pair of Gaussian and tile

    def __init__(self, scene: Scene, **options: Any) -> None:
        super().__init__(scene, **options)
        self._shapes = Shapes.of(scene)

    def _build(self, camera: Camera) -> TileIntersections:
        return build_tile_intersections(self.scene, camera, near=self.near, shapes=self._shapes)

    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        return self._blend(colors.numpy(), camera)[0]

    def coverage(self, camera: Camera) -> Tensor:
        """Return 1 - T_final, [h, w]."""
        return 1 - self._blend(np.zeros((len(self.scene), 3), dtype=np.float32), camera)[1]

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        isects = self.intersections(camera)
        projection = isects.projection
        slot_gradients = np.empty((len(isects.ranks), 3), dtype=np.float32)
        gradient = np.zeros((len(self.scene), 3), dtype=np.float32)
        with kernel_threads():
            kernels.color_gradient(
                isects.ranks,
                isects.slots,
                isects.starts,
                projection.values,
                image_gradient.numpy(),
                ALPHA_MAX,
                slot_gradients,
            )
            kernels.add_slots(slot_gradients, isects.first_slots, projection.gaussians, gradient)
        return torch.from_numpy(gradient)

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, w], and each Gaussian's blend weight summed over all pixels [N], in one pass.

        Bit-identical to `coverage`, and to a column of `color_gradient` for an image gradient of ones.
        """
        isects = self.intersections(camera)
        slot_weights = np.empty(len(isects.ranks), dtype=np.float32)
        weights = np.zeros(len(self.scene), dtype=np.float32)
        transmittance = np.empty((camera.height, camera.width), dtype=np.float32)
        values = isects.projection.values
        with kernel_threads():
            kernels.survey(isects.ranks, isects.slots, isects.starts, values, ALPHA_MAX, slot_weights, transmittance)
            kernels.add_slot_weights(slot_weights, isects.first_slots, isects.projection.gaussians, weights)
        return 1 - torch.from_numpy(transmittance), torch.from_numpy(weights)

    def _blend(self, colors: NDArray[np.float32], camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the image and the final transmittance of a view."""
        isects = self.intersections(camera)
        image = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        transmittance = np.empty((camera.height, camera.width), dtype=np.float32)
        with kernel_threads():
            kernels.render(
                isects.ranks,
                isects.starts,
                isects.projection.values,
                isects.projection.gaussians,
                colors,
                self.background.numpy(),
                ALPHA_MAX,
                image,
                transmittance,
            )
        return torch.from_numpy(image), torch.from_numpy(transmittance)
