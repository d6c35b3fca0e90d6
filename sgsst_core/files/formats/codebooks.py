"""Codebooks of compressed scenes: 256 values for numbers, and a palette for vectors of SH coefficients.

Both are found by Lloyd's algorithm (k-means) from deterministic starts. If there are no more distinct values than
entries, the codebook holds them exactly, in an order that depends on the values alone, so a scene that was read from
codebooks is written without further loss.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Number of values of a codebook, one per byte.
VALUES = 256
_VALUE_ITERATIONS = 60
#: Maximum number of starts of a codebook. Only numbers with extreme values need more than one.
_VALUE_STARTS = 4

#: Clusters of the first level of a palette, rows that they are fitted to, and iterations per level.
_COARSE = 256
_COARSE_ROWS = 1 << 16
_COARSE_ITERATIONS = 8
_FINE_ITERATIONS = 6
#: Number of rows whose distances to all centers are in memory at a time.
_BLOCK_ROWS = 1 << 14


def value_codebook(values: NDArray[Any]) -> NDArray[np.float32]:
    """Return the codebook of numbers of any shape, [VALUES] float32 in ascending order, padded with its largest value.

    Lloyd's algorithm on sorted numbers: a cluster is an interval, whose mean follows from two cumulative sums. It
    starts with entries whose density is the cube root of that of the numbers, which is best for a fine quantizer. While
    extreme numbers leave most entries unused, these are moved to where the error is.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    distinct = ordered[np.concatenate([[True], ordered[1:] != ordered[:-1]])]
    if len(distinct) <= VALUES:
        return _padded(distinct.astype(np.float32))
    origin = ordered.mean()  # sums of differences from the mean cancel less
    sums = np.concatenate([[0.0], np.cumsum(ordered - origin)])
    codebook = _companded(ordered)
    for _ in range(_VALUE_STARTS):
        for _ in range(_VALUE_ITERATIONS):
            edges = np.concatenate([[0], np.searchsorted(ordered, _middles(codebook)), [len(ordered)]])
            counts = np.diff(edges)
            means = origin + np.diff(sums[edges]) / np.maximum(counts, 1)
            codebook = np.sort(np.where(counts > 0, means, codebook))
        entries = codebook.astype(np.float32)
        used = entries[np.unique(nearest_entries(ordered, entries))]
        if len(used) >= VALUES // 2:
            break
        codebook = _with_unused_entries(ordered, used)
    return _padded(used)


def _with_unused_entries(ordered: NDArray[np.float64], used: NDArray[np.float32]) -> NDArray[np.float64]:
    """Add entries up to VALUES, in each cluster of sorted numbers in proportion to the cube root of its squared error.

    They are evenly spaced within the numbers of a cluster.
    """
    labels = nearest_entries(ordered, used)
    first = np.searchsorted(labels, np.arange(len(used)))
    last = np.append(first[1:], len(ordered)) - 1
    cumulative = np.cumsum(np.cbrt(np.bincount(labels, (ordered - used[labels]) ** 2)))
    bounds = np.repeat(np.append(0.0, cumulative), 2)[1:-1]
    shares = (np.arange(VALUES - len(used)) + 0.5) / (VALUES - len(used))
    added = np.interp(shares * cumulative[-1], bounds, np.stack([ordered[first], ordered[last]], axis=1).ravel())
    return np.sort(np.concatenate([used, added]))


