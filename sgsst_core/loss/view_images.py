"""Image of a view at the scales of an evaluation, and the gradient with respect to it.

A single rank has the whole image. Each of several ranks has the pixels that it renders: its piece of the finest scale,
and the halo of this piece. Each rank's pixels of coarser scales are put together from all ranks' pieces.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

from torch import Tensor

from sgsst_core.features.partition import Rectangle
from sgsst_core.loss.position_term import ScaledView
from sgsst_core.loss.tiling import Division
from sgsst_core.parallel.collectives import Collectives
from sgsst_core.parallel.division import ImageExchange
from sgsst_core.scene.pyramid import add_upscaled_, downscale
from sgsst_core.timing import Timer


class ViewImages:
    """Image of a view at several scales.

    All ranks must create it and call `gradient` together.

    Args:
        image: [h, w, 3], image of the view, or of this rank's window of `division.shares`.
        background: Color of the pixels that no rank renders.
    """

    def __init__(
        self,
        image: Tensor,
        division: Division,
        background: tuple[float, float, float],
        collectives: Collectives,
        timer: Timer,
    ) -> None:
        self._collectives, self._timer = collectives, timer
        shares = division.shares
        whole = Rectangle(0, 0, image.shape[0], image.shape[1])
        self._own = _Pixels(image, 0, whole if shares is None else shares.windows[collectives.rank])
        self._size = whole.shape if shares is None else shares.size
        self._shares = shares
        #: Rectangles of each image that ranks exchange, by scale, and the pixels of it that this rank needs.
        self._exchanges: dict[int, ImageExchange] = {}
        self._coarse: dict[int, _Pixels] = {}
        if shares is not None and any(scale != shares.scale for scale in division.pieces):
            by_rank = [list(itertools.chain(*own)) for own in zip(*division.pieces.values(), strict=True)]
            self._exchanges = shares.exchanges(by_rank, division.halo)
            #: This rank's part of the view, relative to its window.
            self._part = shares.parts[collectives.rank].within(self._own.area)
            self._gather(background)

    def _gather(self, background: tuple[float, float, float]) -> None:
        """Exchange the coarser images between ranks."""
        own = [downscale(self._own.image[self._part.slices], scale) for scale in self._exchanges]
        for scale, exchange in self._exchanges.items():
            area = exchange.windows[self._collectives.rank]
            image = self._own.image.new_empty((*area.shape, 3))
            for channel, color in zip(image.unbind(-1), background, strict=True):
                channel.fill_(color)  # scalars are kernel arguments, so the host does not wait for a copy to the device
            self._coarse[scale] = _Pixels(image, scale, area)
        with self._timer("communication"):
            windows = [pixels.image for pixels in self._coarse.values()]
            self._collectives.gather_parts([*self._exchanges.values()], own, windows)

    def scaled(self, scale: int) -> ScaledView:
        """Return the pixels of a scale that this rank needs."""
        return self._source(scale).scaled(scale, (self._size[0] >> scale, self._size[1] >> scale))

    def add_gradient(self, scale: int, gradient: Tensor, factor: float) -> None:
        """Add the gradient with respect to the pixels of `scaled(scale)`, times a factor."""
        self._source(scale).add_gradient(scale, gradient, factor)

    def gradient(self) -> Tensor:
        """Return this rank's summand of the gradient with respect to the image, [h, w, 3]."""
        if self._exchanges:
            gradients = [image.gradient for image in self._coarse.values() if image.gradient is not None]
            with self._timer("communication"):
                own = self._collectives.reduce_parts([*self._exchanges.values()], gradients)
            for scale, gradient in zip(self._exchanges, own, strict=True):
                self._own.add_gradient(scale, gradient, area=self._part)
        assert self._own.gradient is not None
        return self._own.gradient

    def _source(self, scale: int) -> _Pixels:
        """Return the pixels from which those of a scale are computed."""
        if self._shares is None or scale == self._shares.scale:
            return self._own
        return self._coarse[self._shares.exchanged_scale(scale)]


@dataclass
class _Pixels:
    """Rectangle of a scaled view, and the gradient with respect to it.

    Attributes:
        area: Rectangle of the scaled view.
        gradient: [h, w, 3]; None before the first `add_gradient`.
    """

    image: Tensor
    scale: int
    area: Rectangle
    gradient: Tensor | None = None

    def scaled(self, scale: int, size: tuple[int, int]) -> ScaledView:
        """Return these pixels at a scale of the view of size (height, width)."""
        further = scale - self.scale
        return ScaledView(downscale(self.image, further), scale, size, self.area.at_scale(further))

    def add_gradient(self, scale: int, gradient: Tensor, factor: float = 1.0, area: Rectangle | None = None) -> None:
        """Add the gradient with respect to these pixels at a scale, or to an area of them, times a factor."""
        if self.gradient is None:
            self.gradient = gradient.new_zeros(self.image.shape)
        target = self.gradient if area is None else self.gradient[area.slices]
        add_upscaled_(target, gradient, scale - self.scale, factor)
