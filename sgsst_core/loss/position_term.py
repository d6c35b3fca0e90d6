"""Interface of the loss terms that are sums over the positions of one scale of a view."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import ClassVar, Self

import torch
from torch import Tensor

from sgsst_core.features.partition import PartitionTile, Rectangle
from sgsst_core.features.vgg import FeatureNetwork, layer_stride
from sgsst_core.loss.targets import ContentFeatures, PositionWeights, StyleTarget
from sgsst_core.parallel.division import Size
from sgsst_core.settings import Settings, StyleLossName, make_settings
from sgsst_core.timing import Timer


@dataclass(frozen=True)
class ScaledView:
    """One scale of a view, or the pixels of it that a rank needs.

    Attributes:
        image: [h, w, 3], pixels of `area` on the network's device.
        size: (height, width) of the whole scaled view.
        area: Rectangle of the scaled view; empty if the rank needs no pixels.
    """

    image: Tensor
    scale: int
    size: Size
    area: Rectangle

    @staticmethod
    def of(image: Tensor, scale: int) -> ScaledView:
        """Return the whole of a scaled view [h, w, 3]."""
        size = (image.shape[0], image.shape[1])
        return ScaledView(image, scale, size, Rectangle(0, 0, *size))

    def pixels(self, rectangle: Rectangle) -> Tensor:
        """Return the pixels of a rectangle of the scaled view."""
        return self.image[rectangle.within(self.area).slices]

    def weights(self, layer: str, cells: Rectangle, pyramid: PositionWeights) -> Tensor | None:
        """Return the weights [h, w] of a block of cells of a layer, as box averages; None for equal weights."""
        if pyramid is None:
            return None
        return pyramid[self.scale + layer_stride(layer).bit_length() - 1][cells.slices]

    def count(self, layer: str, pyramid: PositionWeights) -> Tensor:
        """Return the sum of the weights of all cells of a layer, float64 scalar; their number for equal weights."""
        stride = layer_stride(layer)
        cells = Rectangle(0, 0, self.size[0] // stride, self.size[1] // stride)
        weights = self.weights(layer, cells, pyramid)
        if weights is not None:
            return weights.sum(dtype=torch.float64)
        return torch.full((), cells.pixels, dtype=torch.float64, device=self.image.device)


@dataclass(frozen=True)
class Objective:
    """Choice of terms.

    Attributes:
        network: Feature network, "vgg16" or "vgg19".
        content_weight: lambda_c; 0 for no content term.
    """

    network: str
    style_loss: StyleLossName = "sos"
    content_weight: float = 1.0
    settings: Settings = field(default_factory=make_settings)


@dataclass(frozen=True)
class TermInputs:
    """Inputs of the terms of one scale of a view.

    Attributes:
        regions: Style targets with the positions of their regions; a single one if the scene has no regions.
        content: Content features; None without a content term.
        coverage: Position weights of terms that do not depend on the style.
        content_weights: Position weights of the content term, relative to its weight; None for `coverage`.
    """

    view: ScaledView
    network: FeatureNetwork
    objective: Objective
    regions: Sequence[StyleTarget]
    content: ContentFeatures | None
    coverage: PositionWeights
    content_weights: PositionWeights
    timer: Timer


class PositionTerm(ABC):
    """Term that is a sum over the positions of one scale of a view.

    Every tile adds the positions that it owns. `POSITION_TERMS` in `terms` lists all such terms.

    Attributes:
        name: Name in files and reports.
    """

    name: ClassVar[str]
    label: ClassVar[str]

    @staticmethod
    @abstractmethod
    def layers(objective: Objective) -> tuple[str, ...]:
        """Return the layers that the term reads; empty if the objective does not have it."""

    @classmethod
    @abstractmethod
    def of(cls, inputs: TermInputs) -> Self | None:
        """Return the term of one scale of a view; None if the loss does not have it."""

    @abstractmethod
    def value(self, tile: PartitionTile, features: Mapping[str, Tensor]) -> Tensor:
        """Return the contribution of the cells that a tile owns, float64 scalar.

        Args:
            features: Features [h, w, c] of the whole tile by layer.
        """

    @abstractmethod
    def add_gradient(self, tile: PartitionTile, layer: str, features: Tensor, gradient: Tensor) -> bool | None:
        """Add the derivative of `value` with respect to a layer's features to a gradient in place.

        It is called for every layer that the network reports.

        Returns:
            Whether the gradient was also passed through the layer's ReLU; None if nothing was added.

        Args:
            tile: Partition tile; `value` has been called for it.
            features: [h, w, c], features of the whole tile.
            gradient: [h, w, c], gradient of the whole tile.
        """
