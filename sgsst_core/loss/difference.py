"""How far a gradient is from the exact one."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Difference:
    """Of two gradients.

    Attributes:
        relative_error: |found - exact| / |exact|, Euclidean; where the exact one is 0, 0 if the other is too, else 1.
        cosine: of the angle between the two; where one of them is 0, 1 if both are, else 0.
    """

    relative_error: float
    cosine: float

    @staticmethod
    def of(found: Tensor, exact: Tensor) -> Difference:
        """Compare two gradients of one shape; float64 inside. What is not finite differs infinitely."""
        error, length = (found - exact).double().norm(), exact.double().norm()
        product = float((found.double() * exact.double()).sum())
        lengths = float(found.double().norm() * length)
        if not math.isfinite(lengths):
            return Difference(math.inf, 0.0)
        return Difference(
            float(error / length) if length > 0 else float(error > 0),
            product / lengths if lengths > 0 else float(not error > 0),
        )
