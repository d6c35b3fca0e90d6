"""GPU kernels of the `triton` rasterizer: projection, tile intersections, compositing, cached blend weights.

The source runs on NVIDIA and AMD GPUs, and in Triton's interpreter on the CPU (set TRITON_INTERPRET=1 before the first
import). Geometry, including the offset of a raster tile from a Gaussian's axes, is computed in float64; alpha and all
later values in float32. Compositing and its transpose go front to back, so transmittance never has to be recovered by
repeated division by 1 - alpha. There are no atomics, so results are reproducible bit for bit.

Compositing kernels have one program per raster tile. Each lane of a warp prepares one of the next 32 pairs of Gaussian
and tile, and the pairs are then broadcast to all lanes one after another. So the loop over pairs has neither float64
instructions nor memory accesses.

For cached blend weights, a raster tile is divided into 16 blocks of 4 x 4 pixels. A piece is one Gaussian in one block:
16 weights in row-major order, and two indices. The pieces of a block are contiguous, front to back, so a program reads
only the pieces that it needs, as one stream, and accumulates in registers. Blocks of 4 x 4 have the least overhead of
padding and indices: on trained scenes, larger blocks take up to a third more memory, and smaller blocks do not take
less.

Weights are those of `blend`. They are computed twice, by two kernels whose rounding may differ after compilation.
Therefore only `count_pieces` decides which blocks have a weight, and `store_pieces` uses its masks. In float16, weights
are multiplied by `HALF_SCALE`, which makes even the smallest weight (4e-7) a normal number, with a relative error of at
most 2^-11.
"""

# Arguments are untyped: Triton compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

import triton
import triton.language as tl

