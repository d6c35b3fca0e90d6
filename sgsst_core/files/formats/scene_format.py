"""Registry entry of a scene format, the types of its functions' arguments, and what several formats need.

A file may state its render mode, and may hold content beyond what its header declares, which is counted and reported.
"""

from __future__ import annotations

import codecs
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sgsst_core.constants import EPS2D, SH_DEGREES
from sgsst_core.errors import SceneError, reading_scene
from sgsst_core.scene.rendering import CLASSIC, MAX_EPS2D, Rendering

#: SH coefficients per color channel above degree 0, by SH degree.
COEFFICIENTS = {degree: number for number, degree in SH_DEGREES.items()}
#: The same for files, whose coefficients of degree 4 are not drawn.
STORED_COEFFICIENTS = {**COEFFICIENTS, 4: 24}
#: Gaussians that are converted at a time.
BLOCK_ROWS = 1 << 16

#: float32 arrays of N Gaussians by the names of `Scene`'s tensors: means, scales and sh_dc [N, 3], quats [N, 4] (wxyz),
#: opacities [N] (logits), sh_rest [N, coefficients, 3].
Arrays = dict[str, NDArray[np.float32]]
#: Padding that programs leave after the data: zeros, blanks, and the end-of-file mark of DOS.
_BLANKS, _PADDING = b" \t\r\n\x1a", b"\0 \t\r\n\x1a"
#: Maximum bytes of padding, and of data that are searched for traces of a transfer as text.
_MAX_PADDING, _SAMPLE_BYTES = 1 << 16, 1 << 20
#: Least number of line ends that show a transfer as text if all of them are CR LF.
_MIN_LINE_ENDS = 8


@dataclass(frozen=True)
class RenderTag:
    """Render mode that a scene file states.

    Attributes:
        rendering: Stated render mode, else classic.
        reason: Part of the file that states it, such as "the file's flag"; empty if none does.
        warnings: Pairs of texts: how the scene is drawn, and why renders may differ from those of its trainer.
    """

    rendering: Rendering = CLASSIC
    reason: str = ""
    warnings: tuple[tuple[str, str], ...] = ()


#: Tag of files that state nothing.
UNTAGGED = RenderTag()


@dataclass(frozen=True)
class FileStart:
    """Beginning of a file.

    Attributes:
        head: First bytes, at most `HEAD_BYTES`.
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
        coefficients: SH coefficients per color channel above degree 0.
        notes: Notes on contents that are not read, or not read as stored.
        axes: Axes that the scene has in an SPZ, see `spz`.
        up: Direction of up; None if the file does not state it.
    """

    format: SceneFormat
    count: int
    coefficients: int
    notes: tuple[str, ...] = field(default=(), kw_only=True)
    axes: str = field(default="rub", kw_only=True)
    up: tuple[float, float, float] | None = field(default=None, kw_only=True)
    tag: RenderTag = field(default=UNTAGGED, kw_only=True)


class Limits(NamedTuple):
    """Range and precision of a format's values.

    Attributes:
        ranges: Lowest and highest value by the name of the array. That of "scales" holds for the largest of each
            Gaussian.
        step: Distance between positions that can be stored, for positions [n, 3]: [n], or the same for all. None if
            positions are floats.
    """

    ranges: Mapping[str, tuple[float, float]] = {}
    step: Callable[[NDArray[np.float32]], NDArray[np.float64]] | None = None


_UNLIMITED = Limits()


