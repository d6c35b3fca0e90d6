"""Numbers of few bits that packed scene files have in common: opacities, and rotations by their smallest three parts.

All computing is float64, so that nothing but the files' own rounding is lost.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

#: Of degree 0, what a coefficient adds to a color.
SH_C0 = 0.28209479177387814

#: A quarter of a step from the end: what 0 and 255 of 255 stand for, since full and no opacity have no finite logit.
#: Both are within the rounding of such files, and no picture of 8 bits shows a difference.
_NEARLY = 0.25 / 255
_LEAST_THREE = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def byte_table(values: NDArray[np.float64]) -> NDArray[np.float32]:
    """[256] float32, what each byte stands for."""
    return values.astype(np.float32)


def _logits() -> NDArray[np.float64]:
    share = np.clip(np.arange(256) / 255, _NEARLY, 1 - _NEARLY)
    return np.log(share / (1 - share))


#: [256] float32, logit of an opacity of so many 255ths.
OPACITY_LOGITS = byte_table(_logits())


def opacity_bytes(logits: NDArray[Any]) -> NDArray[Any]:
    """[n] uint8, opacities in 255ths of logits [n]; infinite ones are 0 and 255."""
    # by tanh, which neither overflows nor loses small values
    return np.rint(127.5 * (1 + np.tanh(0.5 * logits.astype(np.float64)))).astype(np.uint8)


def to_steps(values: NDArray[Any], most: int) -> NDArray[np.uint32]:
    """uint32, values of 0..1 in that many steps, to the nearest; what lies beyond is taken to the end."""
    steps: NDArray[np.uint32] = np.rint(np.clip(values, 0, 1) * most).astype(np.uint32)
    return steps


def with_largest(index: NDArray[Any], three: NDArray[np.float64]) -> NDArray[np.float64]:
    """[n, 4] unit quaternions of which one part, by its index [n], is left out because the others [n, 3] tell it."""
    rows = np.arange(len(index))
    found = np.empty((len(index), 4))
    found[rows[:, None], _LEAST_THREE[index]] = three
    found[rows, index] = np.sqrt(np.maximum(0, 1 - (three**2).sum(axis=1)))
    return found


def without_largest(quats: NDArray[Any]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Index [n] of the largest part of quaternions [n, 4], and the other three [n, 3] with that one made positive.

    Quaternions are normalized; one of length 0 becomes that of no rotation, if its first part is the real one.
    """
    values = quats.astype(np.float64)
    largest = np.abs(values).argmax(axis=1)
    rows = np.arange(len(values))
    length = np.linalg.norm(values, axis=1) * np.where(values[rows, largest] < 0, -1, 1)
    values = values / np.where(length == 0, 1, length)[:, None]
    return largest, values[rows[:, None], _LEAST_THREE[largest]]
