"""Parser of PLY headers, which are checked against the size of the file before anything is read or allocated.

The format is that of Greg Turk, "The PLY Polygon File Format" (1994). The newer type names (`float32`, `int8`, ...) are
accepted too, as are LF, CR LF and CR line ends.

Comments state render modes: Brush's `SplatRenderMode: mip` (also of splat-transform and gsplat), Postshot's
`postshot.anti_aliasing=1`, `antialiased 1`, fVDB's `fvdb_ply_af_8198767135antialias|int64|1` and `...eps2d|double|0.3`,
and our own `eps2d 0.1`. Other comments that seem to state one give a warning.
"""

from __future__ import annotations

import math
import mmap
import re
import struct
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from sgsst_core.constants import EPS2D
from sgsst_core.errors import SceneError
from sgsst_core.files.formats.scene_format import (
    FileStart,
    RenderTag,
    about_part,
    about_surplus,
    read_bytes,
    refuse_text_transfer,
    stated,
    truncated,
    usable_eps2d,
)
from sgsst_core.scene.rendering import Rendering

#: Maximum size of a header. A 3DGS header takes 2 kB; a megabyte allows long comments. The limit avoids searching a
#: whole file that is not a PLY for `end_header`.
MAX_HEADER_BYTES = 1 << 20
#: Maximum number of rows with lists, such as faces. Each is read to find its end, which takes a second for all.
_MAX_LISTS = 1 << 21

_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"},
    **{"double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float32": "f4", "float64": "f8"},
}
#: Words before the type of a property: none, or those of a list.
_LENGTHS = [[], *(["list", name] for name, kind in _TYPES.items() if kind[0] != "f")]
_BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
#: Property of Mip-Splatting: deviation of the 3D filter of each Gaussian, in world units.
FILTER_3D = "filter_3D"
#: Blur of Mip-Splatting and of Brush's antialiased scenes.
_MIP_EPS2D = 0.1

_MODES = {
    "mip": "antialiased",
    "default": "classic",
    "2dgs": "2dgs",
    "antialiased": "antialiased",
    "classic": "classic",
}
_MODES |= dict.fromkeys(("1", "true", "yes", "on"), "antialiased") | dict.fromkeys(
    ("0", "false", "no", "off"), "classic"
)
_IS = r"(?:\s*[:=]\s*|\s+|\|\w{1,9}\|)(\S+)"
_MODE = re.compile(
    r"[\w.|]*?(?:(?:render|raster)[a-z]{0,9}[-_ ]?mode|anti[-_ ]?alias(?:ed|ing)?|(?<![a-z])mip(?:[-_ ]?splatting)?)"
    + _IS,
    re.IGNORECASE,
)
_EPS2D = re.compile(r"[\w.|]*?(?:eps_?2d|kernel_?size)" + _IS, re.IGNORECASE)
_UP = re.compile(r"vertical axis:(.{1,100})", re.IGNORECASE)
#: Directions of up by the names of axes; in Brush, up is -y unless the data set states another.
_NAMED_UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, -1.0, 0.0), "z": (0.0, 0.0, -1.0)}
#: Comments that seem to state a render mode.
_ABOUT_MODE = re.compile(
    r"anti[-_ ]?alias|(?<![a-z])mip(?:map|[-_ ]?splat|(?![a-z]))|filter[-_ ]?3d|low[-_ ]?pass|eps_?2d|kernel"
    r"|(?:render|raster)\w{0,9}[-_ ]?mode",
    re.IGNORECASE,
)
_UNSCENTED = re.compile(r"\b3dgr?ut\b|\b3dgrt\b|\bunscented", re.IGNORECASE)


@dataclass(frozen=True)
class PlyElement:
    """Element of a PLY.

    Attributes:
        count_span: Start and end of the count in the bytes of the header.
        byte_order: Byte order of its numbers; "" in text files.
        kinds: NumPy type codes such as f4, by property; those of the items of a list.
        lists: NumPy type codes of the lengths of lists, by property. Rows with lists differ in length.
    """

    name: str
    count: int
    count_span: tuple[int, int]
    byte_order: str
    kinds: dict[str, str] = field(default_factory=dict)
    lists: dict[str, str] = field(default_factory=dict)

    @property
    def dtype(self) -> np.dtype:
        """Return the dtype of a row in a binary file; only for elements without lists."""
        return np.dtype([(name, self.byte_order + kind) for name, kind in self.kinds.items()])


