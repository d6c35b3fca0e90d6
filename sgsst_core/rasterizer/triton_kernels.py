"""GPU kernels of the `triton` rasterizer: projection, tile intersections, compositing and its transpose.

The source runs on NVIDIA and AMD GPUs, and in Triton's interpreter on the CPU (set TRITON_INTERPRET=1 before the first
import). Numerics follow `projection` and `vectors`: geometry, including the offset of a pixel row from a Gaussian's
axis, is computed in float64; alpha and all later values in float32. Compositing and its transpose go front to back, so
transmittance never has to be recovered by repeated division by 1 - alpha. There are no atomics, so results are
reproducible bit for bit.
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

import triton
import triton.language as tl

#: Gaussians projected per program, and Gaussians blended per step.
PROJECTED, BLENDED = tl.constexpr(128), tl.constexpr(32)
#: Gaussians per program of `add_slots`, and slots per Gaussian that it reads per step.
ADDED, SLOTS = tl.constexpr(32), tl.constexpr(16)
_TILE: tl.constexpr = tl.constexpr(16)
_PIXELS: tl.constexpr = tl.constexpr(256)
_LN2: tl.constexpr = tl.constexpr(0.6931471805599453)


@triton.jit
def _is_finite(x):
    return x - x == 0


@triton.jit
def _to_pixel(x, largest):
    """Convert a float64 that is not NaN to an integer in 0 .. largest."""
    return tl.minimum(tl.maximum(x, 0.0), largest).to(tl.int32)


@triton.jit
def _tile_rows(value_y, extent_y, height):
    """Return the pixel rows (first, last) of the image within a Gaussian's extents; last < first if there are none."""
    first = tl.maximum(tl.ceil(value_y - extent_y - 0.5), 0.0)
    last = tl.minimum(tl.floor(value_y + extent_y - 0.5), height - 1.0)
    empty = (last < first) | (first >= height)
    return tl.where(empty, 0, _to_pixel(first, height)), tl.where(empty, -1, _to_pixel(last, height))


