"""Rasterizers: one small protocol, four implementations.

Geometry is frozen, so a view's image is linear in its colours: image = W c + T_final * background,
and the gradient with respect to the colours is W^T dL/dimage.
"""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from sgsst_core.camera import Camera

Rows = tuple[int, int]


class Rasterizer(Protocol):
    """Renders one scene's frozen geometry with any colours.

    `rows` is a half-open band (start, stop) of pixel rows; None is the whole view. `colours` are the
    colours of one view, after spherical harmonics and clamp.
    """

    name: str

    def render(self, colours: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Image [h, width, 3] of colours [N, 3] in the camera's rows, over the background."""
        ...

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """1 - T_final, [h, width] in [0, 1]: how much of each pixel the Gaussians cover."""
        ...

    def colour_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """W^T dL/dimage, [N, 3], of image_gradient [h, width, 3] in the camera's rows."""
        ...