@dataclass(frozen=True)
class SceneFormat:
    """Scene format.

    Everything that depends on the format of a scene derives from its entry: detection, reading, writing, file names,
    options, messages and the page.

    Attributes:
        name: File name suffix without its first dot. It is also the name in options, reports and the REST API.
        title: Name of the format in messages.
        bytes_per_gaussian: Typical size of a Gaussian of SH degree 3 in a file.
        matches: Check whether the content of a file has this format.
        read_header: Header check: reads the header without allocating memory for the data, and compares it with the
            size of the file. Raises a SceneError if the header is wrong or the file is truncated. It runs in the API
            process.
        read: Reader. It fills arrays that were allocated by the header, and may return a header with more notes. It
            need not check for non-finite values. None for PLY, which `scene_file` reads, because its other data is
            written back.
        write: Writer of a scene's arrays and its render mode, if the format can state one. It raises an OutputError
            without path if it cannot represent the arrays. None if the format is only read.
        limits: Range and precision of its values.
        has_axes: Whether the writer takes axes as a fourth argument.
    """

    name: str
    title: str
    bytes_per_gaussian: int
    matches: Callable[[FileStart], bool]
    read_header: Callable[[FileStart], SceneHeader]
    read: Callable[[OpenScene, SceneHeader, Arrays], SceneHeader | None] | None = None
    write: Callable[..., None] | None = None
    media_type: str = "application/octet-stream"
    limits: Limits = _UNLIMITED
    has_axes: bool = False

    @property
    def suffix(self) -> str:
        """Return the file name suffix, with its dot."""
        return f".{self.name}"


def stated(mode: str, reason: str, eps2d: float | None = None, warnings: tuple[tuple[str, str], ...] = ()) -> RenderTag:
    """Return the tag of a file that states a render mode, with a warning if the scene can only be approximated.

    Args:
        mode: Stated mode, one of `Rendering.mode`. Any other is read as classic, with a warning.
        reason: Part of the file that states it.
        eps2d: Stated blur; None for the default.
    """
    if mode not in ("classic", "antialiased", "2dgs"):
        warnings = (*warnings, ("classic", f"{reason} is unknown"))
        mode = "classic"
    if mode == "2dgs":
        flat = "projected Gaussians of 2D Gaussian Splatting are approximated; its trainer intersects them with rays"
        warnings = (*warnings, ("as Gaussians without thickness", f"{reason}; {flat}"))
    return RenderTag(Rendering(mode, eps2d or EPS2D), reason, warnings)  # type: ignore[arg-type]


def extras_tag(extras: object, where: str) -> RenderTag:
    """Return the render mode that a JSON document states in the fields that `extras_of` writes.

    Args:
        extras: Value that should be a JSON object.
    """
    members = extras if isinstance(extras, dict) else {}
    model, eps2d = members.get("model", "default"), members.get("eps2d")
    eps2d = usable_eps2d(eps2d) if type(eps2d) in (int, float) else None
    if model == "default" and eps2d is None:
        return UNTAGGED
    return stated("classic" if model == "default" else str(model), f"the model {str(model)[:40]!r} in {where}", eps2d)


def extras_of(rendering: Rendering) -> dict[str, Any]:
    """Return the fields of a JSON document that state a render mode; empty for the default mode."""
    model = {} if rendering.mode == CLASSIC.mode else {"model": rendering.mode}
    return model if rendering.eps2d == EPS2D else {**model, "eps2d": rendering.eps2d}


def usable_eps2d(value: Any) -> float | None:
    """Return a stated blur as a float; None if it is not a number or out of range."""
    try:
        number = float(value)
    except (ValueError, OverflowError):
        return None
    return number if math.isfinite(number) and 0 < number <= MAX_EPS2D else None


def json_numbers(values: Any, count: int) -> NDArray[np.float64]:
    """Return `count` numbers of a parsed JSON list, or a single number, as float64. null becomes NaN.

    Raises:
        ValueError: If there are more or fewer, or any is a text, a truth value or a list.
        OverflowError: If an integer is too large.
    """
    numbers = values if isinstance(values, list) else [values]
    if len(numbers) != count or not all(type(value) in (int, float, type(None)) for value in numbers):
        raise ValueError(f"{len(numbers)} values in place of {count} numbers, or values that are not numbers")
    return np.array(numbers, np.float64)


def blocks(count: int) -> Iterator[slice]:
    """Yield the slices of `count` Gaussians that are converted at a time."""
    for start in range(0, count, BLOCK_ROWS):
        yield slice(start, min(start + BLOCK_ROWS, count))