@triton.jit
def _tile_span(x, y, skew, u_scale, w_scale, support, extent_x, extent_y, first, last, width):
    """Return the range (begin, end) of tile columns that a Gaussian's support reaches in pixel rows first..last.

    See `tile_intersections._tile_span`.
    """
    top, bottom = first.to(tl.float64) + 0.5 - y, last.to(tl.float64) + 0.5 - y
    safe = tl.where(extent_x > 0, extent_x, 1.0)
    widest = tl.where(extent_x > 0, skew * extent_y * (extent_y / safe), 0.0)
    right = tl.minimum(tl.maximum(widest, top), bottom)
    left = tl.minimum(tl.maximum(-widest, top), bottom)
    half_right = tl.sqrt(tl.maximum(support - (right * w_scale) * (right * w_scale), 0.0)) / u_scale
    half_left = tl.sqrt(tl.maximum(support - (left * w_scale) * (left * w_scale), 0.0)) / u_scale
    begin = tl.maximum(tl.ceil(x + skew * left - half_left - 0.5), 0.0)
    end = tl.minimum(tl.floor(x + skew * right + half_right - 0.5), width - 1.0)
    empty = end < begin
    first_tile = tl.where(empty, 0, _to_pixel(begin, width) // _TILE)
    return first_tile, tl.where(empty, 0, _to_pixel(end, width) // _TILE + 1)


@triton.jit
def _span_of_row(down, first, last, x, y, skew, u_scale, w_scale, support, extent_x, extent_y, width):
    """Return the range (begin, end) of tile columns that each Gaussian reaches in tile row `down`.

    The range is empty if the tile row contains none of the Gaussian's pixel rows first..last.
    """
    top = tl.maximum(first, down * _TILE)
    bottom = tl.minimum(last, down * _TILE + _TILE - 1)
    begin, end = _tile_span(x, y, skew, u_scale, w_scale, support, extent_x, extent_y, top, bottom, width)
    reached = top <= bottom
    return tl.where(reached, begin, 0), tl.where(reached, end, 0)


@triton.jit
def project(
    means, quats, scales, logits, camera, values, depths, counts, total,
    EPS2D: tl.constexpr, ANTIALIASED: tl.constexpr, MARGIN: tl.constexpr, SUPPORT: tl.constexpr,
    POWER: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Run `projection.project` for BLOCK Gaussians per program, and count the raster tiles that each intersects.

    Args:
        camera: [19] float64: the upper three rows of world_to_camera, fx, fy, cx, cy, width, height, near.
        values: Output [N, 8] float64, see `projection.Column`; rows of invisible Gaussians are not written.
        depths: Output [N] float64, infinite for invisible Gaussians.
        counts: Output [N] int32, 0 for invisible Gaussians.
        total: N.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = i < total
    p = i.to(tl.int64)
    mx = tl.load(means + 3 * p, mask=there, other=0.0).to(tl.float64)
    my = tl.load(means + 3 * p + 1, mask=there, other=0.0).to(tl.float64)
    mz = tl.load(means + 3 * p + 2, mask=there, other=0.0).to(tl.float64)
    r00, r01, r02, t0 = tl.load(camera), tl.load(camera + 1), tl.load(camera + 2), tl.load(camera + 3)
    r10, r11, r12, t1 = tl.load(camera + 4), tl.load(camera + 5), tl.load(camera + 6), tl.load(camera + 7)
    r20, r21, r22, t2 = tl.load(camera + 8), tl.load(camera + 9), tl.load(camera + 10), tl.load(camera + 11)
    fx, fy, cx, cy = tl.load(camera + 12), tl.load(camera + 13), tl.load(camera + 14), tl.load(camera + 15)
    width, height, near = tl.load(camera + 16), tl.load(camera + 17), tl.load(camera + 18)
    x = r00 * mx + r01 * my + r02 * mz + t0
    y = r10 * mx + r11 * my + r12 * mz + t1
    z = r20 * mx + r21 * my + r22 * mz + t2
    visible = there & (z >= near)
    z = tl.where(visible, z, 1.0)
    logit = tl.load(logits + p, mask=there, other=0.0).to(tl.float64)
    opacity = -tl.log(1 + tl.exp(-logit)) / _LN2
    support = opacity + SUPPORT
    visible = visible & (support >= 0)
    margin_x, margin_y = MARGIN * 0.5 * width / fx, MARGIN * 0.5 * height / fy
    slope_x = tl.minimum((width - cx) / fx + margin_x, tl.maximum(-cx / fx - margin_x, x / z))
    slope_y = tl.minimum((height - cy) / fy + margin_y, tl.maximum(-cy / fy - margin_y, y / z))
    qw = tl.load(quats + 4 * p, mask=there, other=1.0).to(tl.float64)
    qx = tl.load(quats + 4 * p + 1, mask=there, other=0.0).to(tl.float64)
    qy = tl.load(quats + 4 * p + 2, mask=there, other=0.0).to(tl.float64)
    qz = tl.load(quats + 4 * p + 3, mask=there, other=0.0).to(tl.float64)
    norm = tl.sqrt(qw * qw + qx * qx + qy * qy + qz * qz)
    qw, qx, qy, qz = qw / norm, qx / norm, qy / norm, qz / norm
    g00, g01, g02 = 1 - 2 * (qy * qy + qz * qz), 2 * (qx * qy - qw * qz), 2 * (qx * qz + qw * qy)
    g10, g11, g12 = 2 * (qx * qy + qw * qz), 1 - 2 * (qx * qx + qz * qz), 2 * (qy * qz - qw * qx)
    g20, g21, g22 = 2 * (qx * qz - qw * qy), 2 * (qy * qz + qw * qx), 1 - 2 * (qx * qx + qy * qy)
    s0 = tl.exp(tl.load(scales + 3 * p, mask=there, other=0.0).to(tl.float64))
    s1 = tl.exp(tl.load(scales + 3 * p + 1, mask=there, other=0.0).to(tl.float64))
    s2 = tl.exp(tl.load(scales + 3 * p + 2, mask=there, other=0.0).to(tl.float64))
    ax, bx, cx_ = fx / z * (r00 - slope_x * r20), fx / z * (r01 - slope_x * r21), fx / z * (r02 - slope_x * r22)
    ay, by, cy_ = fy / z * (r10 - slope_y * r20), fy / z * (r11 - slope_y * r21), fy / z * (r12 - slope_y * r22)
    m00, m01 = (ax * g00 + bx * g10 + cx_ * g20) * s0, (ax * g01 + bx * g11 + cx_ * g21) * s1
    m02 = (ax * g02 + bx * g12 + cx_ * g22) * s2
    m10, m11 = (ay * g00 + by * g10 + cy_ * g20) * s0, (ay * g01 + by * g11 + cy_ * g21) * s1
    m12 = (ay * g02 + by * g12 + cy_ * g22) * s2
    vp = m00 * m00 + m01 * m01 + m02 * m02
    q = m00 * m10 + m01 * m11 + m02 * m12
    vr = m10 * m10 + m11 * m11 + m12 * m12
    minor0, minor1, minor2 = m01 * m12 - m02 * m11, m02 * m10 - m00 * m12, m00 * m11 - m01 * m10
    unblurred = minor0 * minor0 + minor1 * minor1 + minor2 * minor2
    det = unblurred + EPS2D * (vp + vr) + EPS2D * EPS2D
    if ANTIALIASED:
        opacity += 0.5 * tl.log(unblurred / det) / _LN2
        support = opacity + SUPPORT
        visible = visible & (support >= 0)
    vp, vr = vp + EPS2D, vr + EPS2D
    u_scale, w_scale = POWER * tl.sqrt(vr / det), POWER / tl.sqrt(vr)
    reach = tl.sqrt(tl.maximum(support, 0.0)) / POWER
    extent_x, extent_y = reach * tl.sqrt(vp), reach * tl.sqrt(vr)
    u, v, skew = fx * (x / z) + cx, fy * (y / z) + cy, q / vr
    visible = visible & _is_finite(u + v + skew + u_scale + extent_x + extent_y + det)
    beside = tl.ceil(u - extent_x - 0.5) > tl.minimum(tl.floor(u + extent_x - 0.5), width - 1)
    above = tl.ceil(v - extent_y - 0.5) > tl.minimum(tl.floor(v + extent_y - 0.5), height - 1)
    visible = visible & ~(beside | above) & (u + extent_x >= 0.5) & (v + extent_y >= 0.5)
    row = values + 8 * p
    tl.store(row, u, mask=visible)
    tl.store(row + 1, v, mask=visible)
    tl.store(row + 2, skew, mask=visible)
    tl.store(row + 3, u_scale, mask=visible)
    tl.store(row + 4, w_scale, mask=visible)
    tl.store(row + 5, opacity, mask=visible)
    tl.store(row + 6, extent_x, mask=visible)
    tl.store(row + 7, extent_y, mask=visible)
    tl.store(depths + p, tl.where(visible, z, float("inf")), mask=there)
    # Values of invisible Gaussians may be NaN: replace them with numbers, and set their range of rows to empty.
    v, extent_y = tl.where(visible, v, 0.0), tl.where(visible, extent_y, 0.0)
    u, extent_x = tl.where(visible, u, 0.0), tl.where(visible, extent_x, 1.0)
    skew, u_scale, w_scale = (
        tl.where(visible, skew, 0.0),
        tl.where(visible, u_scale, 1.0),
        tl.where(visible, w_scale, 1.0),
    )
    first, last = _tile_rows(v, extent_y, height)
    last = tl.where(visible, last, -1)
    first = tl.where(visible, first, 0)
    touched = tl.zeros([BLOCK], tl.int32)
    step = tl.zeros([], tl.int32)
    rows = tl.max(tl.where(last >= first, last // _TILE - first // _TILE + 1, 0), 0)
    while step < rows:
        begin, end = _span_of_row(
            first // _TILE + step, first, last, u, v, skew, u_scale, w_scale, support, extent_x, extent_y, width
        )
        touched += end - begin
        step += 1
    tl.store(counts + p, touched, mask=there)


@triton.jit
def list_tiles(
    order, values, first_slots, camera, tiles, ranks, visible,
    SUPPORT: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the tile and the rank of every (Gaussian, raster tile) pair, Gaussian by Gaussian.

    Args:
        order: [V] int64, Gaussian of each rank.
        values: [N, 8] float64.
        first_slots: [V + 1] int64, first slot of each rank.
        tiles: Output [E] int32.
        ranks: Output [E] int32.
        visible: V.
    """
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = rank < visible
    width, height = tl.load(camera + 16), tl.load(camera + 17)
    across = (width.to(tl.int32) + _TILE - 1) // _TILE
    row = values + 8 * tl.load(order + rank, mask=there, other=0)
    x, y = tl.load(row, mask=there, other=0.0), tl.load(row + 1, mask=there, other=0.0)
    skew, u_scale = tl.load(row + 2, mask=there, other=0.0), tl.load(row + 3, mask=there, other=1.0)
    w_scale, support = tl.load(row + 4, mask=there, other=1.0), tl.load(row + 5, mask=there, other=0.0) + SUPPORT
    extent_x, extent_y = tl.load(row + 6, mask=there, other=1.0), tl.load(row + 7, mask=there, other=0.0)
    slot = tl.load(first_slots + rank, mask=there, other=0)
    first, last = _tile_rows(y, extent_y, height)
    last = tl.where(there, last, -1)
    first = tl.where(there, first, 0)
    step = tl.zeros([], tl.int32)
    rows = tl.max(tl.where(last >= first, last // _TILE - first // _TILE + 1, 0), 0)
    while step < rows:
        down = first // _TILE + step
        begin, end = _span_of_row(down, first, last, x, y, skew, u_scale, w_scale, support, extent_x, extent_y, width)
        column = tl.zeros([], tl.int32)
        widest = tl.max(end - begin, 0)
        while column < widest:
            valid = begin + column < end
            tl.store(tiles + slot, down * across + begin + column, mask=valid)
            tl.store(ranks + slot, rank, mask=valid)
            slot += valid.to(tl.int64)
            column += 1
        step += 1


@triton.jit
def blend_weights(
    ranks, values, k, end, x0, y0, transmittance,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr, K: tl.constexpr,
):  # fmt: skip
    """Return the blend weights [K, 256] of the next K entries of a tile, and the transmittance [256] behind them.

    A finished pixel has a transmittance of 0 or less, which is its negated final transmittance. `values` is indexed by
    rank.
    """
    j = k + tl.arange(0, K)
    there = j < end
    rank = tl.load(ranks + j, mask=there, other=0).to(tl.int64)
    row = values + 8 * rank
    dx = x0.to(tl.float64) + 0.5 - tl.load(row, mask=there, other=0.0)
    dy = (y0 + tl.arange(0, _TILE)).to(tl.float64)[None, :] + 0.5 - tl.load(row + 1, mask=there, other=0.0)[:, None]
    skew, u_scale = tl.load(row + 2, mask=there, other=0.0), tl.load(row + 3, mask=there, other=0.0)
    w = dy * tl.load(row + 4, mask=there, other=0.0)[:, None]
    top = (tl.load(row + 5, mask=there, other=0.0)[:, None] - w * w).to(tl.float32)  # [K, 16]
    u0 = ((dx[:, None] - skew[:, None] * dy) * u_scale[:, None]).to(tl.float32)
    columns = tl.arange(0, _TILE).to(tl.float32)[None, None, :]
    u = u0[:, :, None] + columns * u_scale.to(tl.float32)[:, None, None]  # [K, 16, 16]
    alpha = tl.reshape(tl.minimum(tl.exp2(top[:, :, None] - u * u), ALPHA_MAX), [K, _PIXELS])
    alpha = tl.where(there[:, None] & (alpha >= ALPHA_MIN), alpha, 0.0)
    going = tl.maximum(transmittance, 0.0)
    after = going[None, :] * tl.cumprod(1 - alpha, 0)
    blended = (alpha > 0) & (after > STOP)
    weights = tl.where(blended, after / (1 - alpha) * alpha, 0.0)
    left = tl.min(tl.where(blended, after, going[None, :]), 0)
    ended = tl.min(after, 0) <= STOP
    left = tl.where(transmittance > 0, tl.where(ended, -left, left), transmittance)
    return weights, left


@triton.jit
def tile_pixels(tile, across, width, first_row, last_row):
    """Return the corner (x0, y0) of a raster tile, x and y of its pixels [256], and which pixels are in the band."""
    x0, y0 = tile % across * _TILE, tile // across * _TILE
    pixel = tl.arange(0, _PIXELS)
    x, y = x0 + pixel % _TILE, y0 + pixel // _TILE
    return x0, y0, x, y, (x < width) & (y >= first_row) & (y < last_row)


@triton.jit
def render(
    ranks, starts, gaussians, values, colors, background, image, transmittances, width, first_row, last_row, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr, K: tl.constexpr,
):  # fmt: skip
    """Render the image [h, width, 3] and final transmittance [h, width] of a band; one program per raster tile."""
    tile = first_row // _TILE * across + tl.program_id(0)
    x0, y0, x, y, inside = tile_pixels(tile, across, width, first_row, last_row)
    left = tl.where(inside, 1.0, 0.0)
    red, green, blue = tl.zeros([_PIXELS], tl.float32), tl.zeros([_PIXELS], tl.float32), tl.zeros([_PIXELS], tl.float32)
    k, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    going = tl.max(left, 0)
    while (k < end) & (going > 0):
        weights, left = blend_weights(ranks, values, k, end, x0, y0, left, ALPHA_MAX, ALPHA_MIN, STOP, K)
        j = k + tl.arange(0, K)
        there = j < end
        gaussian = tl.load(gaussians + tl.load(ranks + j, mask=there, other=0), mask=there, other=0)
        # Three channels are too few for matrix units, which would also multiply in less than float32.
        red += tl.sum(weights * tl.load(colors + 3 * gaussian, mask=there, other=0.0)[:, None], 0)
        green += tl.sum(weights * tl.load(colors + 3 * gaussian + 1, mask=there, other=0.0)[:, None], 0)
        blue += tl.sum(weights * tl.load(colors + 3 * gaussian + 2, mask=there, other=0.0)[:, None], 0)
        going = tl.max(left, 0)
        k += K
    left = tl.abs(left)
    pixel = (y - first_row).to(tl.int64) * width + x
    tl.store(image + 3 * pixel, red + left * tl.load(background), mask=inside)
    tl.store(image + 3 * pixel + 1, green + left * tl.load(background + 1), mask=inside)
    tl.store(image + 3 * pixel + 2, blue + left * tl.load(background + 2), mask=inside)
    tl.store(transmittances + pixel, left, mask=inside)


@triton.jit
def slot_gradients(
    ranks, slots, starts, values, image_gradient, out, width, first_row, last_row, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr, K: tl.constexpr,
):  # fmt: skip
    """Write dL/dcolor of every (Gaussian, tile) pair to its slot [E, 3], which must be zero on entry."""
    tile = first_row // _TILE * across + tl.program_id(0)
    x0, y0, x, y, inside = tile_pixels(tile, across, width, first_row, last_row)
    pixel = (y - first_row).to(tl.int64) * width + x
    red = tl.load(image_gradient + 3 * pixel, mask=inside, other=0.0)
    green = tl.load(image_gradient + 3 * pixel + 1, mask=inside, other=0.0)
    blue = tl.load(image_gradient + 3 * pixel + 2, mask=inside, other=0.0)
    left = tl.where(inside, 1.0, 0.0)
    k, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    going = tl.max(left, 0)
    while (k < end) & (going > 0):
        weights, left = blend_weights(ranks, values, k, end, x0, y0, left, ALPHA_MAX, ALPHA_MIN, STOP, K)
        j = k + tl.arange(0, K)
        there = j < end
        slot = out + 3 * tl.load(slots + j, mask=there, other=0).to(tl.int64)
        tl.store(slot, tl.sum(weights * red[None, :], 1), mask=there)
        tl.store(slot + 1, tl.sum(weights * green[None, :], 1), mask=there)
        tl.store(slot + 2, tl.sum(weights * blue[None, :], 1), mask=there)
        going = tl.max(left, 0)
        k += K


@triton.jit
def add_slots(slots, first_slots, gaussians, out, visible, BLOCK: tl.constexpr, SLOTS: tl.constexpr):
    """Sum each Gaussian's slots [E, 3], in a fixed order and in float64, into its row of `out` [N, 3].

    SLOTS are read per step, because a Gaussian that fills the view has a slot in every tile.
    """
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = rank < visible
    slot = tl.load(first_slots + rank, mask=there, other=0).to(tl.int64)
    end = tl.load(first_slots + rank + 1, mask=there, other=0).to(tl.int64)
    red, green = tl.zeros([BLOCK, SLOTS], tl.float64), tl.zeros([BLOCK, SLOTS], tl.float64)
    blue = tl.zeros([BLOCK, SLOTS], tl.float64)
    while tl.max(end - slot, 0) > 0:
        j = slot[:, None] + tl.arange(0, SLOTS)[None, :]
        valid = j < end[:, None]
        red += tl.load(slots + 3 * j, mask=valid, other=0.0).to(tl.float64)
        green += tl.load(slots + 3 * j + 1, mask=valid, other=0.0).to(tl.float64)
        blue += tl.load(slots + 3 * j + 2, mask=valid, other=0.0).to(tl.float64)
        slot += SLOTS
    row = out + 3 * tl.load(gaussians + rank, mask=there, other=0).to(tl.int64)
    tl.store(row, tl.sum(red, 1).to(tl.float32), mask=there)
    tl.store(row + 1, tl.sum(green, 1).to(tl.float32), mask=there)
    tl.store(row + 2, tl.sum(blue, 1).to(tl.float32), mask=there)


@triton.jit
def survey(
    ranks, slots, starts, values, out, transmittances, width, height, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr, K: tl.constexpr,
):  # fmt: skip
    """Compute the final transmittance [h, width] of a whole view, and the sum of weights of each pair in its slot [E].

    Slots must be zero on entry. The results equal those of `render`, and of `slot_gradients` for an image gradient of
    ones, but take only one pass. There is one program per raster tile.
    """
    tile = tl.program_id(0)
    x0, y0, x, y, inside = tile_pixels(tile, across, width, 0, height)
    left = tl.where(inside, 1.0, 0.0)
    k, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    going = tl.max(left, 0)
    while (k < end) & (going > 0):
        weights, left = blend_weights(ranks, values, k, end, x0, y0, left, ALPHA_MAX, ALPHA_MIN, STOP, K)
        j = k + tl.arange(0, K)
        there = j < end
        slot = tl.load(slots + j, mask=there, other=0).to(tl.int64)
        tl.store(out + slot, tl.sum(weights, 1), mask=there)
        going = tl.max(left, 0)
        k += K
    tl.store(transmittances + y.to(tl.int64) * width + x, tl.abs(left), mask=inside)


@triton.jit
def add_slot_weights(slots, first_slots, gaussians, out, visible, BLOCK: tl.constexpr, SLOTS: tl.constexpr):
    """Sum each Gaussian's slots [E] into `out` [N], as `add_slots` does."""
    rank = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = rank < visible
    slot = tl.load(first_slots + rank, mask=there, other=0).to(tl.int64)
    end = tl.load(first_slots + rank + 1, mask=there, other=0).to(tl.int64)
    total = tl.zeros([BLOCK, SLOTS], tl.float64)
    while tl.max(end - slot, 0) > 0:
        j = slot[:, None] + tl.arange(0, SLOTS)[None, :]
        total += tl.load(slots + j, mask=j < end[:, None], other=0.0).to(tl.float64)
        slot += SLOTS
    gaussian = tl.load(gaussians + rank, mask=there, other=0).to(tl.int64)
    tl.store(out + gaussian, tl.sum(total, 1).to(tl.float32), mask=there)
