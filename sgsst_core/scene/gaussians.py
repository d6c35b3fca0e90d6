"""The scene: N Gaussians in the units that 3DGS files store them in."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Scene:
    """A trained 3DGS scene. All tensors are float32 on the CPU and hold finite values only.

    Attributes:
        means: [N, 3], world units.
        quats: [N, 4], wxyz, not necessarily normalised.
        scales: [N, 3], natural logarithm of the standard deviations in world units (as in files).
        opacities: [N], logits (as in files).
        sh_dc: [N, 3], the degree-0 coefficients: what stylization optimises.
        sh_rest: [N, K, 3] with K = 0, 3, 8 or 15 for SH degree 0 to 3.
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    sh_dc: Tensor  # [N, 3]
    sh_rest: Tensor  # [N, K, 3]

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[int(self.sh_rest.shape[1])]

    def subset(self, rows: Tensor) -> Scene:
        """The Gaussians of some rows ([N] bool, or indices)."""
        return Scene(*(getattr(self, field.name)[rows] for field in fields(self)))

    def without_zero_bands(self) -> Scene:
        """The same scene without the SH bands that are zero in all Gaussians; it looks the same from everywhere."""
        used = self.sh_rest.abs().amax(dim=2).amax(dim=0) > 0 if len(self) else torch.zeros(self.sh_rest.shape[1])
        highest = int(used.nonzero()[-1]) + 1 if used.any() else 0
        coefficients = next(count for count in (0, 3, 8, 15) if count >= highest)
        return replace(self, sh_rest=self.sh_rest[:, :coefficients].contiguous())