def read_rows(file: OpenScene, kind: np.dtype, offset: int, count: int) -> NDArray[Any]:
    """Read `count` rows of a dtype from a byte offset on."""
    data = np.empty(count * kind.itemsize, np.uint8)
    file.read(offset, data)
    return data.view(kind)


def row_blocks(file: OpenScene, kind: np.dtype, offset: int, count: int) -> Iterator[tuple[slice, NDArray[Any]]]:
    """Yield `count` rows of a dtype from a byte offset on, block by block, with the slice of their Gaussians."""
    for block in blocks(count):
        yield block, read_rows(file, kind, offset + block.start * kind.itemsize, block.stop - block.start)


def read_bytes(path: Path, start: int, end: int) -> bytes:
    """Return the bytes of a part of a file, or those that are left.

    Raises:
        SceneError: If the file cannot be read.
    """
    with reading_scene(path), path.open("rb") as file:
        file.seek(start)
        return file.read(end - start)


def truncated(path: Path, declared: str) -> SceneError:
    """Return the error about a file that is shorter than a header declares."""
    return SceneError(f"{path}: {declared}: the file is truncated or its header is wrong. Copy or export it again.")


def number_of(count: int, unit: str) -> str:
    """Return a number with its unit, such as "1 byte"."""
    return f"{count} {unit}" + "s" * (count != 1)


def about_surplus(count: int, unit: str, also: str = "") -> tuple[str, ...]:
    """Return the note on content that a header does not declare, such as 12 bytes; nothing if there is none."""
    surplus = f"{number_of(count, unit)}{also}"
    note = f"the file has {surplus} more than its header declares, which are not read; copy or export it again"
    return (note,) if count else ()


def without_padding(data: bytes) -> bytes:
    """Return bytes after the data of a scene; nothing if they mean nothing."""
    return data if len(data) > _MAX_PADDING or data.strip(_PADDING) else b""


def about_part(path: Path, start: int, end: int, row_bytes: int | None = None) -> tuple[str, ...]:
    """Return the note on a part of a file that its header does not declare; nothing if there is only padding.

    Args:
        start: Byte offset of the part.
        end: Byte offset of its end.
        row_bytes: Size of a row before the part; None if rows differ in size.
    """
    if start >= end or not without_padding(read_bytes(path, start, min(end, start + _MAX_PADDING + 1))):
        return ()
    rows = ""
    if row_bytes and (end - start) % row_bytes == 0:
        rows = f" ({number_of((end - start) // row_bytes, 'row')})"
    return about_surplus(end - start, "byte", rows)


def refuse_text_transfer(path: Path, header_bytes: int, newline: bytes, start: int, end: int) -> None:
    """Raise a SceneError if a binary file looks as if a transfer as text made it longer than declared.

    Args:
        header_bytes: Size of its header.
        newline: Line end of its header.
        start: Byte offset of the end of the declared data.
        end: Size of the file.
    """
    if start >= end:
        return
    data = read_bytes(path, header_bytes, min(start, header_bytes + _SAMPLE_BYTES))
    line_ends = data.count(b"\n")
    changed = newline == b"\r\n" or (line_ends == data.count(b"\r\n") and line_ends >= _MIN_LINE_ENDS)
    blank = not read_bytes(path, start, min(end, start + _MAX_PADDING)).strip(_BLANKS)
    if (changed and not blank) or _is_utf8(data):
        surplus = number_of(end - start, "byte")
        raise SceneError(
            f"{path}: has {surplus} more than its header declares. Was it transferred as text, which changes line ends "
            "and other bytes? Copy it again in binary mode."
        )


def _is_utf8(data: bytes) -> bool:
    """Return whether data is UTF-8 beyond ASCII, which binary numbers never are; its end may cut off a character."""
    try:
        return not codecs.getincrementaldecoder("utf-8")().decode(data).isascii()
    except UnicodeDecodeError:
        return False
