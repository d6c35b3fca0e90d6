"""Depth sort of Gaussians on all cores: a stable sort of positive float64 numbers.

Positive floats have the same order as their bits interpreted as integers. A parallel counting sort by the upper bits
distributes the Gaussians over many buckets; then each bucket is sorted separately. Gaussians of equal depth keep the
order of the file, so the result is that of any stable sort, for any number of threads.
"""

# Arguments are untyped: Numba compiles one version per argument type.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

from sgsst_core.compiled import compiled, kernel_threads

#: Gaussians per bucket if depths are spread evenly.
_BUCKET = 16
_MAX_BUCKETS = 1 << 17
#: Buckets of up to this size are sorted by insertion, larger ones by merging.
_INSERTED = 48


def depth_order(depths: NDArray[np.float64], visible: NDArray[np.integer]) -> NDArray[np.int32]:
    """Sort the indices of visible Gaussians by depth; equal depths stay in index order.

    Args:
        depths: [N] float64; positive for visible Gaussians, because the near plane is at a positive depth.
        visible: [V], ascending indices into `depths`.

    Returns:
        `visible` sorted by depth, int32.
    """
    count = len(visible)
    if not count:
        return np.empty(0, dtype=np.int32)
    with kernel_threads():
        threads = numba.get_num_threads()
        bits = np.empty(count, dtype=np.int64)
        take_elements(depths.view(np.int64), visible, bits)
        lowest, highest = int(bits.min()), int(bits.max())
        target = min(max(count // _BUCKET, 1), _MAX_BUCKETS)
        shift = max((highest - lowest).bit_length() - target.bit_length(), 0)
        buckets = ((highest - lowest) >> shift) + 1
        chunks = np.linspace(0, count, threads + 1).astype(np.int64)
        counts = np.zeros((threads, buckets), dtype=np.int64)
        _count(bits, lowest, shift, chunks, counts)
        starts = np.concatenate([np.zeros(1, dtype=np.int64), np.cumsum(counts.sum(axis=0))])
        # First position that each chunk writes to in each bucket: after all lower buckets, and after the entries of all
        # preceding chunks in the same bucket.
        offsets = starts[:-1] + np.cumsum(counts, axis=0) - counts
        order, keys = np.empty(count, dtype=np.int32), np.empty(count, dtype=np.int64)
        _scatter(bits, visible, lowest, shift, chunks, offsets, order, keys)
        bounds = np.searchsorted(starts, chunks).astype(np.int64)
        _sort_buckets(starts, bounds, keys, order)
    return order


@compiled(parallel=True)
def take_elements(values, indices, out) -> None:
    """Write values[indices] to `out` for values [N], on all cores."""
    for i in numba.prange(indices.size):
        out[i] = values[indices[i]]


@compiled(parallel=True)
def _count(bits, lowest, shift, chunks, counts):
    """Count the Gaussians of each chunk that fall into each bucket."""
    for chunk in numba.prange(chunks.size - 1):
        for i in range(chunks[chunk], chunks[chunk + 1]):
            counts[chunk, (bits[i] - lowest) >> shift] += 1


@compiled(parallel=True)
def _scatter(bits, visible, lowest, shift, chunks, positions, order, keys):
    """Copy every chunk's Gaussians into their buckets, in input order."""
    for chunk in numba.prange(chunks.size - 1):
        for i in range(chunks[chunk], chunks[chunk + 1]):
            bucket = (bits[i] - lowest) >> shift
            position = positions[chunk, bucket]
            order[position], keys[position] = visible[i], bits[i]
            positions[chunk, bucket] = position + 1


@compiled(parallel=True)
def _sort_buckets(starts, bounds, keys, order):
    """Sort each bucket by its keys, stably."""
    for thread in numba.prange(bounds.size - 1):
        for bucket in range(bounds[thread], bounds[thread + 1]):
            start, end = starts[bucket], starts[bucket + 1]
            if end - start > _INSERTED:
                sorted_ = np.argsort(keys[start:end], kind="mergesort")
                order[start:end] = order[start:end][sorted_]
                continue
            for i in range(start + 1, end):
                key, gaussian = keys[i], order[i]
                j = i
                while j > start and keys[j - 1] > key:
                    keys[j], order[j] = keys[j - 1], order[j - 1]
                    j -= 1
                keys[j], order[j] = key, gaussian
