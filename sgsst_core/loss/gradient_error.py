"""Error of an approximate gradient relative to the exact one, and PSNR."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Difference:
    """Difference between two gradients.

    Attributes:
        relative_error: |actual - exact| / |exact| in the Euclidean norm. If the exact gradient is 0, the error is 0 if
            the actual gradient is also 0, and 1 otherwise.
        cosine: Cosine of the angle between the gradients. If one gradient is 0, the cosine is 1 if both are 0, and 0
            otherwise.
    """

    relative_error: float
    cosine: float

    @staticmethod
    def of(actual: Tensor, exact: Tensor) -> Difference:
        """Compare two gradients of the same shape in float64. If a value is not finite, the error is infinite."""
        error, length = (actual - exact).double().norm(), exact.double().norm()
        product = float((actual.double() * exact.double()).sum())
        lengths = float(actual.double().norm() * length)
        if not math.isfinite(lengths):
            return Difference(math.inf, 0.0)
        return Difference(
            float(error / length) if length > 0 else float(error > 0),
            product / lengths if lengths > 0 else float(not error > 0),
        )


def psnr(error: float) -> float:
    """Return the PSNR in dB for a mean squared error of values in 0..1.

    Errors below 1e-14, the float32 resolution, count as 1e-14.
    """
    return -10 * math.log10(max(error, 1e-14))
