"""Rotation matrices of quaternions."""

from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor


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
