"""Detection of scene formats that cannot be read, to name a converter."""

from __future__ import annotations

import math
import struct

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.scene_format import FileStart

CONVERTER = "https://github.com/playcanvas/splat-transform"
_KSPLAT_HEADER_BYTES = 4096


def advice(name: str) -> str:
    """Return the sentence that says how to convert a file with an example name."""
    return f"Convert it first: `splat-transform {name} scene.ply` ({CONVERTER})."


def refuse_unsupported(start: FileStart) -> None:
    """Raise a SceneError that names a converter if the file has a known but unsupported format."""
    path, head = start.path, start.head
    if _looks_like_ksplat(head, start.size):
        raise SceneError(f"{path}: is a .ksplat scene, which cannot be read. {advice('scene.ksplat')}")


def _looks_like_ksplat(head: bytes, size: int) -> bool:
    """Return whether the data looks like a .ksplat header.

    Its version is 0.x, its compression level is 0 to 2, and its numbers of sections and Gaussians fit the file size.
    """
    if size < _KSPLAT_HEADER_BYTES or head[0] != 0 or head[1] < 1:
        return False
    sections, filled, _, count, level = struct.unpack_from("<IIIIH", head, 4)
    center = struct.unpack_from("<3f", head, 24)
    fits = 0 < sections <= (size - _KSPLAT_HEADER_BYTES) // 1024 and filled <= sections and 0 < count <= size
    return fits and level <= 2 and all(map(math.isfinite, center))
