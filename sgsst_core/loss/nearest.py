"""Nearest-neighbor feature matching (NNFM), after Zhang et al., "ARF: Artistic Radiance Fields" (ECCV 2022).

E_nearest = w_n / n sum_p a_p (1 - max_k u_p . s_k)

u_p: features of all layers of the third block at a position, one after another in one vector, of unit length; s_k: the
same of the style; a_p: position weights, n: their sum. The gradient takes the nearest style vector k(p) as given:

dE/dF_p = -(w_n / n) a_p (s_k(p) - cos_p u_p) / |F_p|

A sum over positions: a partition tile needs no other tile, and ranks add up what they find. The search is a product of
matrices, block by block. As in ARF, features are not centered.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.features.partition import Rectangle

#: Vectors of a style that are searched at most. There are more in styles of more than 360 x 360 pixels: then they are
#: thinned, evenly. Neighboring ones see nearly the same pixels, and with more the search would take longer than the
#: passes of the network.
MOST_VECTORS = 1 << 13
#: Positions and style vectors that are compared at a time: their similarities stay in a processor's cache, or make a
#: quarter of a gigabyte on a GPU.
_BLOCK = {"cpu": (1 << 10, 1 << 10), "cuda": (1 << 13, 1 << 13)}
#: Bytes of what is kept of a position that was matched.
MATCH_BYTES = 8 + 4 + 4
#: The golden ratio's fractional part: its multiples fill every interval evenly.
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class StyleVectors:
    """What positions of a view are matched with.

    Attributes:
        units: [k, c], float32 at least, of unit length; 0 where the style's features are 0.
        parts: layer to its channels among the c, in the order of the layers.
        length: of the longest one before it was brought to unit length, scalar.
    """

    units: Tensor
    parts: Mapping[str, slice]
    length: Tensor

    @staticmethod
    def of(features: Mapping[str, Tensor]) -> StyleVectors:
        """Of features [k, c_l] by layer, at the same k > 0 positions."""
        vectors = torch.cat([_at_least_float32(part) for part in features.values()], dim=1)
        lengths = vectors.norm(dim=1)
        units = vectors * torch.where(lengths > 0, lengths, torch.inf).reciprocal()[:, None]
        parts, first = {}, 0
        for layer, part in features.items():
            parts[layer] = slice(first, first + part.shape[1])
            first += part.shape[1]
        return StyleVectors(units, parts, lengths.max())


def chosen_places(count: int, most: int = MOST_VECTORS) -> Tensor:
    """At most so many of `count` places, evenly spread, int64 in rising order; all where there are no more.

    One of each part of equal length, at another place of every part: a style with a regular pattern, such as stripes,
    is not met at the same phase again and again. A place may come twice.
    """
    if count <= most:
        return torch.arange(count)
    part = torch.arange(most, dtype=torch.float64)
    return ((part + (part * _GOLDEN).frac()) * (count / most)).long().clamp_max(count - 1)


def places_in(places: Tensor, width: int, cells: Rectangle) -> tuple[Tensor, Tensor, Tensor]:
    """Which of some places, counted row by row in a map of a width, lie in a rectangle: [k] bool; rows and columns."""
    row, column = places // width, places % width
    inside = (row >= cells.top) & (row < cells.bottom) & (column >= cells.left) & (column < cells.right)
    return inside, row[inside] - cells.top, column[inside] - cells.left


@dataclass(frozen=True)
class Matches:
    """Positions [h, w] of a view and the style vectors that they are nearest to.

    Attributes:
        nearest: int64, place among the style vectors: the first of those that are equally near.
        cosine: of the angle between the two; 0 where a position's features are 0.
        inverse: 1 / |F_p|; 0 where that is no more than the rounding of features, so that nothing is divided by it.
    """

    nearest: Tensor
    cosine: Tensor
    inverse: Tensor

    @staticmethod
    def of(
        features: Mapping[str, Tensor], style: StyleVectors, rounding: float, position_weights: Tensor | None = None
    ) -> Matches:
        """Of features [h, w, c_l] by layer.

        Args:
            rounding: of the features, relative (`FeatureNetwork.rounding`).
            position_weights: [h, w]; on a CPU nothing is searched for positions of weight 0.
        """
        height, width = next(iter(features.values())).shape[:2]
        units = style.units
        nearest = torch.zeros((height, width), dtype=torch.int64, device=units.device)
        cosine = units.new_zeros((height, width))
        inverse = torch.zeros_like(cosine)
        rows = max(1, _BLOCK[units.device.type][0] // max(width, 1))
        for top in range(0, height, rows):
            part = slice(top, min(top + rows, height))
            block = torch.cat([_at_least_float32(features[layer][part]) for layer in style.parts], dim=2)
            lengths = block.norm(dim=2)
            # Compared this way round, features that are not numbers keep a length that is none.
            inverse[part] = torch.where(lengths <= rounding * style.length, torch.inf, lengths).reciprocal()
            block *= inverse[part][:, :, None]
            if position_weights is not None and units.device.type == "cpu":
                found = position_weights[part] > 0
                cosine[part][found], nearest[part][found] = search(block[found], units)
            else:
                values, places = search(block.reshape(-1, block.shape[2]), units)
                cosine[part], nearest[part] = values.view(lengths.shape), places.view(lengths.shape)
        return Matches(nearest, cosine, inverse)

    def distance(self, position_weights: Tensor | None = None) -> Tensor:
        """Sum of a_p (1 - cos_p), float64 scalar."""
        away = (1 - self.cosine.double()).clamp_min(0)  # rounding may take a cosine above 1
        return (away if position_weights is None else away * position_weights).sum()

    def add_gradient(
        self,
        gradient: Tensor,
        features: Tensor,
        layer: str,
        style: StyleVectors,
        factor: Tensor,
        position_weights: Tensor | None = None,
    ) -> None:
        """Add factor times the gradient of `distance` with respect to a layer's features [h, w, c_l], in place.

        Args:
            gradient: [h, w, c_l].
            factor: scalar.
        """
        units = style.units[:, style.parts[layer]]
        rows = max(1, _BLOCK[units.device.type][0] // max(features.shape[1], 1))
        for top in range(0, len(features), rows):
            part = slice(top, min(top + rows, len(features)))
            inverse = self.inverse[part]
            scale = inverse * factor.to(inverse)
            if position_weights is not None:
                scale = scale * position_weights[part]
            own = _at_least_float32(features[part]) * (self.cosine[part] * inverse)[:, :, None]
            gradient[part] += (own - units[self.nearest[part]]) * scale[:, :, None]


def search(units: Tensor, style: Tensor) -> tuple[Tensor, Tensor]:
    """For unit vectors [p, c] the largest product with one of [k, c], and the first that has it: [p], [p] int64.

    Products are computed block by block: p x k of them never exist together.
    """
    rows, columns = _BLOCK[units.device.type]
    best = units.new_full((len(units),), -torch.inf)
    nearest = torch.zeros(len(units), dtype=torch.int64, device=units.device)
    for top in range(0, len(units), rows):
        part = slice(top, top + rows)
        for first in range(0, len(style), columns):
            values, places = (units[part] @ style[first : first + columns].T).max(dim=1)
            nearer = values > best[part]
            best[part] = torch.where(nearer, values, best[part])
            nearest[part] = torch.where(nearer, places + first, nearest[part])
    return best, nearest


def working_bytes(channels: int, value: int, device: str) -> int:
    """Bytes that the search needs at a time beside features and style vectors of so many channels.

    Args:
        value: bytes of a value.
    """
    rows, columns = _BLOCK[device]
    return rows * (2 * columns + 3 * channels) * value


def nearest_reference(features: Sequence[Tensor], style: Sequence[Tensor], weights: Tensor | None = None) -> Tensor:
    """Mean distance to the nearest style vector by its definition, float64, in one step and differentiable.

    Args:
        features: of each layer [h, w, c_l].
        style: of each layer [h', w', c_l]; no vector of either may be 0.
        weights: [h, w].
    """
    own, other = (torch.cat([part.double() for part in parts], dim=2).flatten(0, 1) for parts in (features, style))
    cosine = (own / own.norm(dim=1, keepdim=True)) @ (other / other.norm(dim=1, keepdim=True)).T
    distance = 1 - cosine.max(dim=1).values
    a = torch.ones_like(distance) if weights is None else weights.double().flatten()
    result: Tensor = (a * distance).sum() / a.sum()
    return result


def _at_least_float32(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))
