"""Scene type: N Gaussians, with values encoded as in 3DGS files, and their rotation matrices."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy  # imports its modules at first use
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.constants import SH_DEGREES
from sgsst_core.errors import CameraError, SceneError
from sgsst_core.scene.rendering import CLASSIC, Rendering

#: Names of a scene's tensors, in the order of its constructor.
TENSORS = ("means", "quats", "scales", "opacities", "sh_dc", "sh_rest")

#: Number of Gaussians that are processed at a time.
_CHUNK = 1 << 16


@dataclass(frozen=True)
class Scene:
    """Trained 3DGS scene. All tensors are float32 on the CPU and contain only finite values.

    Attributes:
        means: [N, 3], world units.
        quats: [N, 4], wxyz, not necessarily normalized.
        scales: [N, 3], natural logarithm of the standard deviations in world units (as in files).
        opacities: [N], logits (as in files).
        sh_dc: [N, 3], degree-0 coefficients, which stylization optimizes.
        sh_rest: [N, K, 3] with K = 0, 3, 8 or 15 for SH degree 0 to 3.
        rendering: Render mode, which every rasterizer follows.

    Example:
        >>> scene = load_scene("scene.ply").scene
        >>> len(scene), scene.sh_degree, tuple(scene.sh_dc.shape)
        (616, 0, (616, 3))
    """

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    opacities: Tensor  # [N]
    sh_dc: Tensor  # [N, 3]
    sh_rest: Tensor  # [N, K, 3]
    rendering: Rendering = field(default=CLASSIC, kw_only=True)

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return SH_DEGREES[int(self.sh_rest.shape[1])]

    def subset(self, rows: Tensor) -> Scene:
        """Return a scene of the selected Gaussians only, given a mask [N] bool or indices."""
        return replace(self, **{name: getattr(self, name)[rows] for name in TENSORS})

    def used_degree(self, rows: Tensor | None = None) -> int:
        """Return the highest SH degree with a non-zero coefficient, among the Gaussians of a mask [N] bool, or all."""
        used, chosen = 0, torch.arange(len(self)) if rows is None else rows.nonzero()[:, 0]
        for part in chosen.split(_CHUNK):
            if used == self.sh_rest.shape[1]:
                break
            nonzero = (self.sh_rest[part, used:] != 0).any(dim=2).any(dim=0).nonzero()
            used += int(nonzero[-1]) + 1 if len(nonzero) else 0
        return next(degree for degree in range(4) if (degree + 1) ** 2 - 1 >= used)

    def attenuated(self, attenuation: float) -> Scene:
        """Return the scene with all SH bands above degree 0 multiplied by 1 - `attenuation`, or removed if that is 0.

        The factor is rounded to float32 (`attenuation_factor`), and products are computed in float32, exactly as when a
        file is attenuated.
        """
        if not attenuation or not self.sh_degree:
            return self
        if attenuation == 1:
            return replace(self, sh_rest=self.means.new_zeros((len(self), 0, 3)))
        return replace(self, sh_rest=self.sh_rest * attenuation_factor(attenuation))

    def without_zero_bands(self) -> Scene:
        """Return the scene without the highest SH bands that are zero for all Gaussians; renders do not change."""
        coefficients = (self.used_degree() + 1) ** 2 - 1
        if coefficients == self.sh_rest.shape[1]:
            return self
        return replace(self, sh_rest=self.sh_rest[:, :coefficients].contiguous())


def checked_scene(scene: Scene, names: Mapping[str, str] | None = None) -> Scene:
    """Check a scene that a caller of the library passes, and convert its values to float32 tensors on the CPU.

    NumPy arrays are accepted, and also opacities [N, 1] and sh_dc [N, 1, 3], as trainers keep them.

    Args:
        names: Names of its fields in messages; None for their own.

    Raises:
        SceneError: If a shape, type or value is wrong.
    """
    count = len(scene.means) if np.ndim(scene.means) else 0
    shapes = {
        "means": ((count, 3),),
        "quats": ((count, 4),),
        "scales": ((count, 3),),
        "opacities": ((count,), (count, 1)),
        "sh_dc": ((count, 3), (count, 1, 3)),
        "sh_rest": tuple((count, coefficients, 3) for coefficients in SH_DEGREES),
    }
    values = {name: _checked((names or {}).get(name, name), getattr(scene, name), shapes[name]) for name in shapes}
    if not count:
        raise SceneError("The scene has no Gaussians. Give at least one.")
    return scene if all(values[name] is getattr(scene, name) for name in shapes) else replace(scene, **values)


def _checked(name: str, given: Any, shapes: tuple[tuple[int, ...], ...]) -> Any:
    """Return a field of a scene as a tensor of the first of some shapes; SH coefficients may have any of them."""
    if not isinstance(given, Tensor | np.ndarray):
        raise SceneError(f"The scene: `{name}` is a {type(given).__name__}. Give a tensor or NumPy array.")
    if not (given.is_floating_point() if isinstance(given, Tensor) else given.dtype.kind == "f"):
        raise SceneError(f"The scene: `{name}` has dtype {given.dtype}. Give floating point numbers.")
    shape = tuple(given.shape)
    if shape not in shapes:
        wanted = " or ".join(str(list(each)) for each in shapes)
        raise SceneError(f"The scene: `{name}` has shape {list(shape)}. Give {wanted}, with the same N everywhere.")
    tensor = given if isinstance(given, Tensor) else torch.from_numpy(np.array(given, np.float32))
    tensor = (tensor.detach() if tensor.requires_grad else tensor).to("cpu", torch.float32)
    if len(shape) != len(shapes[0]):
        tensor = tensor.reshape(shapes[0])
    bad = int((~torch.isfinite(tensor)).sum())
    if bad:
        raise SceneError(f"The scene: `{name}` holds {bad} NaN or infinite values. Remove these Gaussians.")
    return tensor


def attenuation_factor(attenuation: float) -> float:
    """Return the factor that an SH attenuation applies to SH coefficients, rounded to float32."""
    return float(torch.tensor(1.0 - attenuation, dtype=torch.float32))


def sampled(scene: Scene, count: int) -> Scene:
    """Return a random sample of at most `count` Gaussians, enlarged to cover about the same area as all of them.

    The area of a Gaussian grows with the square of its size, so sizes are multiplied by the square root of the number
    of Gaussians that each one represents.
    """
    if len(scene) <= count:
        return scene
    sample = scene.subset(sampled_rows(len(scene), count))
    return replace(sample, scales=sample.scales + math.log(-(-len(scene) // count)) / 2)


def sampled_rows(total: int, count: int) -> Tensor:
    """Return at most `count` of `total` row indices: a random one (fixed seed) from each block of consecutive rows.

    Taking every n-th row instead could coincide with a periodic pattern in the file.
    """
    step = -(-total // count)
    first = torch.arange(0, total, step)
    chance = torch.randint(step, first.shape, generator=torch.Generator().manual_seed(0))
    return (first + chance).clamp_max(total - 1)


#: Largest entry of R R^T - I that is attributed to rounding. Such a matrix R is replaced by the nearest rotation.
ROTATION_TOLERANCE = 1e-3


def exact_rotation(where: str, matrix: NDArray[Any]) -> NDArray[Any]:
    """Return `matrix` [4, 4] with its upper left 3x3 replaced by the nearest rotation (polar decomposition).

    Args:
        matrix: Rigid transform, whose 3x3 matrix must be a rotation within `ROTATION_TOLERANCE`.

    Raises:
        CameraError: If the 3x3 matrix is no rotation.
    """
    rotation = matrix[:3, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not error <= ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        what = "mirrors" if error <= ROTATION_TOLERANCE else f"is {error:.2g} off a rotation (allowed: 1e-3)"
        raise CameraError(f"{where}: its 3x3 matrix {what}. Export the cameras again, without scale or shear.")
    left, _, right = np.linalg.svd(rotation)
    exact = matrix.copy()
    exact[:3, :3] = left @ right
    return exact


def rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices [P, 3, 3] of wxyz quaternions [P, 4]; the identity for a zero quaternion."""
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    nonzero = torch.where((quats != 0).any(1, keepdim=True), quats, identity)
    return torch.from_numpy(scipy.spatial.transform.Rotation.from_quat(nonzero.roll(-1, 1).numpy()).as_matrix())


def unit_rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices [..., 3, 3] of normalized wxyz quaternions [..., 4], in their dtype."""
    w, x, y, z = quats.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
