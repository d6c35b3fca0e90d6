"""Interface between `cached` and the layouts of cached blend weights: `strips` on the CPU, `triton_cached` on GPUs."""

from __future__ import annotations

from typing import Literal, Protocol

from torch import Tensor

#: `half` stores weights times a power of two as float16, with a relative error of at most 2^-11 per weight.
Precision = Literal["float32", "half"]


class CachedWeights(Protocol):
    """Cached blend weights of one band of a view, on the device where they are applied.

    Attributes:
        transmittance: [h, width] float32, final transmittance.
    """

    transmittance: Tensor

    @property
    def nbytes(self) -> int:
        """Size on the device in bytes."""
        ...

    def render(self, colors: Tensor) -> Tensor:
        """Return the float32 image [h, width, 3] of colors [N, 3] over the background."""
        ...

    def color_gradient(self, image_gradient: Tensor) -> Tensor:
        """Return W^T dL/dimage, [N, 3] float32, given the image gradient [h, width, 3]."""
        ...


class CountedWeights(Protocol):
    """Blend weights of one band of a view, counted but not stored."""

    def nbytes(self, precision: Precision) -> int:
        """Return the size that the weights would have in bytes."""
        ...

    def keep(self, precision: Precision) -> CachedWeights:
        """Compute the weights again and store them."""
        ...
