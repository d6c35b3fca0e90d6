"""SH attenuation of written scenes: `f_rest_*` are multiplied by one factor in float32.

The written coefficients equal those that the job optimized with, because `Scene.attenuated` multiplies the same float32
values by the same factor.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.ply_header import PlyHeader
from sgsst_core.scene.gaussians import attenuation_factor


@dataclass(frozen=True)
class ShAttenuation:
    """SH attenuation of the rows of a file.

    Attributes:
        names: Names of the SH properties in the file's order.
        factor: Factor of all coefficients, rounded to float32. If it is 0, all coefficients become positive zeros.
    """

    names: tuple[str, ...]
    factor: float

    @staticmethod
    def of(header: PlyHeader, attenuation: float) -> ShAttenuation | None:
        """Return the attenuation for a file's vertices; None if no coefficient changes."""
        names = tuple(prop.name for prop in header.vertex.properties if re.fullmatch(r"f_rest_\d+", prop.name))
        factor = attenuation_factor(attenuation)
        return ShAttenuation(names, factor) if names and factor != 1 else None

    def apply(self, rows: NDArray[Any]) -> None:
        """Attenuate a structured block of rows in place."""
        if not len(rows):
            return
        dtype = rows.dtype
        assert dtype.fields is not None
        first = dtype.fields[self.names[0]][1]
        packed = all(
            dtype[name] == np.dtype("<f4") and dtype.fields[name][1] == first + 4 * place
            for place, name in enumerate(self.names)
        )
        if packed and first % 4 == 0 and dtype.itemsize % 4 == 0:  # layout of 3DGS trainers: one pass over the rows
            table = rows.view(np.uint8).view("<f4").reshape(len(rows), -1)
            part = table[:, first // 4 : first // 4 + len(self.names)]
            part[:] = self.attenuated(part)
            return
        for name in self.names:
            rows[name] = self.attenuated(rows[name].astype(np.float32))

    def attenuated(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the attenuated values in float32."""
        return values * np.float32(self.factor) if self.factor else np.zeros_like(values)


def check_sh_attenuation(path: Path, header: PlyHeader | None, attenuation: float) -> None:
    """Check that a file can store attenuated coefficients.

    Args:
        path: Path of the file, for messages.
        header: Header of the file; None if it is not a PLY. Scenes from other formats are written as a float32 PLY,
            which can store them.
        attenuation: SH attenuation, 0 to 1.

    Raises:
        SceneError: If the coefficients are stored as integers.
    """
    if header is None or "vertex" not in header.names or not attenuation:
        return
    kinds = {prop.name: prop.kind for prop in header.vertex.properties}
    whole = [name for name, kind in kinds.items() if re.fullmatch(r"f_rest_\d+", name) and kind[0] != "f"]
    if whole:
        raise SceneError(
            f"{path}: {whole[0]} is stored as integers, which cannot be attenuated. Convert it to float first, or "
            "leave --sh-attenuation out."
        )
