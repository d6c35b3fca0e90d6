"""Reader of antimatter15's .splat format: 32 bytes per Gaussian, without spherical harmonics above degree 0.

Positions and standard deviations are float32. The components of color, opacity and rotation (wxyz) have 8 bits each.
"""

from __future__ import annotations

import numpy as np

from sgsst_core.files.formats.compressed_ply import Arrays
from sgsst_core.files.formats.quantized import OPACITY_LOGITS, SH_C0
from sgsst_core.files.scene_headers import SPLAT_BYTES, SceneHeader, splat_rows
from sgsst_core.scene.stored_harmonics import RowFile

_BLOCK_ROWS = 1 << 16


def read_splat(file: RowFile, header: SceneHeader, into: Arrays) -> None:
    """Read a .splat file into the arrays of a scene. A standard deviation of 0 becomes a log scale of minus infinity.

    Args:
        file: Open file.
        header: Header of the file.
        into: float32 arrays to fill, by the names of `Scene`'s tensors.

    Raises:
        SceneError: If the file has changed since its header was read.
    """
    for start in range(0, header.count, _BLOCK_ROWS):
        part = slice(start, min(start + _BLOCK_ROWS, header.count))
        data = np.empty((part.stop - start) * SPLAT_BYTES, np.uint8)
        file.read(start * SPLAT_BYTES, data)
        rows = splat_rows(data)
        into["means"][part] = rows["position"]
        with np.errstate(divide="ignore", invalid="ignore"):  # invalid values are reported later
            into["scales"][part] = np.log(rows["scale"].astype(np.float64))
        into["sh_dc"][part] = (rows["color"][:, :3] / 255 - 0.5) / SH_C0
        into["opacities"][part] = OPACITY_LOGITS[rows["color"][:, 3]]
        into["quats"][part] = (rows["rotation"].astype(np.float64) - 128) / 128