def _padded(entries: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.pad(entries, (0, VALUES - len(entries)), mode="edge")


def _companded(ordered: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return VALUES entries whose density is the cube root of that of sorted numbers."""
    bins = 4096
    counts, edges = np.histogram(ordered, bins)
    cumulative = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    shares = (np.arange(VALUES) + 0.5) / VALUES
    entries: NDArray[np.float64] = np.interp(shares * cumulative[-1], cumulative, edges)
    return entries


def _middles(codebook: NDArray[Any]) -> NDArray[np.float64]:
    wide = codebook.astype(np.float64)
    return (wide[1:] + wide[:-1]) / 2


def nearest_entries(values: NDArray[Any], codebook: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return the index of the nearest entry of an ascending codebook for each number, as uint8."""
    return np.searchsorted(_middles(codebook), values.astype(np.float64)).astype(np.uint8)


def palette(rows: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return at most `size` vectors [K, D] that represent rows [n, D], and the index of each row's vector, [n].

    Rows are clustered in two levels: each of `_COARSE` clusters is divided into a number of clusters that is
    proportional to its squared error. A row is compared with some hundred centers rather than with all of them.
    """
    distinct, labels = _distinct_rows(rows, size)
    if distinct is not None:
        return distinct, labels
    sample = rows[:: max(1, len(rows) // _COARSE_ROWS)]
    coarse = _lloyd(sample, _start(sample, _COARSE), _COARSE_ITERATIONS)
    groups, distances = _nearest_rows(rows, coarse)
    counts = np.bincount(groups, minlength=len(coarse))
    errors = np.bincount(groups, weights=distances, minlength=len(coarse))
    shares = np.minimum(counts, np.maximum(1, np.floor((size - _COARSE) * errors / max(errors.sum(), 1e-30)) + 1))
    order = np.argsort(groups, kind="stable")
    centers: list[NDArray[np.float32]] = []
    first = 0
    for members, share in zip(np.split(order, np.cumsum(counts)[:-1]), shares.astype(int), strict=True):
        if not len(members):
            continue
        own = rows[members]
        own_centers = _lloyd(own, _start(own, share), _FINE_ITERATIONS)
        labels[members] = first + _nearest_rows(own, own_centers)[0]
        centers.append(own_centers)
        first += len(own_centers)
    return np.concatenate(centers), labels


def _distinct_rows(rows: NDArray[np.float32], size: int) -> tuple[NDArray[np.float32] | None, NDArray[np.int64]]:
    """Return the distinct rows and each row's index among them; None and zeros if there are more than `size`."""
    none = None, np.zeros(len(rows), np.int64)
    keys = np.ascontiguousarray(rows).view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).reshape(-1)
    if len(np.unique(keys[: 2 * size])) > size:
        return none
    _, first, labels = np.unique(keys, return_index=True, return_inverse=True)
    return none if len(first) > size else (rows[first], labels.reshape(-1).astype(np.int64))


def _start(rows: NDArray[np.float32], count: int) -> NDArray[np.float32]:
    """Return `count` rows that are spread evenly along the direction of the largest variance."""
    middle = rows - rows.mean(axis=0)
    _, vectors = np.linalg.eigh(middle.T.astype(np.float64) @ middle)
    order = np.argsort(middle @ vectors[:, -1].astype(np.float32), kind="stable")
    return rows[order[((np.arange(count) + 0.5) / count * len(rows)).astype(np.int64)]]


def _lloyd(rows: NDArray[np.float32], centers: NDArray[np.float32], iterations: int) -> NDArray[np.float32]:
    """Return centers after some iterations of Lloyd's algorithm. Centers without rows stay."""
    if len(rows) <= len(centers):
        return centers
    for _ in range(iterations):
        labels, _ = _nearest_rows(rows, centers)
        order = np.argsort(labels, kind="stable")
        used, first = np.unique(labels[order], return_index=True)
        sums = np.add.reduceat(rows[order].astype(np.float64), first, axis=0)
        centers = centers.copy()
        centers[used] = sums / np.diff(np.append(first, len(rows)))[:, None]
    return centers


def _nearest_rows(
    rows: NDArray[np.float32], centers: NDArray[np.float32]
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the index of each row's nearest center, and its squared distance."""
    labels = np.empty(len(rows), np.int64)
    distances = np.empty(len(rows), np.float32)
    lengths = (centers**2).sum(axis=1)
    for start in range(0, len(rows), _BLOCK_ROWS):
        block = rows[start : start + _BLOCK_ROWS]
        scores = lengths - 2 * (block @ centers.T)
        nearest = scores.argmin(axis=1)
        labels[start : start + len(block)] = nearest
        distances[start : start + len(block)] = ((block - centers[nearest]) ** 2).sum(axis=1)
    return labels, distances
