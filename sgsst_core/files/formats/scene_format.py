"""Registry entry of a scene format, and the types of its functions' arguments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO, Protocol

import numpy as np
from numpy.typing import NDArray

from sgsst_core.files.formats.render_tag import UNTAGGED, RenderTag
from sgsst_core.scene.rendering import Rendering

#: SH coefficients per color channel above degree 0, by SH degree.
COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15}

#: float32 arrays of N Gaussians by the names of `Scene`'s tensors: means, scales and sh_dc [N, 3], quats [N, 4] (wxyz),
#: opacities [N] (logits), sh_rest [N, coefficients, 3].
Arrays = dict[str, NDArray[np.float32]]


@dataclass(frozen=True)
class FileStart:
    """Beginning of a file.

    Attributes:
        path: Path of the file.
        head: First bytes, at most `HEAD_BYTES`.
        size: Size of the file in bytes.
    """

    path: Path
    head: bytes
    size: int


class OpenScene(Protocol):
    """Open scene file, which raises a SceneError if it changes or cannot be read."""

    path: Path

    def read(self, offset: int, buffer: NDArray[np.uint8]) -> None:
        """Read bytes of the file, starting at `offset`, until a buffer is full."""


@dataclass(frozen=True)
class SceneHeader:
    """Checked header of a scene file. Formats subclass it to add fields for their readers.

    Attributes:
        format: Format of the file.
        count: Number of Gaussians.
        coefficients: SH coefficients per color channel above degree 0.
        notes: Notes on contents that are not read, or not read as stored.
        tag: Render mode that the file states.
    """

    format: SceneFormat
    count: int
    coefficients: int
    notes: tuple[str, ...] = field(default=(), kw_only=True)
    tag: RenderTag = field(default=UNTAGGED, kw_only=True)


@dataclass(frozen=True)
class SceneFormat:
    """Scene format.

    Everything that depends on the format of a scene derives from its entry: detection, reading, writing, file names,
    options, messages and the page.

    Attributes:
        name: File name suffix without its first dot. It is also the name in options, reports and the REST API.
        title: Name of the format in messages.
        matches: Check whether the content of a file has this format.
        read_header: Header check: reads the header without allocating memory for the data, and compares it with the
            size of the file. Raises a SceneError if the header is wrong or the file is truncated. It runs in the API
            process.
        bytes_per_gaussian: Typical size of a Gaussian of SH degree 3 in a file.
        read: Reader. It fills arrays that were allocated by the header, and may return further notes. It need not check
            for non-finite values. None for PLY, which `scene_file` reads, because its other data is written back.
        write: Writer of a scene's arrays and its render mode, if the format can state one. It raises an OutputError
            without path if it cannot represent the arrays. None if the format is only read.
        shown: Whether the page shows scenes of this format (`api/static/viewer`).
        magic: First bytes of all files of a format that the page detects but cannot show.
        media_type: Media type of downloads.
    """

    name: str
    title: str
    matches: Callable[[FileStart], bool]
    read_header: Callable[[FileStart], SceneHeader]
    bytes_per_gaussian: int
    read: Callable[[OpenScene, SceneHeader, Arrays], tuple[str, ...] | None] | None = None
    write: Callable[[BinaryIO, Arrays, Rendering], None] | None = None
    shown: bool = False
    magic: bytes = b""
    media_type: str = "application/octet-stream"

    @property
    def suffix(self) -> str:
        """Return the file name suffix, with its dot."""
        return f".{self.name}"
