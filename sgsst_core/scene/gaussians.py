"""Scene type: N Gaussians, in the units of 3DGS files."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from sgsst_core.scene.stored_harmonics import StoredHarmonics

#: Number of Gaussians that are processed at a time.
_CHUNK = 1 << 16


@dataclass(frozen=True)
class Scene:
    """Trained 3DGS scene. All tensors are float32 on the CPU and contain only finite values.

    For large scenes, `sh_rest` stays in the scene's file: see `StoredHarmonics`.

    Attributes:
        means: [N, 3], world units.
        quats: [N, 4], wxyz, not necessarily normalized.
        scales: [N, 3], natural logarithm of the standard deviations in world units (as in files).
        opacities: [N], logits (as in files).
        sh_dc: [N, 3], degree-0 coefficients, which stylization optimizes.
        sh_rest: [N, K, 3] with K = 0, 3, 8 or 15 for SH degree 0 to 3.
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    sh_dc: Tensor  # [N, 3]
    sh_rest: Tensor | StoredHarmonics  # [N, K, 3]

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[int(self.sh_rest.shape[1])]

    def subset(self, rows: Tensor) -> Scene:
        """Return the Gaussians of some rows ([N] bool, or indices)."""
        return Scene(*(getattr(self, field.name)[rows] for field in fields(self)))

    def used_degree(self, rows: Tensor | None = None) -> int:
        """Return the highest degree with a non-zero coefficient, among some Gaussians ([N] bool) or all."""
        if self.sh_degree == 0:
            return 0
        if isinstance(self.sh_rest, StoredHarmonics):
            chosen = self.sh_rest if rows is None else self.sh_rest[rows]
            used = chosen.used_coefficients() if isinstance(chosen, StoredHarmonics) else _used_coefficients(chosen)
        else:
            used = _used_coefficients(self.sh_rest, rows)
        return next(degree for degree in range(4) if (degree + 1) ** 2 - 1 >= used)

    def attenuated(self, attenuation: float) -> Scene:
        """Return the scene with all SH bands above degree 0 multiplied by 1 - fade; for a fade of 1, without them.

        Coefficients are multiplied in float32 by the factor rounded to float32, as in files (`attenuation_factor`).
        """
        if not attenuation or not self.sh_degree:
            return self
        if attenuation == 1:
            return replace(self, sh_rest=self.means.new_zeros((len(self), 0, 3)))
        factor = attenuation_factor(attenuation)
        if isinstance(self.sh_rest, StoredHarmonics):
            return replace(self, sh_rest=self.sh_rest.times(factor))
        return replace(self, sh_rest=self.sh_rest * factor)

    def without_zero_bands(self) -> Scene:
        """Return the scene without the SH bands that are zero in all Gaussians; it looks the same from everywhere."""
        coefficients = (self.used_degree() + 1) ** 2 - 1
        if coefficients == self.sh_rest.shape[1]:
            return self
        if isinstance(self.sh_rest, StoredHarmonics):
            return replace(self, sh_rest=self.sh_rest.first(coefficients))
        return replace(self, sh_rest=self.sh_rest[:, :coefficients].contiguous())


def attenuation_factor(attenuation: float) -> float:
    """Return the factor that an SH attenuation applies to SH coefficients, rounded to float32."""
    return float(torch.tensor(1.0 - attenuation, dtype=torch.float32))


def sampled(scene: Scene, count: int) -> Scene:
    """Return a random sample of at most `count` Gaussians, enlarged to cover about the same area together.

    The area of a Gaussian grows with the square of its size, so sizes are multiplied by the square root of the number
    of Gaussians that each one represents.
    """
    part = scene.subset(sampled_rows(len(scene), count))
    return replace(part, scales=part.scales + math.log(-(-len(scene) // count)) / 2)


def sampled_rows(total: int, count: int) -> Tensor:
    """Return a random row from each run of equal length, at most `count` of `total` rows, with a fixed seed.

    Regular sampling could coincide with a period in the order of the file.
    """
    step = -(-total // count)
    first = torch.arange(0, total, step)
    chance = torch.randint(step, first.shape, generator=torch.Generator().manual_seed(0))
    return (first + chance).clamp_max(total - 1)


def _used_coefficients(sh_rest: Tensor, rows: Tensor | None = None) -> int:
    """Return how many leading coefficients cover all non-zero ones, for all Gaussians or those of a mask [N].

    Processes the Gaussians in chunks, without a copy.
    """
    used = 0
    for start in range(0, len(sh_rest), _CHUNK):
        values = sh_rest[start : start + _CHUNK, used:]
        if rows is not None:
            values = values[rows[start : start + _CHUNK]]
        found = (values != 0).any(dim=2).any(dim=0).nonzero()
        used += int(found[-1]) + 1 if len(found) else 0
        if used == sh_rest.shape[1]:
            break
    return used
