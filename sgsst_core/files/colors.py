"""Colors alone, for who has the rest of a scene already: 6 bytes a Gaussian."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from torch import Tensor

from sgsst_core.files.atomic import atomic_path

#: The largest number that float16 holds.
_MOST = 65504.0
#: Gaussians that are converted at a time.
_BLOCK_ROWS = 1 << 20


def write_colors(path: Path, sh_dc: Tensor) -> None:
    """Write f_dc_0..2 of each Gaussian, in their order, as little-endian float16: N x 3, nothing else.

    A value is rounded to the nearest, by 2^-11 of itself at most, or by 2^-25 where it is smaller than 2^-14; in the
    color that is less than 0.04 of a gray level of 255 for every color between black and white. What is beyond
    +-65504 becomes +-65504. The file appears whole or not at all.

    Args:
        path: file to write.
        sh_dc: [N, 3], finite.

    Raises:
        OutputError: it cannot be written.
    """
    values = sh_dc.detach().cpu().numpy()
    with atomic_path(path) as temporary, temporary.open("wb") as output:
        for start in range(0, len(values), _BLOCK_ROWS):
            output.write(np.clip(values[start : start + _BLOCK_ROWS], -_MOST, _MOST).astype("<f2").data)
