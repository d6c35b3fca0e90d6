"""Line or plane in RGB that the colors of a style lie on.

The loss cannot tell some hues apart: it compares features that respond to several hues alike, and each channel's mean
and standard deviation. Patches of yellow and cyan match a black and white woodcut. Projecting colors to the line or
plane after each step, as in projected gradient descent, excludes such patches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.scene.color_moments import color_moments
from sgsst_core.settings import Settings
from sgsst_core.style import Style, some_pixels

#: Standard deviation along a principal axis of a style's colors, in 0..1, up to which the axis is left out: three of
#: 255 levels, which are hardly visible.
NEGLIGIBLE = 3 / 255


@dataclass(frozen=True)
class ColorSubspace:
    """Line or plane of colors, as an affine map of DC coefficients to it: c -> c @ matrix + offset.

    Attributes:
        matrix: [3, 3], orthogonal projection.
        offset: [3].
        dimensions: 1 for a line, 2 for a plane.
        deviation: Largest standard deviation of the style's colors perpendicular to it, in 0..1.
    """

    matrix: Tensor
    offset: Tensor
    dimensions: int
    deviation: float

    @staticmethod
    def of(style: Style) -> ColorSubspace | None:
        """Return the color subspace of a style; None if its colors vary in all directions, or in none."""
        mean, covariance = color_moments(some_pixels(style))
        variances, axes = torch.linalg.eigh(covariance.cpu())
        deviations = variances.clamp_min(0).sqrt()
        varies = deviations > NEGLIGIBLE
        if varies.all() or not varies.any():
            return None
        matrix = axes[:, varies] @ axes[:, varies].T
        center = (mean.cpu() - COLOR_OFFSET) / SH_C0
        offset = center - center @ matrix
        return ColorSubspace(matrix.float(), offset.float(), int(varies.sum()), float(deviations[~varies].max()))

    def to(self, device: torch.device) -> ColorSubspace:
        """Return the subspace with its tensors on a device."""
        return replace(self, matrix=self.matrix.to(device), offset=self.offset.to(device))

    def projected(self, sh_dc: Tensor) -> Tensor:
        """Project DC coefficients [n, 3]."""
        return self.along(sh_dc) + self.offset

    def along(self, vectors: Tensor) -> Tensor:
        """Project vectors [n, 3], such as gradients, to the directions of the line or plane.

        Products are added one by one, because matrix products differ between processors in the last bit, and ranks
        must have the same colors.
        """
        red, green, blue = vectors.split(1, dim=1)
        projected: Tensor = red * self.matrix[0] + green * self.matrix[1] + blue * self.matrix[2]
        return projected


def color_subspace_of(styles: Sequence[Style], settings: Settings) -> ColorSubspace | None:
    """Return the color subspace of a job; None if colors are free, or if there are several styles."""
    if len(styles) != 1 or not settings.bounded or settings.preserve_colors != "no":
        return None
    return ColorSubspace.of(styles[0])