@dataclass(frozen=True)
class PlyHeader:
    """Parsed header of a PLY file.

    Attributes:
        byte_order: "<" or ">"; "" for text files.
        raw: Bytes of the header, including the line end of `end_header`; the data starts at len(raw).
        elements: Elements by name, in the file's order.
    """

    byte_order: str
    raw: bytes
    elements: dict[str, PlyElement]

    @property
    def text(self) -> bool:
        """Return whether the data is text ("ascii")."""
        return not self.byte_order

    @property
    def newline(self) -> bytes:
        """Return the line end of the header."""
        return self.raw[3:5] if self.raw[3:5] == b"\r\n" else self.raw[3:4]

    @property
    def comments(self) -> list[str]:
        """Return the comments, without their keyword."""
        return [comment for line in self.raw.split(self.newline) if (comment := comment_of(line)) is not None]

    @property
    def has_double_positions(self) -> bool:
        """Return whether positions are stored in double precision."""
        return self.vertex.kinds.get("x") == "f8"

    @property
    def vertex(self) -> PlyElement:
        """Return the element that holds the Gaussians; raise KeyError if there is none."""
        return self.elements["vertex"]


def comment_of(line: bytes) -> str | None:
    """Return the text of a comment or information line of a header; None if the line is another."""
    keyword, _, comment = line.strip().partition(b" ")
    return comment.decode("latin-1").strip() if keyword in (b"comment", b"obj_info") else None


def read_header(file: FileStart) -> PlyHeader:
    """Parse the header of a PLY file without reading its data.

    Raises:
        SceneError: If the file cannot be read, has no PLY header, or its header has an invalid line.
    """
    path, start = file.path, read_bytes(file.path, 0, MAX_HEADER_BYTES)
    opening = re.match(rb"ply(\r\n|\n|\r)", start)
    if not opening:
        raise SceneError(f"{path}: has no PLY header (it does not start with 'ply'). Give a 3DGS scene as .ply file.")
    newline = opening[1]
    end = start.find(newline + b"end_header" + newline)
    if end < 0:
        raise SceneError(f"{path}: the PLY header has no 'end_header' line: the file is truncated or no PLY.")
    raw = start[: end + len(b"end_header") + 2 * len(newline)]
    return _parse(path, raw, newline)


def _parse(path: Path, raw: bytes, newline: bytes) -> PlyHeader:
    byte_order: str | None = None
    elements: list[PlyElement] = []
    position = 0
    for number, line in enumerate(raw.split(newline), start=1):
        words = [word.decode("latin-1") for word in line.split()]
        match words:
            case [] | ["comment" | "obj_info", *_] | ["end_header"]:
                pass
            case ["ply"] if number == 1:
                pass
            case ["format", name, "1.0"] if name in _BYTE_ORDERS and byte_order is None:
                byte_order = _BYTE_ORDERS[name]
            # 18 digits are more than any file needs, and stay below the limit of int() on long strings
            case ["element", name, count] if re.fullmatch("[0-9]{1,18}", count) and byte_order is not None:
                stop = position + len(line.rstrip())
                elements.append(PlyElement(name, int(count), (stop - len(count), stop), byte_order))
            case ["property", *lengths, kind, name] if elements and kind in _TYPES and lengths in _LENGTHS:
                last = elements[-1]
                if name in last.kinds:
                    raise SceneError(
                        f"{path}: the PLY header declares {last.name}.{name} twice. Export the scene again."
                    )
                last.kinds[name] = _TYPES[kind]
                if lengths:
                    last.lists[name] = _TYPES[lengths[1]]
            case _:
                shown = line[:80].decode("latin-1")
                raise SceneError(f"{path}: line {number} of the PLY header is invalid: {shown!r}. Export it again.")
        position += len(line) + len(newline)
    if byte_order is None:
        raise SceneError(f"{path}: the PLY header has no 'format' line. Export the scene again.")
    uses = Counter(each.name for each in elements)
    for each in elements:
        if uses[each.name] > 1:
            raise SceneError(f"{path}: the PLY header declares element {each.name!r} twice. Export the scene again.")
        if each.count and not each.kinds:
            raise SceneError(f"{path}: element {each.name!r} of the PLY header has no property. Export it again.")
    return PlyHeader(byte_order, raw, {each.name: each for each in elements})


