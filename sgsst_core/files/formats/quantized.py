"""Quantization shared by compressed scene formats: opacities, rotations by their three smallest components, and order.

All computations use float64, so that the format's own rounding is the only loss.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Opacities of exactly 0 and 1 have no finite logit, so they are read as 0.25/255 and 1 - 0.25/255. The difference is
#: below the rounding of these formats, and invisible in 8-bit images.
_MIN_OPACITY = 0.25 / 255
_OTHER_THREE = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


_OPACITIES = np.clip(np.arange(256) / 255, _MIN_OPACITY, 1 - _MIN_OPACITY)
#: Logit of the opacity i / 255 for each byte i, [256] float32.
OPACITY_LOGITS: NDArray[np.float32] = np.log(_OPACITIES / (1 - _OPACITIES)).astype(np.float32)


def opacity_bytes(logits: NDArray[Any]) -> NDArray[Any]:
    """Convert logits [n] to opacities in 255ths, [n] uint8. Infinite logits become 0 and 255."""
    # tanh neither overflows nor loses small values
    return np.rint(127.5 * (1 + np.tanh(0.5 * logits.astype(np.float64)))).astype(np.uint8)


def to_steps(values: NDArray[Any], maximum: int) -> NDArray[np.uint32]:
    """Quantize values to uint32 steps 0..maximum, which cover the range 0..1. Values outside it are clamped."""
    steps: NDArray[np.uint32] = np.rint(np.clip(values, 0, 1) * maximum).astype(np.uint32)
    return steps


def with_largest(index: NDArray[Any], three: NDArray[np.float64]) -> NDArray[np.float64]:
    """Restore unit quaternions [n, 4] from three components [n, 3] and the index [n] of the omitted one.

    The omitted component is positive, and follows from the unit length.
    """
    rows = np.arange(len(index))
    quats = np.empty((len(index), 4))
    quats[rows[:, None], _OTHER_THREE[index]] = three
    quats[rows, index] = np.sqrt(np.maximum(0, 1 - (three**2).sum(axis=1)))
    return quats


def without_largest(quats: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the index [n] of the largest component of quaternions [n, 4], and the other three components [n, 3].

    Quaternions are normalized, and their sign is chosen so that the largest component is positive. A quaternion of
    length 0 is restored as (1, 0, 0, 0), which is the identity if the real part comes first.
    """
    values = quats.astype(np.float64)
    largest = np.abs(values).argmax(axis=1)
    rows = np.arange(len(values))
    length = np.linalg.norm(values, axis=1) * np.where(values[rows, largest] < 0, -1, 1)
    values = values / np.where(length == 0, 1, length)[:, None]
    return largest, values[rows[:, None], _OTHER_THREE[largest]]


def along_curve(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the indices that sort Gaussians along a Z-order curve with 21 bits per axis."""
    low, high = means.min(axis=0).astype(np.float64), means.max(axis=0).astype(np.float64)
    cells = np.where(high > low, high - low, 1)
    code = np.zeros(len(means), np.uint64)
    for axis in range(3):
        values = to_steps((means[:, axis] - low[axis]) / cells[axis], (1 << 21) - 1).astype(np.uint64)
        # insert two empty bits after each bit
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            values = (values | (values << np.uint64(shift))) & np.uint64(mask)
        code |= values << np.uint64(axis)
    return code.argsort(kind="stable")
