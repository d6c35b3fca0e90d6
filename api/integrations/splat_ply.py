"""Writing of splats as PLY files, and reading of their colors, for programs whose Python has NumPy."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

#: Properties of a splat's colors, and all that it must have besides its position.
COLORS = ("f_dc_0", "f_dc_1", "f_dc_2")
REQUIRED = (*COLORS, "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")


def write_splat(path: Path, columns: Mapping[str, Any]) -> None:
    """Write a splat.

    Args:
        columns: Arrays of N numbers by property: `x`, `y`, `z`, `REQUIRED`, and `f_rest_*` if there are any.
    """
    rest = sorted((name for name in columns if name.startswith("f_rest_")), key=lambda name: int(name[7:]))
    names = ("x", "y", "z", *COLORS, *rest, *REQUIRED[3:])
    rows = np.stack([np.asarray(columns[name], "<f4") for name in names], axis=1)
    properties = "".join(f"property float {name}\n" for name in names)
    header = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(rows)}\n{properties}end_header\n"
    path.write_bytes(header.encode() + rows.tobytes())


def read_colors(path: Path) -> Any:
    """Return `COLORS` of a PLY whose properties are all float, [N, 3] float32."""
    header, _, content = path.read_bytes().partition(b"end_header\n")
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property float ")]
    rows = np.frombuffer(content, "<f4").reshape(-1, len(names))
    return np.ascontiguousarray(rows[:, [names.index(name) for name in COLORS]])
