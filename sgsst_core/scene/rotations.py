"""Rotation matrices: those of quaternions, and checks of given ones."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from sgsst_core.errors import CameraError

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
    matrices: Tensor = torch.from_numpy(Rotation.from_quat(nonzero.roll(-1, 1).numpy()).as_matrix())
    return matrices


def unit_rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices [..., 3, 3] of normalized wxyz quaternions [..., 4], in their dtype."""
    w, x, y, z = quats.unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
