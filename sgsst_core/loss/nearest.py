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

import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import reduce
from typing import Self

import torch
from torch import Tensor

from sgsst_core.features.network_sources import BLOCKS, KAPPA
from sgsst_core.features.partition import PartitionTile, Rectangle
from sgsst_core.loss.position_term import Objective, PositionTerm, ScaledView, TermInputs
from sgsst_core.loss.targets import PositionWeights, StyleVectors, at_least_float32
from sgsst_core.settings import StyleLossName
from sgsst_core.timing import Timer

#: Maximum number of style vectors to search. Style images larger than 360 x 360 pixels have more vectors, and are
#: subsampled evenly. Little is lost, because the receptive fields of neighboring vectors overlap almost completely. A
#: larger search would take longer than the forward and backward passes of the network.
MAX_VECTORS = 1 << 13
#: Number of positions and number of style vectors per block of the search, by device. The similarities of a block fit
#: in the CPU cache; on a GPU, they take a quarter of a gigabyte.
_BLOCK = {"cpu": (1 << 10, 1 << 10), "cuda": (1 << 13, 1 << 13)}
#: w_n for `nnfm`. With content_weight 1, the nearest-neighbor and content terms are balanced as in ARF for 360-degree
#: scenes (content weight 5e-3 in units of ImageNet-normalized features: github.com/Kai-46/ARF-svox2, opt/try_tnt.sh).
NNFM_WEIGHT = KAPPA**2 / 5e-3
#: w_n for `mixed`. Within 20 to 30 steps, the color gradient of the statistics terms falls to a tenth. With this
#: weight, the color gradient of the nearest-neighbor term then has the same norm. Four pairs of scene and painting need
#: 1.8e8 to 1.7e9; the constant is their geometric mean. It does not depend on the scene, so that a job has the same
#: loss wherever it runs or resumes.
MIXED_WEIGHT = 5e8
#: w_n of each loss for features in units of a 0-255 input; 0 if the loss matches no features.
NEAREST_WEIGHTS: dict[StyleLossName, float] = {"sos": 0.0, "nnfm": NNFM_WEIGHT, "mixed": MIXED_WEIGHT}


def nearest_weight(style_loss: StyleLossName, unit: float = 1.0) -> float:
    """Return w_n, the weight of the nearest-neighbor term.

    It is scaled by the square of the feature unit (`FeatureNetwork.unit`), because the terms that it is balanced
    against grow by this factor.
    """
    return NEAREST_WEIGHTS[style_loss] * unit**2


def nearest_layers(style_loss: StyleLossName, network: str) -> tuple[str, ...]:
    """Return the layers whose features are matched: all of the third block, as in ARF, or none."""
    count = BLOCKS[network][2] if NEAREST_WEIGHTS[style_loss] else 0
    return tuple(f"relu3_{index}" for index in range(1, count + 1))


def positions_per_image(counts: Sequence[int], weights: Sequence[float], most: int) -> list[int]:
    """Return how many positions to take from each image of a style.

    If there are at most `most` positions in total, all are taken. Otherwise each image contributes in proportion to its
    weight, but at least one position if it has any.
    """
    if sum(counts) <= most:
        return list(counts)
    return [min(count, max(1, int(most * weight))) for count, weight in zip(counts, weights, strict=True)]


def positions_in(positions: Tensor, width: int, cells: Rectangle) -> tuple[Tensor, Tensor, Tensor]:
    """Select the row-major positions in a feature map of the given width that lie inside a rectangle.

    Returns:
        Mask [k] bool of those inside, and their rows and columns relative to the rectangle.
    """
    row, column = positions // width, positions % width
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
            block = torch.cat([at_least_float32(features[layer][part]) for layer in style.parts], dim=2)
            lengths = block.norm(dim=2)
            # NaN fails this comparison, so NaN features keep a NaN norm.
            inverse[part] = torch.where(lengths <= rounding * style.length, torch.inf, lengths).reciprocal()
            block *= inverse[part][:, :, None]
            if position_weights is not None and units.device.type == "cpu":
                covered = position_weights[part] > 0
                cosine[part][covered], nearest[part][covered] = search(block[covered], units)
            else:
                values, positions = search(block.reshape(-1, block.shape[2]), units)
                cosine[part], nearest[part] = values.view(lengths.shape), positions.view(lengths.shape)
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
            style: Style vectors that were passed to `of`.
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
            own = at_least_float32(features[part]) * (self.cosine[part] * inverse)[:, :, None]
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
            values, positions = (units[part] @ style[first : first + columns].T).max(dim=1)
            nearer = values > best[part]
            best[part] = torch.where(nearer, values, best[part])
            nearest[part] = torch.where(nearer, positions + first, nearest[part])
    return best, nearest


@dataclass(frozen=True)
class NearestTerm(PositionTerm):
    """Nearest-neighbor term of one scale of a view.

    The matches of each tile are stored for the second pass: they take a few bytes per cell, while the search is slow.

    Attributes:
        layer: First of the matched layers, which all have the same cells.
        rounding: Relative rounding error of the features.
        regions: Style vectors, factor of the distances and position weights of each region.
        matches: Matches of each tile, by region.
    """

    name = "nearest"
    label = "nearest neighbors"

    view: ScaledView
    layer: str
    rounding: float
    timer: Timer
    regions: list[tuple[StyleVectors, Tensor, PositionWeights]]
    matches: dict[PartitionTile, list[Matches]] = field(default_factory=dict)

    @staticmethod
    def layers(objective: Objective) -> tuple[str, ...]:
        """Return the matched layers."""
        return nearest_layers(objective.style_loss, objective.network)

    @classmethod
    def of(cls, inputs: TermInputs) -> Self | None:
        """Return the term of one scale of a view; None if the loss does not have it."""
        network, layers = inputs.network, cls.layers(inputs.objective)
        regions = []
        for style in inputs.regions if layers else ():
            if style.vectors is not None:
                count = inputs.view.count(layers[0], style.positions)
                weight = style.weight * nearest_weight(inputs.objective.style_loss, network.unit) * network.loss_factor
                factor = weight / torch.where(count > 0, count, torch.inf)
                regions.append((style.vectors, factor, style.positions))
        return cls(inputs.view, layers[0], network.rounding, inputs.timer, regions) if regions else None

    def value(self, tile: PartitionTile, features: Mapping[str, Tensor]) -> Tensor:
        """Return the contribution of the cells that a tile owns, float64 scalar."""
        in_view, in_tile = tile.owned_cells(self.layer, self.view.size)
        self.matches[tile] = []
        sums = []
        for vectors, factor, pyramid in self.regions:
            weights = self.view.weights(self.layer, in_view, pyramid)
            owned = {layer: features[layer][in_tile.slices] for layer in vectors.parts}
            with self.timer("matching"):
                matches = Matches.of(owned, vectors, self.rounding, weights)
                sums.append(factor * matches.distance(weights))
            self.matches[tile].append(matches)
        return reduce(operator.add, sums)

    def add_gradient(self, tile: PartitionTile, layer: str, features: Tensor, gradient: Tensor) -> bool | None:
        """Add the derivative of `value` with respect to a layer's features to a gradient in place."""
        added = None
        for (vectors, factor, pyramid), matches in zip(self.regions, self.matches[tile], strict=True):
            if layer in vectors.parts:
                in_view, in_tile = tile.owned_cells(layer, self.view.size)
                weights = self.view.weights(layer, in_view, pyramid)
                owned = gradient[in_tile.slices], features[in_tile.slices]
                matches.add_gradient(*owned, layer, vectors, factor, weights)
                added = False
        return added
