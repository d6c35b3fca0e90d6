"""What `cached` asks of a layout of kept blend weights: `strips` on the CPU, `triton_kept` on GPUs."""

from __future__ import annotations

from typing import Literal, Protocol

from torch import Tensor

#: `half` is float16 times a power of two: each weight has a relative error of at most 2^-11.
Precision = Literal["float32", "half"]


class CachedWeights(Protocol):
    """Blend weights of one band of a view, on the device where they are applied.

    Attributes:
        transmittance: [h, width] float32, final.
    """

    transmittance: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes that they take on the device."""
        ...

    def render(self, colors: Tensor) -> Tensor:
        """Image [h, width, 3] float32 of colors [N, 3], over the background."""
        ...

    def color_gradient(self, image_gradient: Tensor) -> Tensor:
        """W^T dL/dimage, [N, 3] float32, of image_gradient [h, width, 3]."""
        ...


class CountedWeights(Protocol):
    """Blend weights of one band of a view that are counted, not kept."""

    def nbytes(self, precision: Precision) -> int:
        """Bytes that they would take."""
        ...

    def keep(self, precision: Precision) -> CachedWeights:
        """Compute them once more, and keep them."""
        ...
