"""Rotation, scaling and translation of a scene's arrays, for formats whose axes are not those of a PLY.

A PLY has the axes of its cameras: x right, y down, z forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sgsst_core.constants import spherical_harmonics
from sgsst_core.files.formats.scene_format import Arrays, blocks

#: Rotation by 180 degrees about z, [4, 4], which converts between a PLY and axes with y up and z forward, as of glTF.
Y_UP = np.diag([-1.0, -1.0, 1.0, 1.0])
#: Number of directions from which the matrices of spherical harmonics are computed; 15 determine degree 3.
_DIRECTIONS = 64
#: Decimals of a matrix of spherical harmonics: float64 leaves more, and a rotation by 180 degrees gets exact signs.
_DECIMALS = 12
#: Largest factor, whose third power does not overflow.
_LARGEST = 1e30
#: Maximum deviation of a matrix from a rotation, relative to its scale.
_TOLERANCE = 1e-4


@dataclass(frozen=True)
class Frame:
    """Similarity transformation of a scene: x becomes scale * rotation x + translation.

    Attributes:
        rotation: Rotation, [3, 3] float64.
        scale: Positive factor.
        translation: Translation, [3] float64.
    """

    rotation: NDArray[np.float64]
    scale: float
    translation: NDArray[np.float64]

    @staticmethod
    def of(matrix: NDArray[np.float64]) -> Frame:
        """Split an affine transformation [4, 4].

        Raises:
            ValueError: If it mirrors or distorts.
        """
        linear = matrix[:3, :3]
        if not np.isfinite(matrix).all() or np.abs(linear).max() > _LARGEST:
            raise ValueError("the transformation is not finite")
        scale = float(np.cbrt(np.linalg.det(linear)))
        if scale <= 0 or np.abs(linear @ linear.T - scale**2 * np.eye(3)).max() > _TOLERANCE * scale**2:
            raise ValueError("the transformation mirrors or distorts the scene")
        return Frame(linear / scale, scale, matrix[:3, 3])

    def apply(self, arrays: Arrays) -> None:
        """Transform the arrays of a scene in place. Computes in float64; rotations by 180 degrees are exact."""
        from scipy.spatial.transform import Rotation  # not for the API process, which only reads headers

        x, y, z, w = Rotation.from_matrix(self.rotation).as_quat()
        turn = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])  # left multiplication, wxyz
        harmonics = harmonics_matrix(self.rotation, arrays["sh_rest"].shape[1])
        for part in blocks(len(arrays["means"])):
            block = {name: array[part] for name, array in arrays.items()}
            means = block["means"].astype(np.float64)
            block["means"][:] = self.scale * (means @ self.rotation.T) + self.translation
            if self.scale != 1:
                block["scales"] += np.float32(np.log(self.scale))
            block["quats"][:] = block["quats"].astype(np.float64) @ turn.T
            rest = block["sh_rest"].astype(np.float64)
            block["sh_rest"][:] = np.einsum("ij,njc->nic", harmonics, rest)


def harmonics_matrix(rotation: NDArray[np.float64], coefficients: int) -> NDArray[np.float64]:
    """Return the matrix of SH coefficients above degree 0, [coefficients, coefficients], of a rotation or reflection.

    A rotated function has the value at d that the original has at the inversely rotated d, for all directions d.
    """
    directions = np.random.default_rng(0).normal(size=(_DIRECTIONS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = (spherical_harmonics(*each.T)[:coefficients] for each in (directions, directions @ rotation))
    new, old = (np.reshape(each, (coefficients, _DIRECTIONS)).T for each in values)
    matrix: NDArray[np.float64] = np.round(np.linalg.lstsq(new, old, rcond=None)[0], _DECIMALS)
    return matrix
