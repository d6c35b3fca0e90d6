"""Content term: lambda_c mean((F_42 - F_42^content)^2), the mean weighted by coverage.

If the content weight differs between regions, the squared difference of position p counts v_p <= 1 times, where
lambda_c v_p is the blended content weight of the Gaussians there. The sum is still divided by the coverage, so a
position counts as much as with that weight everywhere:

    lambda_c sum_p v_p |F_42 - F_42^content|_p^2 / (c sum_p a_p)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from sgsst_core.devices import on_device
from sgsst_core.features.partition import PartitionTile
from sgsst_core.features.statistics import block_of_channels, can_be_fused, row_cells
from sgsst_core.features.vgg import CONTENT_LAYER
from sgsst_core.loss.position_term import Objective, PositionTerm, ScaledView, TermInputs
from sgsst_core.loss.targets import ContentFeatures, PositionWeights

#: Positions per program of the GPU kernels: 4,096 values of the content layer's 512 channels.
POSITIONS = 8


def content_factor(count: Tensor, channels: int, weight: float) -> Tensor:
    """Return lambda_c / (n c), the factor of the content term of a whole view, float64 scalar.

    Args:
        count: n, float64 scalar: number of positions or sum of their weights. If it is 0, the factor is 0.
        weight: lambda_c.
    """
    return weight / (torch.where(count > 0, count, torch.inf) * channels)


@dataclass(frozen=True)
class ContentDifference:
    """Difference between content features and their target on some cells.

    Attributes:
        difference: [h, w, c], float32 or float64.
        weighted: Difference times the position weights.
        factor: lambda_c / (n c), float64, where n is the number of positions of the view or the sum of their weights.
    """

    difference: Tensor
    weighted: Tensor
    factor: Tensor

    @staticmethod
    def of(
        features: Tensor, content: Tensor, factor: Tensor, position_weights: Tensor | None = None
    ) -> ContentDifference:
        """Compare features of the image with those of the content image at the same positions.

        Args:
            features: [h, w, c].
            content: [h, w, c].
            position_weights: [h, w]; None for equal weights.
        """
        precision = torch.promote_types(features.dtype, torch.float32)
        difference = features.to(precision) - content.to(precision)
        weighted = difference if position_weights is None else difference * position_weights[:, :, None].to(precision)
        return ContentDifference(difference, weighted, factor)

    def loss(self) -> Tensor:
        """Return the contribution of these cells to the content loss, float64 scalar."""
        # A float32 dot product over a whole view would lose digits, so rows are summed first and then added in float64.
        return self.factor * (self.weighted * self.difference).sum(dim=(1, 2)).sum(dtype=torch.float64)

    def gradient(self) -> Tensor:
        """Return the gradient with respect to the features, [h, w, c]."""
        return self.weighted * (2 * self.factor)


@dataclass(frozen=True)
class ContentTerm(PositionTerm):
    """Content term of one scale of a view."""

    name = "content"
    label = "content"

    view: ScaledView
    content: ContentFeatures
    position_weights: PositionWeights
    factor: Tensor

    @staticmethod
    def layers(objective: Objective) -> tuple[str, ...]:
        """Return the content layer, if the objective has a content term."""
        return (CONTENT_LAYER,) if objective.content_weight else ()

    @classmethod
    def of(cls, inputs: TermInputs) -> Self | None:
        """Return the term of one scale of a view; None if the loss does not have it."""
        if inputs.content is None:
            return None
        count = inputs.view.count(CONTENT_LAYER, inputs.coverage)
        network = inputs.network
        weight = inputs.objective.content_weight * network.feature_unit**2 * network.loss_factor
        factor = content_factor(count, network.channels(CONTENT_LAYER), weight)
        weights = inputs.coverage if inputs.content_weights is None else inputs.content_weights
        return cls(inputs.view, inputs.content, weights, factor)

    def value(self, tile: PartitionTile, features: Mapping[str, Tensor]) -> Tensor:
        """Return the contribution of the cells that a tile owns, float64 scalar."""
        owned = self._owned(tile, features[CONTENT_LAYER])
        if _can_be_fused(*owned[:2]):
            return self.factor * fused_content_sum(*owned)
        return self._difference(*owned).loss()

    def add_gradient(self, tile: PartitionTile, layer: str, features: Tensor, gradient: Tensor) -> bool | None:
        """Add the derivative of `value` with respect to a layer's features to a gradient in place."""
        if layer != CONTENT_LAYER:
            return None
        owned = self._owned(tile, features)
        added = gradient[tile.owned_cells(CONTENT_LAYER, self.view.size)[1].slices]
        if _can_be_fused(*owned[:2], added):
            relu = added.shape == gradient.shape
            fused_add_content_gradient(added, *owned, self.factor, relu=relu)
            return relu
        added += self._difference(*owned).gradient()
        return False

    def _owned(self, tile: PartitionTile, features: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return features, content and position weights of the cells that a tile owns."""
        in_view, in_tile = tile.owned_cells(CONTENT_LAYER, self.view.size)
        weights = self.view.weights(CONTENT_LAYER, in_view, self.position_weights)
        return features[in_tile.slices], self.content[tile], weights

    def _difference(self, features: Tensor, content: Tensor, weights: Tensor | None) -> ContentDifference:
        return ContentDifference.of(features, content, self.factor, weights)


# --- on a GPU: one kernel launch each ---


def fused_content_sum(features: Tensor, content: Tensor, position_weights: Tensor | None = None) -> Tensor:
    """Return the sum of a_p |F_p - content_p|^2 as `ContentDifference.loss` computes it, float64 scalar."""
    from sgsst_core.loss import content_kernels as kernels

    launch, constants = _launch(features, content, position_weights)
    programs = -(-launch[0] // POSITIONS)
    sums = torch.empty(programs, device=features.device)
    weights = features if position_weights is None else position_weights
    if programs:
        with on_device(features.device):
            kernels.content_sums[(programs,)](features, content, weights, sums, *launch, **constants)
    return sums.sum(dtype=torch.float64)


def fused_add_content_gradient(
    gradient: Tensor,
    features: Tensor,
    content: Tensor,
    position_weights: Tensor | None,
    factor: Tensor,
    *,
    relu: bool = False,
) -> None:
    """Add `ContentDifference.gradient` to a gradient [h, w, c], and pass it through the features' ReLU if `relu`."""
    from sgsst_core.loss import content_kernels as kernels

    launch, constants = _launch(features, content, position_weights)
    weights = features if position_weights is None else position_weights
    if programs := -(-launch[0] // POSITIONS):
        with on_device(features.device):
            kernels.add_content_gradient[(programs,)](
                features, content, weights, gradient, factor, *launch, row_cells(gradient), RELU=relu, **constants
            )


def _launch(
    features: Tensor, content: Tensor, position_weights: Tensor | None
) -> tuple[tuple[int, ...], dict[str, int | bool]]:
    """Return the numbers and constants that both kernels take."""
    height, width, channels = features.shape
    steps = (0, 0) if position_weights is None else position_weights.stride()[:2]
    numbers = (height * width, width, row_cells(features), row_cells(content), *steps)
    block = block_of_channels(channels)
    return numbers, {"CHANNELS": channels, "BLOCK": block, "P": POSITIONS, "WEIGHTED": position_weights is not None}


def _can_be_fused(*tensors: Tensor) -> bool:
    return all(can_be_fused(each) and each.dtype == tensors[0].dtype for each in tensors)
