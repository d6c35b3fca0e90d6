"""Which Gaussians of a scene lie somewhere, or have a property: [N] bool from [N, 3] positions or [N] values.

Positions are compared in float64; borders belong to what they enclose. NaN is nowhere and compares with nothing.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

#: How a property is compared with a number.
COMPARISONS: dict[str, Callable[[Tensor, float], Tensor]] = {
    ">=": operator.ge,
    "<=": operator.le,
    "!=": operator.ne,
    ">": operator.gt,
    "<": operator.lt,
    "=": operator.eq,
}


def in_box(means: Tensor, corners: Sequence[float]) -> Tensor:
    """Between two opposite corners x0, y0, z0, x1, y1, z1, in whatever order."""
    first, second = torch.tensor([corners[:3], corners[3:]], dtype=torch.float64)
    places = means.double()
    return ((places >= torch.minimum(first, second)) & (places <= torch.maximum(first, second))).all(dim=1)


def in_sphere(means: Tensor, sphere: Sequence[float]) -> Tensor:
    """No farther from x, y, z than r."""
    *middle, radius = sphere
    distance: Tensor = (means.double() - torch.tensor(middle, dtype=torch.float64)).norm(dim=1)
    return distance <= radius


def in_half_space(means: Tensor, plane: Sequence[float]) -> Tensor:
    """Where a x + b y + c z >= d."""
    *normal, distance = plane
    height: Tensor = means.double() @ torch.tensor(normal, dtype=torch.float64)
    return height >= distance


def where_property(values: Tensor, sign: str, number: float) -> Tensor:
    """Where values [N] compare like that; float32 values with the number as float32, so that "=" can hold."""
    return COMPARISONS[sign](values, torch.tensor(number).to(values).item()) & ~values.isnan()
