"""Reader of antimatter15's .splat format: 32 bytes per Gaussian, without spherical harmonics above degree 0.

Positions and standard deviations are float32. The components of color, opacity and rotation (wxyz) have 8 bits each.
"""

from __future__ import annotations

import numpy as np

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.formats.quantized import OPACITY_LOGITS
from sgsst_core.files.formats.scene_format import Arrays, FileStart, OpenScene, SceneFormat, SceneHeader, row_blocks
from sgsst_core.files.formats.units import logarithms

ROW = np.dtype([("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)])


def _matches(start: FileStart) -> bool:
    """Return whether the data looks like .splat records. The format has no header.

    Nearly all records must have finite positions, plausible sizes, and rotations of length 1.
    """
    rows = np.frombuffer(start.head[: len(start.head) // ROW.itemsize * ROW.itemsize], ROW)
    if not len(rows):
        return False
    length = np.linalg.norm((rows["rotation"].astype(np.float64) - 128) / 128, axis=1)
    fits = np.isfinite(rows["position"]).all(axis=1) & (np.abs(length - 1) < 0.05)
    fits &= (np.abs(rows["scale"]) < 1e9).all(axis=1)  # logarithms are refused when they are read
    return bool(fits.mean() > 0.9)


def _read_header(start: FileStart) -> SceneHeader:
    count, rest = divmod(start.size, ROW.itemsize)
    if rest:
        raise SceneError(
            f"{start.path}: is a .splat file of {count} Gaussians of {ROW.itemsize} bytes and {rest} bytes more: it "
            "is truncated. Copy or export it again."
        )
    return SceneHeader(SPLAT, count, 0)


def _read(file: OpenScene, header: SceneHeader, into: Arrays) -> None:
    """Fill the arrays of a scene. A standard deviation of 0 becomes a log scale of minus infinity."""
    for block, rows in row_blocks(file, ROW, 0, header.count):
        into["means"][block] = rows["position"]
        into["scales"][block] = logarithms(file.path, rows["scale"].astype(np.float64))
        into["sh_dc"][block] = (rows["color"][:, :3] / 255 - COLOR_OFFSET) / SH_C0
        into["opacities"][block] = OPACITY_LOGITS[rows["color"][:, 3]]
        into["quats"][block] = (rows["rotation"].astype(np.float64) - 128) / 128


SPLAT = SceneFormat("splat", ".splat", 32, _matches, _read_header, _read)
