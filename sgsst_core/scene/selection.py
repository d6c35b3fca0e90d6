"""Selection of Gaussians by position or property.

Functions return a mask [N] bool, from positions [N, 3] or values [N]. Positions are compared in float64; boundaries are
included. NaN is never selected.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

#: Comparisons of a property with a number.
COMPARISONS: dict[str, Callable[[Tensor, float], Tensor]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
    "=": operator.eq,
}


def in_box(means: Tensor, corners: Sequence[float]) -> Tensor:
    """Select positions between two opposite corners x0, y0, z0, x1, y1, z1, in any order."""
    first, second = torch.tensor([corners[:3], corners[3:]], dtype=torch.float64)
    positions = means.double()
    return ((positions >= torch.minimum(first, second)) & (positions <= torch.maximum(first, second))).all(dim=1)


def in_sphere(means: Tensor, sphere: Sequence[float]) -> Tensor:
    """Select positions within distance r of x, y, z."""
    *middle, radius = sphere
    distance: Tensor = (means.double() - torch.tensor(middle, dtype=torch.float64)).norm(dim=1)
    return distance <= radius


def in_half_space(means: Tensor, plane: Sequence[float]) -> Tensor:
    """Select positions with a x + b y + c z >= d."""
    *normal, distance = plane
    height: Tensor = means.double() @ torch.tensor(normal, dtype=torch.float64)
    return height >= distance


def where_property(values: Tensor, sign: str, number: float) -> Tensor:
    """Select values [N] by comparison with a number, which is converted to their dtype so that "=" can match."""
    return COMPARISONS[sign](values, torch.tensor(number).to(values).item()) & ~values.isnan()
