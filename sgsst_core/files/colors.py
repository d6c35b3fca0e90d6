"""Writer of stylized colors alone, for clients that already have the scene: 6 bytes per Gaussian."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from sgsst_core.files.atomic import atomic_path

#: Largest finite float16 value.
_FLOAT16_MAX = 65504.0
#: Gaussians per converted block.
_BLOCK_ROWS = 1 << 20


def write_colors(path: Path, sh_dc: Tensor) -> None:
    """Write f_dc_0..2 of each Gaussian in order, as an N x 3 array of little-endian float16 without a header.

    Values are rounded to the nearest float16. The relative error is at most 2^-11, or the absolute error at most 2^-25
    for values below 2^-14. For displayable colors, the error is less than 0.04 of an 8-bit level. Values beyond +-65504
    are clamped. The file is written atomically.

    Args:
        path: File to write.
        sh_dc: Finite coefficients, [N, 3].

    Raises:
        OutputError: If the file cannot be written.
    """
    values = sh_dc.detach().cpu().numpy()
    with atomic_path(path) as temporary, temporary.open("wb") as output:
        for start in range(0, len(values), _BLOCK_ROWS):
            output.write(np.clip(values[start : start + _BLOCK_ROWS], -_FLOAT16_MAX, _FLOAT16_MAX).astype("<f2").data)
