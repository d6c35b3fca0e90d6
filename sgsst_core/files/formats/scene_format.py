"""Entry of a scene format in the registry, and what its functions exchange."""

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
        """Fill a buffer with the bytes of the file from `offset` on."""


@dataclass(frozen=True)
class SceneHeader:
    """Checked header of a scene file. Formats add what their readers need in subclasses.

    Attributes:
        format: Format of the file.
        count: Number of Gaussians.
        coefficients: SH coefficients per color channel above degree 0.
        notes: Notes on what is not read, or read in another way than stored.
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
        name: File name suffix without its first dot. It names the format in options, reports and the REST API.
        title: Name of the format in texts.
        matches: Whether a file has this format, by its content.
        read_header: Header check: reads the header without allocating memory for the data, and compares it with the
            size of the file. Raises a SceneError if the header is wrong or the file is truncated. It runs in the API
            process.
        bytes_per_gaussian: Typical size of a Gaussian of SH degree 3 in a file.
        read: Reader, which fills the arrays of a scene, allocated for the header's numbers, and may return notes beyond
            the header's. It need not check for non-finite values. None for PLY, whose scenes are written back with all
            other data (`scene_file`).
        write: Writer of a scene's arrays and its render mode, if the format can state one. It raises an OutputError
            without path if it cannot represent the arrays. None if the format is only read.
        shown: Whether the page shows scenes of this format (`api/static/viewer`).
        magic: First bytes of all files of a format that the page does not show, so that it can say so.
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
