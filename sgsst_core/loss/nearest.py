"""Nearest-neighbor feature matching (NNFM), after Zhang et al., "ARF: Artistic Radiance Fields" (ECCV 2022).

E_nearest = w_n / n sum_p a_p (1 - max_k u_p . s_k)

u_p: unit vector of the concatenated features of all layers of the third block at position p of the view; s_k: unit
vector at position k of the style; a_p: position weights; n: their sum. The gradient treats the index k(p) of the
nearest style vector as constant:

dE/dF_p = -(w_n / n) a_p (s_k(p) - cos_p u_p) / |F_p|

The term is a sum over positions, so partition tiles are independent, and the results of ranks are added. The search is
a blocked matrix product. As in ARF, features are not centered.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.features.partition import Rectangle

#: Maximum number of style vectors to search. Style images larger than 360 x 360 pixels have more vectors, and are
#: subsampled evenly. Little is lost, because the receptive fields of neighboring vectors overlap almost completely. A
#: larger search would take longer than the forward and backward passes of the network.
MOST_VECTORS = 1 << 13
#: Number of positions and number of style vectors per block of the search, by device. The similarities of a block fit
#: in the CPU cache; on a GPU, they take a quarter of a gigabyte.
_BLOCK = {"cpu": (1 << 10, 1 << 10), "cuda": (1 << 13, 1 << 13)}
#: Bytes stored per matched position.
MATCH_BYTES = 8 + 4 + 4
#: Fractional part of the golden ratio; its multiples modulo 1 fill the unit interval evenly.
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True)
class StyleVectors:
    """Style vectors to match with the positions of a view.

    Attributes:
        units: Unit vectors [k, c], float32 or float64; 0 where the style's features are 0.
        parts: Slice of the c channels for each layer, in layer order.
        length: Scalar, largest norm of a vector before normalization.
    """

    units: Tensor
    parts: Mapping[str, slice]
    length: Tensor

    @staticmethod
    def of(features: Mapping[str, Tensor]) -> StyleVectors:
        """Create style vectors from features [k, c_l] by layer, all at the same k > 0 positions."""
        vectors = torch.cat([_at_least_float32(part) for part in features.values()], dim=1)
        lengths = vectors.norm(dim=1)
        units = vectors * torch.where(lengths > 0, lengths, torch.inf).reciprocal()[:, None]
        parts, first = {}, 0
        for layer, part in features.items():
            parts[layer] = slice(first, first + part.shape[1])
            first += part.shape[1]
        return StyleVectors(units, parts, lengths.max())


def chosen_places(count: int, most: int = MOST_VECTORS) -> Tensor:
    """Return at most `most` of `count` indices, evenly spread, int64 in ascending order.

    If `count` is at most `most`, all indices are returned. Otherwise the range is divided into `most` equal intervals,
    and one index is taken from each, at a varying offset. With a constant offset, a style with a regular pattern, such
    as stripes, would be sampled at the same phase everywhere. An index may appear twice.
    """
    if count <= most:
        return torch.arange(count)
    part = torch.arange(most, dtype=torch.float64)
    return ((part + (part * _GOLDEN).frac()) * (count / most)).long().clamp_max(count - 1)


def positions_per_image(counts: Sequence[int], weights: Sequence[float], most: int = MOST_VECTORS) -> list[int]:
    """Return how many positions to take from each image of a style.

    If there are at most `most` positions in total, all are taken. Otherwise each image contributes in proportion to its
    weight, but at least one position if it has any.
    """
    if sum(counts) <= most:
        return list(counts)
    return [min(count, max(1, int(most * weight))) for count, weight in zip(counts, weights, strict=True)]


def places_in(places: Tensor, width: int, cells: Rectangle) -> tuple[Tensor, Tensor, Tensor]:
    """Select the row-major positions in a feature map of the given width that lie inside a rectangle.

    Returns:
        Mask [k] bool of those inside, and their rows and columns relative to the rectangle.
    """
    row, column = places // width, places % width
    inside = (row >= cells.top) & (row < cells.bottom) & (column >= cells.left) & (column < cells.right)
    return inside, row[inside] - cells.top, column[inside] - cells.left


@dataclass(frozen=True)
class Matches:
    """Nearest style vectors of the positions [h, w] of a view.

    Attributes:
        nearest: Index of the nearest style vector, int64; the first one if several are equally near.
        cosine: Cosine of the angle between features and nearest style vector; 0 where the features are 0.
        inverse: 1 / |F_p|; 0 where |F_p| is within the rounding error of the features, to avoid dividing by that error.
    """

    nearest: Tensor
    cosine: Tensor
    inverse: Tensor

    @staticmethod
    def of(
        features: Mapping[str, Tensor], style: StyleVectors, rounding: float, position_weights: Tensor | None = None
    ) -> Matches:
        """Find the nearest style vector of every position.

        Args:
            features: Features [h, w, c_l] by layer.
            style: Style vectors to search.
            rounding: Relative rounding error of the features (`FeatureNetwork.rounding`).
            position_weights: [h, w]; None for equal weights. On a CPU, positions of weight 0 are skipped.
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
            # NaN fails this comparison, so NaN features keep a NaN norm.
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
        """Return the sum of a_p (1 - cos_p), float64 scalar."""
        away = (1 - self.cosine.double()).clamp_min(0)  # rounding can push a cosine above 1
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
        """Add `factor` times the gradient of `distance` with respect to the features of a layer to `gradient` in place.

        Args:
            gradient: [h, w, c_l].
            features: Features of the layer that were passed to `of`, [h, w, c_l].
            layer: Name of the layer.
            style: Style vectors that were passed to `of`.
            factor: Scalar.
            position_weights: [h, w]; None for equal weights.
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
    """Find the style vector [k, c] with the largest dot product for each unit vector [p, c].

    Products are computed in blocks, so the full p x k matrix is never stored.

    Returns:
        Largest product [p], and the first index that attains it [p] int64.
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
    """Return the peak memory of the search in bytes, excluding features and style vectors.

    Args:
        channels: Length of a style vector.
        value: Bytes per value.
        device: "cpu" or "cuda".
    """
    rows, columns = _BLOCK[device]
    return rows * (2 * columns + 3 * channels) * value


def nearest_reference(features: Sequence[Tensor], style: Sequence[Tensor], weights: Tensor | None = None) -> Tensor:
    """Compute the mean distance to the nearest style vector from its definition.

    The computation is in float64, unblocked and differentiable.

    Args:
        features: Features of each layer, [h, w, c_l]. The feature vector of a position must not be 0.
        style: Style features of each layer, [h', w', c_l]. The feature vector of a position must not be 0.
        weights: [h, w]; None for equal weights.
    """
    own, other = (torch.cat([part.double() for part in parts], dim=2).flatten(0, 1) for parts in (features, style))
    cosine = (own / own.norm(dim=1, keepdim=True)) @ (other / other.norm(dim=1, keepdim=True)).T
    distance = 1 - cosine.max(dim=1).values
    a = torch.ones_like(distance) if weights is None else weights.double().flatten()
    result: Tensor = (a * distance).sum() / a.sum()
    return result


def _at_least_float32(values: Tensor) -> Tensor:
    return values.to(torch.promote_types(values.dtype, torch.float32))