#: Gaussians projected per program, and pairs of Gaussian and tile that are prepared at once: one per lane of a warp.
PROJECTED, PAIRS = tl.constexpr(128), tl.constexpr(32)
#: Warps per program of compositing kernels that sum over the pixels of a tile, and of the others. Sums stay within a
#: warp. Without sums, two warps take fewer registers per thread, so more warps fit on a multiprocessor.
SUMMING_WARPS, PIXEL_WARPS = 1, 2
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

    See `cpu._tile_span`.
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
    EPS2D: tl.constexpr, ANTIALIASED: tl.constexpr, SUPPORT: tl.constexpr, POWER: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Run `cpu.project` for BLOCK Gaussians per program, and count the raster tiles that each intersects.

    Args:
        camera: [23] float64: the upper three rows of world_to_camera, fx, fy, cx, cy, width, height, near, and
            `Camera.slope_limits`.
        values: Output [N, 8] float64, see `cpu.Projection`; rows of invisible Gaussians are not written.
        depths: Output [N] float64, infinite for invisible Gaussians.
        counts: Output [N] int32, 0 for invisible Gaussians.
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
    slope_x = tl.minimum(tl.load(camera + 20), tl.maximum(tl.load(camera + 19), x / z))
    slope_y = tl.minimum(tl.load(camera + 22), tl.maximum(tl.load(camera + 21), y / z))
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
def load_pairs(ranks, values, j, there, tile, across):
    """Return power, offsets and slopes of some (Gaussian, raster tile) pairs: six tensors [32] float32.

    The power at column x and row y, relative to the center of the tile, is p - (u + x u_x + y u_y)^2 - (w + y w_y)^2.
    Offsets from a Gaussian are computed in float64, because they may be large and cancel. What remains is at most a few
    tiles long wherever the Gaussian is visible, since no slope exceeds 1 / sqrt(2 ln 2 eps2d).
    """
    row = values + 8 * tl.load(ranks + j, mask=there, other=0).to(tl.int64)
    x = (tile % across * _TILE + _TILE // 2).to(tl.float64) - tl.load(row, mask=there, other=0.0)
    y = (tile // across * _TILE + _TILE // 2).to(tl.float64) - tl.load(row + 1, mask=there, other=0.0)
    skew, u_scale = tl.load(row + 2, mask=there, other=0.0), tl.load(row + 3, mask=there, other=0.0)
    w_scale, opacity = tl.load(row + 4, mask=there, other=0.0), tl.load(row + 5, mask=there, other=0.0)
    return (
        opacity.to(tl.float32),
        ((x - skew * y) * u_scale).to(tl.float32),
        u_scale.to(tl.float32),
        (-skew * u_scale).to(tl.float32),
        (y * w_scale).to(tl.float32),
        w_scale.to(tl.float32),
    )


@triton.jit
def blend(
    pairs, lane, x, y, left, final,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr,
):  # fmt: skip
    """Return the weights [8, 32] of a pair in a tile, and the updated `left` and `final`.

    Args:
        lane: [32] int32, index of the pair in all elements, so that each gather is one shuffle.
        x, y: Columns and rows of the pixels relative to the center of the tile.
        left: Transmittance, 0 once a pixel is finished.
        final: Transmittance, unchanged once a pixel is finished.
    """
    power, u, u_x, u_y, w, w_y = pairs
    u = tl.gather(u, lane, 0) + x * tl.gather(u_x, lane, 0) + y * tl.gather(u_y, lane, 0)
    w = tl.gather(w, lane, 0) + y * tl.gather(w_y, lane, 0)
    alpha = tl.minimum(tl.exp2(tl.gather(power, lane, 0) - w * w - u * u), ALPHA_MAX)
    weight = left * tl.where(alpha >= ALPHA_MIN, alpha, 0.0)
    after = left - weight
    is_blended = after > STOP
    return tl.where(is_blended, weight, 0.0), tl.where(is_blended, after, 0.0), tl.where(is_blended, after, final)


@triton.jit
def tile_pixels(tile, across, width, height):
    """Return columns and rows of a tile's pixels [8, 32] relative to its center, their indices, and which exist.

    A pixel outside the image does not exist.
    """
    pixel = tl.arange(0, _PIXELS // PAIRS)[:, None] * PAIRS + tl.arange(0, PAIRS)[None, :]
    column, row = pixel % _TILE, pixel // _TILE
    x, y = tile % across * _TILE + column, tile // across * _TILE + row
    inside = (x < width) & (y < height)
    center = (_TILE - 1) / 2
    return column - center, row - center, y.to(tl.int64) * width + x, inside


@triton.jit
def render(
    ranks, starts, gaussians, values, colors, background, image, transmittances, width, height, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr,
):  # fmt: skip
    """Render the image [h, width, 3] and final transmittance [h, width]; one program per raster tile."""
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, across, width, height)
    left = tl.where(inside, 1.0, 0.0)
    final = left
    red, green, blue = tl.zeros_like(left), tl.zeros_like(left), tl.zeros_like(left)
    k, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (k < end) & (tl.max(left) > 0):
        j = k + tl.arange(0, PAIRS)
        there = j < end
        pairs = load_pairs(ranks, values, j, there, tile, across)
        gaussian = tl.load(gaussians + tl.load(ranks + j, mask=there, other=0), mask=there, other=0)
        reds = tl.load(colors + 3 * gaussian, mask=there, other=0.0)
        greens = tl.load(colors + 3 * gaussian + 1, mask=there, other=0.0)
        blues = tl.load(colors + 3 * gaussian + 2, mask=there, other=0.0)
        for i in range(tl.minimum(end - k, PAIRS).to(tl.int32)):
            lane = tl.full([PAIRS], i, tl.int32)
            weight, left, final = blend(pairs, lane, x, y, left, final, ALPHA_MAX, ALPHA_MIN, STOP)
            # Three channels are too few for matrix units, which would also multiply in less than float32.
            red += weight * tl.gather(reds, lane, 0)
            green += weight * tl.gather(greens, lane, 0)
            blue += weight * tl.gather(blues, lane, 0)
        k += PAIRS
    tl.store(image + 3 * pixel, red + final * tl.load(background), mask=inside)
    tl.store(image + 3 * pixel + 1, green + final * tl.load(background + 1), mask=inside)
    tl.store(image + 3 * pixel + 2, blue + final * tl.load(background + 2), mask=inside)
    tl.store(transmittances + pixel, final, mask=inside)


@triton.jit
def slot_gradients(
    ranks, slots, starts, values, image_gradient, out, width, height, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr,
):  # fmt: skip
    """Write dL/dcolor of every (Gaussian, tile) pair to its slot [E, 3], which must be zero on entry."""
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, across, width, height)
    red = tl.load(image_gradient + 3 * pixel, mask=inside, other=0.0)
    green = tl.load(image_gradient + 3 * pixel + 1, mask=inside, other=0.0)
    blue = tl.load(image_gradient + 3 * pixel + 2, mask=inside, other=0.0)
    left = tl.where(inside, 1.0, 0.0)
    pair = tl.arange(0, PAIRS)
    k, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (k < end) & (tl.max(left) > 0):
        there = k + pair < end
        pairs = load_pairs(ranks, values, k + pair, there, tile, across)
        reds = tl.zeros([PAIRS], tl.float32)
        greens, blues = reds, reds
        for i in range(tl.minimum(end - k, PAIRS).to(tl.int32)):
            lane = tl.full([PAIRS], i, tl.int32)
            weight, left, _final = blend(pairs, lane, x, y, left, left, ALPHA_MAX, ALPHA_MIN, STOP)
            reds = tl.where(pair == lane, tl.sum(weight * red), reds)
            greens = tl.where(pair == lane, tl.sum(weight * green), greens)
            blues = tl.where(pair == lane, tl.sum(weight * blue), blues)
        slot = out + 3 * tl.load(slots + k + pair, mask=there, other=0).to(tl.int64)
        tl.store(slot, reds, mask=there)
        tl.store(slot + 1, greens, mask=there)
        tl.store(slot + 2, blues, mask=there)
        k += PAIRS


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


#: Blocks per raster tile, weights per piece, and pieces that a program reads per step.
BLOCKS, PIECE, PIECES = tl.constexpr(16), tl.constexpr(16), tl.constexpr(16)
#: Factor of weights stored in float16. Products with the largest weight (0.99) are in the range of float16, and those
#: with the smallest weight are normal numbers.
HALF_SCALE = 2.0**14
_SIDE: tl.constexpr = tl.constexpr(4)


@triton.jit
def _block_pixels(block, width, height, across):
    """Return which of a block's 16 pixels are in the image, and their indices in it."""
    tile = block // BLOCKS
    pixel = tl.arange(0, PIECE)
    x = tile % across * _TILE + block % _SIDE * _SIDE + pixel % _SIDE
    y = tile // across * _TILE + block % BLOCKS // _SIDE * _SIDE + pixel // _SIDE
    inside = (x < width) & (y < height)
    return inside, y.to(tl.int64) * width + x


@triton.jit
def _cells():
    """Return the block of each of a tile's pixels [8, 32], and the index of the pixel within its block."""
    pixel = tl.arange(0, _PIXELS // PAIRS)[:, None] * PAIRS + tl.arange(0, PAIRS)[None, :]
    column, row = pixel % _TILE, pixel // _TILE
    return row // _SIDE * _SIDE + column // _SIDE, row % _SIDE * _SIDE + column % _SIDE


@triton.jit
def _present_blocks(weight):
    """Return a bit mask of the blocks in which a pair has weights [8, 32]."""
    rows = tl.max(tl.reshape(weight, [_SIDE, _SIDE, _SIDE, _SIDE]), 3)  # block row, row, block column
    block = tl.arange(0, _SIDE)[:, None] * _SIDE + tl.arange(0, _SIDE)[None, :]
    return tl.sum(tl.where(tl.max(rows, 1) > 0, 1 << block, 0))


@triton.jit
def count_pieces(
    ranks, slots, starts, values, masks, slot_pieces, block_pieces, ends, width, height, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr,
):  # fmt: skip
    """Find the blocks in which each (Gaussian, raster tile) pair has weights; one program per raster tile.

    Args:
        masks: Output [E] int32, one bit per block; zeros on entry.
        slot_pieces: Output [E] int32, pieces by the pair's slot; zeros on entry.
        block_pieces: Output [16 tiles] int32, pieces of every block.
        ends: Output [tiles] int64, entry of each tile after which all pixels are finished.
    """
    tile = tl.program_id(0)
    x, y, _pixel, inside = tile_pixels(tile, across, width, height)
    left = tl.where(inside, 1.0, 0.0)
    block, pair = tl.arange(0, BLOCKS), tl.arange(0, PAIRS)
    pieces = tl.zeros([BLOCKS], tl.int32)
    k, end = tl.load(starts + tile), tl.load(starts + tile + 1)
    while (k < end) & (tl.max(left) > 0):
        there = k + pair < end
        pairs = load_pairs(ranks, values, k + pair, there, tile, across)
        bits = tl.zeros([PAIRS], tl.int32)
        for i in range(tl.minimum(end - k, PAIRS).to(tl.int32)):
            lane = tl.full([PAIRS], i, tl.int32)
            weight, left, _final = blend(pairs, lane, x, y, left, left, ALPHA_MAX, ALPHA_MIN, STOP)
            bits = tl.where(pair == lane, _present_blocks(weight), bits)
        present = (bits[:, None] >> block[None, :]) & 1  # [32, 16]
        tl.store(masks + k + pair, bits, mask=there)
        tl.store(slot_pieces + tl.load(slots + k + pair, mask=there, other=0), tl.sum(present, 1), mask=there)
        pieces += tl.sum(present, 0)
        k += PAIRS
    tl.store(block_pieces + tl.program_id(0) * BLOCKS + block, pieces)
    tl.store(ends + tl.program_id(0), tl.minimum(k, end))


@triton.jit
def store_pieces(
    ranks, slots, starts, values, gaussians, masks, ends, slot_starts, block_starts, piece_gaussians, piece_slots,
    weights, transmittances, width, height, across,
    ALPHA_MAX: tl.constexpr, ALPHA_MIN: tl.constexpr, STOP: tl.constexpr, SCALE: tl.constexpr,
):  # fmt: skip
    """Store the pieces counted by `count_pieces`, and the final transmittance [h, width].

    Args:
        slot_starts: [E + 1], first piece slot of each pair; the piece slots of one Gaussian are contiguous.
        block_starts: [16 tiles + 1], first piece of each block.
        piece_gaussians: Output [P] int32, indices into the scene.
        piece_slots: Output [P], slot of each piece's gradient.
        weights: Output [16 P] float32, or float16 multiplied by SCALE.
    """
    tile = tl.program_id(0)
    x, y, pixel, inside = tile_pixels(tile, across, width, height)
    left = tl.where(inside, 1.0, 0.0)
    final = left
    block, pair = tl.arange(0, BLOCKS), tl.arange(0, PAIRS)
    own_block, cell = _cells()
    tile_starts = block_starts + tl.program_id(0) * BLOCKS
    piece, own_piece = tl.load(tile_starts + block).to(tl.int64), tl.load(tile_starts + own_block).to(tl.int64)
    k, end = tl.load(starts + tile), tl.load(ends + tl.program_id(0))
    while k < end:
        j = k + pair
        there = j < end
        pairs = load_pairs(ranks, values, j, there, tile, across)
        bits = tl.load(masks + j, mask=there, other=0)
        for i in range(tl.minimum(end - k, PAIRS).to(tl.int32)):
            lane = tl.full([PAIRS], i, tl.int32)
            weight, left, final = blend(pairs, lane, x, y, left, final, ALPHA_MAX, ALPHA_MIN, STOP)
            has_own = (tl.gather(bits, lane, 0) >> own_block) & 1
            scaled = (weight * SCALE).to(weights.dtype.element_ty)
            tl.store(weights + PIECE * own_piece + cell, scaled, mask=has_own > 0)
            own_piece += has_own
        present = (bits[:, None] >> block[None, :]) & 1  # [32, 16]
        has_piece = present > 0
        target = piece[None, :] + tl.cumsum(present, 0) - present
        gaussian = tl.load(gaussians + tl.load(ranks + j, mask=there, other=0), mask=there, other=0)
        first_slot = tl.load(slot_starts + tl.load(slots + j, mask=there, other=0), mask=there, other=0)
        slot = first_slot[:, None] + tl.cumsum(present, 1) - present
        owners = tl.broadcast_to(gaussian[:, None], [PAIRS, BLOCKS]).to(tl.int32)
        tl.store(piece_gaussians + target, owners, mask=has_piece)
        tl.store(piece_slots + target, slot.to(piece_slots.dtype.element_ty), mask=has_piece)
        piece += tl.sum(present, 0)
        k += PAIRS
    tl.store(transmittances + pixel, final, mask=inside)


@triton.jit
def _load_pieces(weights, k, end, P: tl.constexpr):
    """Return the weights [P, 16] of the next P pieces of a block, their indices [P], and which of them exist [P]."""
    j = k.to(tl.int64) + tl.arange(0, P)
    there = j < end
    cells = weights + PIECE * j[:, None] + tl.arange(0, PIECE)[None, :]
    return tl.load(cells, mask=there[:, None], other=0.0).to(tl.float32), j, there


@triton.jit
def apply_pieces(
    block_starts, gaussians, weights, colors, background, transmittances, image, width, height, across,
    SCALE: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Render the image [h, width, 3] from cached weights; one program per block."""
    inside, pixel = _block_pixels(tl.program_id(0), width, height, across)
    k, end = tl.load(block_starts + tl.program_id(0)), tl.load(block_starts + tl.program_id(0) + 1)
    red, green, blue = (
        tl.zeros([P, PIECE], tl.float32),
        tl.zeros([P, PIECE], tl.float32),
        tl.zeros([P, PIECE], tl.float32),
    )
    while k < end:
        piece_weights, j, there = _load_pieces(weights, k, end, P)
        color = colors + 3 * tl.load(gaussians + j, mask=there, other=0).to(tl.int64)
        red += piece_weights * tl.load(color, mask=there, other=0.0)[:, None]
        green += piece_weights * tl.load(color + 1, mask=there, other=0.0)[:, None]
        blue += piece_weights * tl.load(color + 2, mask=there, other=0.0)[:, None]
        k += P
    left = tl.load(transmittances + pixel, mask=inside, other=0.0)
    tl.store(image + 3 * pixel, tl.sum(red, 0) * (1.0 / SCALE) + left * tl.load(background), mask=inside)
    tl.store(image + 3 * pixel + 1, tl.sum(green, 0) * (1.0 / SCALE) + left * tl.load(background + 1), mask=inside)
    tl.store(image + 3 * pixel + 2, tl.sum(blue, 0) * (1.0 / SCALE) + left * tl.load(background + 2), mask=inside)


@triton.jit
def piece_gradients(
    block_starts, slots, weights, image_gradient, out, width, height, across,
    SCALE: tl.constexpr, P: tl.constexpr,
):  # fmt: skip
    """Write dL/dcolor of every piece to its slot [P, 3]; one program per block."""
    inside, pixel = _block_pixels(tl.program_id(0), width, height, across)
    red = tl.load(image_gradient + 3 * pixel, mask=inside, other=0.0)
    green = tl.load(image_gradient + 3 * pixel + 1, mask=inside, other=0.0)
    blue = tl.load(image_gradient + 3 * pixel + 2, mask=inside, other=0.0)
    k, end = tl.load(block_starts + tl.program_id(0)), tl.load(block_starts + tl.program_id(0) + 1)
    while k < end:
        piece_weights, j, there = _load_pieces(weights, k, end, P)
        slot = out + 3 * tl.load(slots + j, mask=there, other=0).to(tl.int64)
        tl.store(slot, tl.sum(piece_weights * red[None, :], 1) * (1.0 / SCALE), mask=there)
        tl.store(slot + 1, tl.sum(piece_weights * green[None, :], 1) * (1.0 / SCALE), mask=there)
        tl.store(slot + 2, tl.sum(piece_weights * blue[None, :], 1) * (1.0 / SCALE), mask=there)
        k += P