def check_length(path: Path, header: PlyHeader) -> None:
    """Check that a file is at least as long as its header declares, without allocating memory for the data.

    Raises:
        SceneError: If the file is shorter than declared.
    """
    least = 0
    for element in header.elements.values():  # text values have at least a digit and a separator; lists may be empty
        sizes = [np.dtype(kind).itemsize for kind in {**element.kinds, **element.lists}.values()]
        least += element.count * (2 * len(sizes) if header.text else sum(sizes))
    data = path.stat().st_size - len(header.raw)
    if least - (1 if header.text else 0) > data:  # the last line may lack its line end
        declared = ", ".join(f"{element.count} {name}" for name, element in header.elements.items())
        needed = f"which takes at least {least} bytes, but only {data} follow it"
        raise truncated(path, f"the header declares {declared}, {needed}")


def element_offsets(path: Path, header: PlyHeader) -> dict[str, int]:
    """Return the byte offset of each element's rows in a binary file, by element name; nothing for a text file.

    Rows of text have no fixed length, so their number is only checked when they are parsed.

    Raises:
        SceneError: If the file is shorter than declared.
    """
    check_length(path, header)
    return {} if header.text else dict(zip(header.elements, _bounds(path, header), strict=False))


def surplus(path: Path, header: PlyHeader) -> tuple[str, ...]:
    """Return the note on what follows the last element of a file; nothing if only padding does.

    Raises:
        SceneError: If the file was probably transferred as text, or is shorter than declared.
    """
    if header.text:
        with path.open(encoding="latin-1") as lines:
            lines.seek(len(header.raw))
            rows = sum(1 for line in lines if line.strip(" \t\r\n\x1a"))
        rows -= sum(element.count for element in header.elements.values())
        return about_surplus(max(0, rows), "row")
    end, size = _bounds(path, header)[-1], path.stat().st_size
    refuse_text_transfer(path, len(header.raw), header.newline, end, size)
    last = [*header.elements.values()][-1]
    return about_part(path, end, size, None if last.lists else last.dtype.itemsize)


def _bounds(path: Path, header: PlyHeader) -> list[int]:
    """Return the byte offset of each element's rows in a binary file, and that of their end."""
    size, position = path.stat().st_size, len(header.raw)
    bounds = [position]
    for element in header.elements.values():
        if element.lists and element.count:
            position = _end_of_lists(path, element, position)
        elif element.count:
            position += element.count * element.dtype.itemsize
        if position > size:
            raise truncated(path, f"ends within element {element.name!r}")
        bounds.append(position)
    return bounds


def _end_of_lists(path: Path, element: PlyElement, position: int) -> int:
    """Return the byte offset at which an element with lists ends.

    The length of each list is read, and checked against the size of the file.
    """
    if element.count > _MAX_LISTS:
        raise SceneError(
            f"{path}: element {element.name!r} has {element.count:,} rows with lists, of at most {_MAX_LISTS:,}. "
            "Export the Gaussians without it."
        )
    steps = [
        (struct.Struct(element.byte_order + np.dtype(length).char) if length else None, np.dtype(kind).itemsize)
        for kind, length in ((kind, element.lists.get(name)) for name, kind in element.kinds.items())
    ]
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        for _ in range(element.count):
            for length, item_bytes in steps:
                items = 1
                if length is not None:
                    if position + length.size > len(data):
                        raise truncated(path, f"ends within element {element.name!r}")
                    items = length.unpack_from(data, position)[0]
                    if items < 0:
                        raise SceneError(f"{path}: element {element.name!r} holds a list of length {items}: corrupt.")
                    position += length.size
                position += items * item_bytes
        return position


def ply_tag(header: PlyHeader) -> RenderTag:
    """Return the render mode that the comments and properties of a PLY state; the last comment counts."""
    names = header.vertex.kinds
    mode, eps2d, reasons, warnings = None, None, [], []
    for comment in header.comments:
        if (match := _MODE.fullmatch(comment)) and match[1].lower() in _MODES:
            mode = _MODES[match[1].lower()]
        elif (match := _EPS2D.fullmatch(comment)) and (blur := usable_eps2d(match[1])):
            eps2d = blur
        elif _UNSCENTED.search(comment):
            reason = f"the comment {comment!r} names another projection"
            differs = "renders differ where Gaussians are large or lenses were distorted"
            warnings.append(("by linearized projection (EWA)", f"{reason}; {differs}"))
            continue
        elif _ABOUT_MODE.search(comment):
            advice = "if the scene was trained antialiased, add --render-mode antialiased"
            warnings.append(("classic unless stated otherwise", f"the comment {comment[:80]!r} is unknown; {advice}"))
            continue
        else:
            continue
        reasons.append(f"the comment {comment!r}")
    if mode is None and FILTER_3D in names:
        mode = "antialiased"
        reasons.append(f"the property {FILTER_3D} of Mip-Splatting")
    if is_flat(names):
        mode = "2dgs"
        reasons.append("the missing property scale_2")
    usual = _MIP_EPS2D if FILTER_3D in names or "Exported from Brush" in header.comments else EPS2D
    if eps2d is None:
        eps2d = usual if mode == "antialiased" else EPS2D
    return stated(mode or "classic", ", ".join(reasons), eps2d, tuple(warnings))


def stated_up(header: PlyHeader) -> tuple[float, float, float] | None:
    """Return the direction of up that Brush's comment states; None for its default, which means nothing."""
    up = None
    for match in filter(None, map(_UP.fullmatch, header.comments)):
        try:
            x, y, z = map(float, _NAMED_UP.get(match[1].strip().lower()) or re.split(r"[\s,]+", match[1].strip(" []")))
        except ValueError:
            continue
        up = (x, y, z) if 0 < math.hypot(x, y, z) < math.inf and (x, y, z) != _NAMED_UP["y"] else None
    return up


def is_flat(names: Collection[str]) -> bool:
    """Return whether properties are those of 2D Gaussian Splatting, whose Gaussians have no third axis."""
    return "scale_1" in names and "scale_2" not in names and "scale" not in names


def comment_lines(rendering: Rendering) -> list[str]:
    """Return the lines of a PLY header that state a render mode; empty for the default mode."""
    mode, eps2d = _stating(rendering)
    return [*([] if rendering.mode == "classic" else [mode]), *([] if rendering.eps2d == EPS2D else [eps2d])]


def retagged(raw: bytes, header: PlyHeader, rendering: Rendering) -> bytes:
    """Add comments that state a render mode to the bytes of a PLY header, unless the header already states that mode.

    Args:
        raw: Bytes of the header, which may differ from those of `header` in the number of Gaussians.
    """
    if ply_tag(header).rendering == rendering:
        return raw
    lines = [
        line
        for line in raw.split(header.newline)
        if not any(pattern.fullmatch(comment_of(line) or "") for pattern in (_MODE, _EPS2D))
    ]
    after_format = next(i for i, line in enumerate(lines) if line.startswith(b"format")) + 1
    lines[after_format:after_format] = [line.encode() for line in _stating(rendering)]
    return header.newline.join(lines)


def _stating(rendering: Rendering) -> tuple[str, str]:
    """Return the lines of a PLY header that state mode and blur."""
    name = next(name for name, mode in _MODES.items() if mode == rendering.mode)
    return f"comment SplatRenderMode: {name}", f"comment eps2d {rendering.eps2d!r}"
