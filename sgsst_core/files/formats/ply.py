"""PLYs of 3DGS trainers (`scene_file` reads them), PlayCanvas' compressed PLYs, and the parser of their headers.

The properties are those of Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023): x y z,
f_dc_0..2, f_rest_* (channel-major: all coefficients of red first), opacity (logit), scale_0..2 (log), rot_0..3 (wxyz).

Two variants are read too: colors of 8 bits in red, green and blue instead of f_dc_* (nerfstudio), and a single scale.

Headers are checked against the size of the file before anything is read or allocated. The format is that of Greg Turk,
"The PLY Polygon File Format" (1994). The newer type names (`float32`, `int8`, ...) are accepted too, as are LF, CR LF
and CR line ends.

Comments state render modes: Brush's `SplatRenderMode: mip` (also of splat-transform and gsplat), Postshot's
`postshot.anti_aliasing=1`, `antialiased 1`, fVDB's `fvdb_ply_af_8198767135antialias|int64|1` and `...eps2d|double|0.3`,
and our own `eps2d 0.1`.

In a compressed PLY, a Gaussian takes 16 bytes, and one byte per SH coefficient above degree 0. Positions and log scales
are quantized to 11, 10 and 11 bits, and colors to 8 bits per channel, within bounds shared by a chunk of 256 Gaussians.
Opacities have 8 bits. Rotations have three components of 10 bits each. SH coefficients are bytes that cover the range
-4 to 4. The layout is that of `splat-transform` (https://github.com/playcanvas/splat-transform).
"""

import itertools
import re
from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sgsst_core.constants import COLOR_OFFSET, EPS2D, SH_C0
from sgsst_core.errors import SceneError
from sgsst_core.files.advice import refuse_changed_meaning
from sgsst_core.files.formats import scene_format
from sgsst_core.scene.rendering import Rendering

#: Properties of the scene's tensors; opacity and f_rest_* follow.
PROPERTIES = {
    "means": ("x", "y", "z"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "sh_dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
}
#: Colors of 8 bits, which nerfstudio writes instead of f_dc_* on request, and others beside them.
RGB = ("red", "green", "blue")


@dataclass(frozen=True)
class PlySceneHeader(scene_format.SceneHeader):
    """Header of a PLY.

    Attributes:
        stored_coefficients: SH coefficients per color channel above degree 0 in the file.
        sources: Properties of a variant by the name of the usual property that they replace; empty if there are none.
    """

    ply: "PlyHeader"
    stored_coefficients: int
    sources: dict[str, str]


def _read_header(start: scene_format.FileStart) -> PlySceneHeader:
    header = read_header(start)
    stored, sources = _check_properties(start.path, header)
    check_length(start.path, header)
    coefficients = min(stored, scene_format.COEFFICIENTS[3])
    notes = ["SH bands above degree 3 are not drawn; only a stylized PLY keeps them"] if coefficients < stored else []
    if sources:
        notes.append(f"{', '.join(dict.fromkeys(sources.values()))} become the usual properties of a stylized PLY")
    fields = (header.vertex.count, coefficients, header, stored, sources)
    return PlySceneHeader(PLY, *fields, notes=tuple(notes), tag=ply_tag(header))


def _sources(kinds: dict[str, str]) -> dict[str, str]:
    """Return the properties of a variant, by the name of the usual property that they replace."""
    sources: dict[str, str] = {}
    if all(kinds.get(name) == "u1" for name in RGB) and not any(name in kinds for name in PROPERTIES["sh_dc"]):
        sources |= dict(zip(PROPERTIES["sh_dc"], RGB, strict=True))
    scales = [name for name in ("scale", *PROPERTIES["scales"]) if name in kinds]
    if scales in (["scale"], ["scale_0"]):
        sources |= dict.fromkeys(PROPERTIES["scales"], scales[0])
    return sources


def _check_properties(path: Path, header: "PlyHeader") -> tuple[int, dict[str, str]]:
    """Check that a PLY is a 3DGS scene before any data is read.

    Returns:
        Stored SH coefficients per channel, and `PlySceneHeader.sources`.
    """
    vertex = header.elements.get("vertex")
    kinds = vertex.kinds if vertex else {}
    refuse_changed_meaning(path, kinds)
    sources = _sources(kinds)
    known = {*kinds, *sources, *(["scale_2"] if is_flat(kinds) else [])}
    missing = [name for names in (*PROPERTIES.values(), ("opacity",)) for name in names if name not in known]
    if vertex is None or missing:
        raise SceneError(
            f"{path}: is not a 3DGS scene; missing: {', '.join(missing)}. Of a mesh or a point cloud, train Gaussians "
            "first."
        )
    if vertex.count == 0:
        raise SceneError(f"{path}: holds no Gaussians (element vertex 0). Export the scene again.")
    rest = [name for name in kinds if re.fullmatch(r"f_rest_\d+", name)]
    if len(rest) // 3 not in scene_format.STORED_COEFFICIENTS.values() or len(rest) % 3:
        raise SceneError(
            f"{path}: has {len(rest)} f_rest properties; SH degree 0 to 4 have 0, 9, 24, 45, 72. Export it again."
        )
    absent = [f"f_rest_{i}" for i in range(len(rest)) if f"f_rest_{i}" not in kinds]
    if absent:
        raise SceneError(
            f"{path}: f_rest properties are not numbered 0 to {len(rest) - 1}; missing: {', '.join(absent)}."
        )
    changed = (*PROPERTIES["means"], *PROPERTIES["scales"], *PROPERTIES["sh_dc"], "opacity", *rest)
    integers = [name for name in changed if kinds.get(name, "f")[0] != "f"]
    if integers:
        raise SceneError(
            f"{path}: stores {', '.join(integers)[:80]} as integers; values that change need float or double. Convert "
            "the scene first."
        )
    return len(rest) // 3, sources


def write_ply(output: BinaryIO, arrays: scene_format.Arrays, rendering: Rendering, least_coefficients: int = 0) -> None:
    """Write a binary little-endian float32 PLY with the usual order of properties. Normals are 0.

    Args:
        least_coefficients: SH coefficients per color channel above degree 0 that each row has; missing ones are 0.
    """
    count, stored = arrays["sh_rest"].shape[:2]
    coefficients = max(stored, least_coefficients)
    names = [
        *(*PROPERTIES["means"], "nx", "ny", "nz", *PROPERTIES["sh_dc"]),
        *(*(f"f_rest_{i}" for i in range(3 * coefficients)), "opacity", *PROPERTIES["scales"], *PROPERTIES["quats"]),
    ]
    lines = [
        *("ply", "format binary_little_endian 1.0", *comment_lines(rendering)),
        *(f"element vertex {count}", *(f"property float {name}" for name in names)),
        *("end_header", ""),
    ]
    output.write("\n".join(lines).encode())
    for part in scene_format.blocks(count):
        block = {name: array[part] for name, array in arrays.items()}
        means, opacities = block["means"], block["opacities"][:, None]
        rest = np.zeros((len(means), 3, coefficients), np.float32)  # channel-major
        rest[:, :, :stored] = block["sh_rest"].transpose(0, 2, 1)
        shapes = [opacities, block["scales"], block["quats"]]
        columns = [means, np.zeros_like(means), block["sh_dc"], rest.reshape(len(means), -1), *shapes]
        output.write(np.ascontiguousarray(np.concatenate(columns, axis=1), "<f4").data)


def _matches(start: scene_format.FileStart) -> bool:
    return start.head.startswith(b"ply") and not COMPRESSED_PLY.matches(start)


PLY = scene_format.SceneFormat("ply", "PLY", 248, _matches, _read_header, write=write_ply)

#: Maximum size of a header. A 3DGS header takes 2 kB; a megabyte allows long comments. The limit avoids searching a
#: whole file that is not a PLY for `end_header`.
MAX_HEADER_BYTES = 1 << 20

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
    **{"mip": "antialiased", "default": "classic", "2dgs": "2dgs", "antialiased": "antialiased", "classic": "classic"},
    **dict.fromkeys(("1", "true", "yes", "on"), "antialiased"),
    **dict.fromkeys(("0", "false", "no", "off"), "classic"),
}
_IS = r"(?:\s*[:=]\s*|\s+|\|\w{1,9}\|)(\S+)"
_MODE = re.compile(
    r"[\w.|]*?(?:(?:render|raster)[a-z]{0,9}[-_ ]?mode|anti[-_ ]?alias(?:ed|ing)?|(?<![a-z])mip(?:[-_ ]?splatting)?)"
    + _IS,
    re.IGNORECASE,
)
_EPS2D = re.compile(r"[\w.|]*?(?:eps_?2d|kernel_?size)" + _IS, re.IGNORECASE)
#: Bytes after the data that mean nothing: zeros, blanks, and the end-of-file mark of DOS; and most of them.
_PADDING, _MAX_PADDING = b"\0 \t\r\n\x1a", 1 << 16


@dataclass(frozen=True)
class PlyElement:
    """Element of a PLY.

    Attributes:
        count_span: Start and end of the count in the bytes of the header.
        byte_order: Byte order of its numbers; "" in text files.
        kinds: NumPy type codes such as f4, by property; those of the items of a list.
        lists: Properties that are lists, such as the vertices of a face. Only elements without rows may have any.
    """

    name: str
    count: int
    count_span: tuple[int, int]
    byte_order: str
    kinds: dict[str, str] = field(default_factory=dict)
    lists: list[str] = field(default_factory=list)

    @property
    def dtype(self) -> np.dtype:
        """Return the dtype of a row in a binary file."""
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
    def vertex(self) -> PlyElement:
        """Return the element that holds the Gaussians; raise KeyError if there is none."""
        return self.elements["vertex"]


def comment_of(line: bytes) -> str | None:
    """Return the text of a comment or information line of a header; None if the line is another."""
    keyword, _, comment = line.strip().partition(b" ")
    return comment.decode("latin-1").strip() if keyword in (b"comment", b"obj_info") else None


def read_header(file: scene_format.FileStart) -> PlyHeader:
    """Parse the header of a PLY file without reading its data.

    Raises:
        SceneError: If the file cannot be read, has no PLY header, or its header has an invalid line.
    """
    path, start = file.path, scene_format.read_bytes(file.path, 0, MAX_HEADER_BYTES)
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
    elements: dict[str, PlyElement] = {}
    last: PlyElement | None = None
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
                last = PlyElement(name, int(count), (stop - len(count), stop), byte_order)
                if name in elements:
                    raise SceneError(f"{path}: the PLY header declares element {name!r} twice. Export it again.")
                elements[name] = last
            case ["property", *lengths, kind, name] if last and kind in _TYPES and lengths in _LENGTHS:
                if name in last.kinds:
                    raise SceneError(f"{path}: the PLY header declares {last.name}.{name} twice. Export it again.")
                last.kinds[name] = _TYPES[kind]
                if lengths:
                    last.lists.append(name)
            case _:
                shown = line[:80].decode("latin-1")
                raise SceneError(f"{path}: line {number} of the PLY header is invalid: {shown!r}. Export it again.")
        position += len(line) + len(newline)
    if byte_order is None:
        raise SceneError(f"{path}: the PLY header has no 'format' line. Export the scene again.")
    for each in elements.values():
        if each.count and not each.kinds:
            raise SceneError(f"{path}: element {each.name!r} of the PLY header has no property. Export it again.")
    return PlyHeader(byte_order, raw, elements)


def check_length(path: Path, header: PlyHeader) -> None:
    """Check that a file is at least as long as its header declares, without allocating memory for the data.

    Raises:
        SceneError: If the file is shorter than declared, or its rows differ in length because they hold lists.
    """
    least = 0
    for element in header.elements.values():
        if element.lists and element.count:
            raise SceneError(
                f"{path}: element {element.name!r} holds lists ({', '.join(element.lists)[:80]}), which 3DGS scenes do "
                "not have. Export the Gaussians without them."
            )
        # text values have at least a digit and a separator
        least += element.count * (2 * len(element.kinds) if header.text else element.dtype.itemsize)
    data = path.stat().st_size - len(header.raw)
    if least - (1 if header.text else 0) > data:  # the last line may lack its line end
        declared = ", ".join(f"{element.count} {name}" for name, element in header.elements.items())
        needed = f"which takes at least {least} bytes, but only {data} follow it"
        raise scene_format.truncated(path, f"the header declares {declared}, {needed}")


def element_offsets(path: Path, header: PlyHeader) -> dict[str, int]:
    """Return the byte offset of each element's rows in a binary file, by element name; nothing for a text file.

    Rows of text have no fixed length, so their number is only checked when they are parsed.

    Raises:
        SceneError: If the file is shorter than declared.
    """
    check_length(path, header)
    sizes = [element.count * element.dtype.itemsize for element in header.elements.values()]
    offsets = itertools.accumulate(sizes, initial=len(header.raw))
    return {} if header.text else dict(zip(header.elements, offsets, strict=False))


def surplus(path: Path, header: PlyHeader) -> tuple[str, ...]:
    """Return the note on what follows the last element of a binary file; nothing if only padding does.

    Raises:
        SceneError: If the file is shorter than declared.
    """
    if header.text:
        return ()
    last = [*header.elements.values()][-1]
    end = element_offsets(path, header)[last.name] + last.count * last.dtype.itemsize
    data = scene_format.read_bytes(path, end, end + _MAX_PADDING + 1)
    if len(data) <= _MAX_PADDING and not data.strip(_PADDING):
        return ()
    more = path.stat().st_size - end
    return (f"the file is longer than its header declares by {more} B, which are not read; copy or export it again",)


def ply_tag(header: PlyHeader) -> scene_format.RenderTag:
    """Return the render mode that the comments and properties of a PLY state; the last comment counts."""
    names = header.vertex.kinds
    mode, eps2d, reasons = None, None, []
    for comment in header.comments:
        if (match := _MODE.fullmatch(comment)) and match[1].lower() in _MODES:
            mode = _MODES[match[1].lower()]
            reasons.append(f"the comment {comment!r}")
        elif (match := _EPS2D.fullmatch(comment)) and (blur := scene_format.usable_eps2d(match[1])):
            eps2d = blur
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
    return scene_format.stated(mode or "classic", ", ".join(reasons), eps2d)


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


#: Number of Gaussians per chunk. Each chunk has its own quantization bounds.
CHUNK_ROWS = 256


def bounds(prefix: str, axes: str) -> tuple[str, ...]:
    """Return the names of a compressed PLY's bounds, the lower bounds of all axes first."""
    return tuple(f"{side}_{prefix}{axis}" for side in ("min", "max") for axis in axes)


#: Bits of three components of a position or a scale.
_THREE_BITS = (11, 10, 11)
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BOUNDS = (*bounds("", "xyz"), *bounds("scale_", "xyz"), *bounds("", "rgb"))
#: Maximum absolute log scale; other writers of the format clamp to it too.
_LARGEST_SCALE = 20.0
#: SH coefficient for each byte: the center of its quantization step, or an end of the range for 0 and 255.
_HARMONICS = (8 * (np.array([0, *(np.arange(1, 255) + 0.5) / 256, 1]) - 0.5)).astype(np.float32)


@dataclass(frozen=True)
class CompressedPlyHeader(scene_format.SceneHeader):
    """Header of a compressed PLY."""

    ply: PlyHeader


def _matches_compressed(start: scene_format.FileStart) -> bool:
    return start.head.startswith(b"ply") and re.search(rb"[\r\n]property \w+ packed_position\s", start.head) is not None


def _read_compressed_header(start: scene_format.FileStart) -> CompressedPlyHeader:
    path = start.path
    header = read_header(start)
    for name in ("vertex", "chunk"):
        if name not in header.elements:
            raise SceneError(f"{path}: is a compressed PLY without element {name!r}. Export it again.")
    vertex, chunk, harmonics = header.vertex, header.elements["chunk"], header.elements.get("sh")
    if header.text:
        raise SceneError(f"{path}: is a compressed PLY as text, which no program writes. Export it again as binary.")
    _check_kinds(path, vertex, "u4", _PACKED)
    refuse_changed_meaning(path, vertex.kinds)
    _check_kinds(path, chunk, "f4", _BOUNDS if "min_r" in chunk.kinds else _BOUNDS[:12])
    if not vertex.count:
        raise SceneError(f"{path}: holds no Gaussians (element vertex 0). Export the scene again.")
    expected = -(-vertex.count // CHUNK_ROWS)
    if chunk.count != expected:
        raise SceneError(
            f"{path}: the header declares {chunk.count} chunks, but {vertex.count} Gaussians make {expected}: it is "
            "wrong. Export the scene again."
        )
    number = len(harmonics.kinds) if harmonics else 0
    if harmonics:
        if number not in (9, 24, 45) or harmonics.count != vertex.count:
            raise SceneError(
                f"{path}: element 'sh' has {harmonics.count} rows of {number} properties; there should be "
                f"{vertex.count} of 9, 24 or 45. Export the scene again."
            )
        _check_kinds(path, harmonics, "u1", tuple(f"f_rest_{i}" for i in range(number)))
    element_offsets(path, header)
    return CompressedPlyHeader(COMPRESSED_PLY, vertex.count, number // 3, header, tag=ply_tag(header))


def _check_kinds(path: Path, element: PlyElement, kind: str, names: tuple[str, ...]) -> None:
    wrong = [name for name in names if element.kinds.get(name) != kind]
    if wrong:
        raise SceneError(
            f"{path}: is not a readable compressed PLY: element {element.name!r} has {', '.join(wrong)} missing or of "
            "another type. Export it again."
        )


def _read(
    file: scene_format.OpenScene, header: scene_format.SceneHeader, into: scene_format.Arrays
) -> scene_format.SceneHeader:
    """Fill the arrays of a scene, and return the header with the note on bytes after the last element."""
    assert isinstance(header, CompressedPlyHeader)
    notes = surplus(file.path, header.ply)
    starts = element_offsets(file.path, header.ply)
    kinds = {name: element.dtype for name, element in header.ply.elements.items()}

    def rows(name: str, first: int, count: int) -> NDArray[Any]:
        return scene_format.read_rows(file, kinds[name], starts[name] + first * kinds[name].itemsize, count)

    for block in scene_format.blocks(header.count):
        start, count = block.start, block.stop - block.start
        chunks = rows("chunk", start // CHUNK_ROWS, -(-count // CHUNK_ROWS))
        _unpack(rows("vertex", start, count), chunks, {name: array[block] for name, array in into.items()})
        if header.coefficients:
            harmonics = rows("sh", start, count)
            for i in range(3 * header.coefficients):
                channel, index = divmod(i, header.coefficients)
                into["sh_rest"][block, index, channel] = _HARMONICS[harmonics[f"f_rest_{i}"]]
    return replace(header, notes=(*header.notes, *notes))


@np.errstate(over="ignore", invalid="ignore")  # non-finite results are reported later
def _unpack(rows: NDArray[Any], chunks: NDArray[Any], into: scene_format.Arrays) -> None:
    position, rotation, scale, color = (rows[name].astype(np.uint32) for name in _PACKED)
    chunk = np.arange(len(rows)) // CHUNK_ROWS

    def between(prefix: str, axes: str, fraction: NDArray[np.float64]) -> NDArray[np.float64]:
        names = bounds(prefix, axes)
        low, high = (
            np.stack([chunks[name].astype(np.float64) for name in side], axis=1)[chunk]
            for side in (names[:3], names[3:])
        )
        return low * (1 - fraction) + high * fraction

    into["means"][:] = between("", "xyz", _three(position))
    into["scales"][:] = between("scale_", "xyz", _three(scale))
    fraction = np.stack([(color >> shift) & 255 for shift in (24, 16, 8)], axis=1) / 255
    colors = between("", "rgb", fraction) if "min_r" in (chunks.dtype.names or ()) else fraction
    into["sh_dc"][:] = (colors - COLOR_OFFSET) / SH_C0
    into["opacities"][:] = scene_format.OPACITY_LOGITS[color & 255]
    components = np.stack([(rotation >> shift) & 1023 for shift in (20, 10, 0)], axis=1) / 1023
    into["quats"][:] = scene_format.with_largest(rotation >> 30, (components - 0.5) * np.sqrt(2))


def _three(packed: NDArray[np.uint32]) -> NDArray[np.float64]:
    """Unpack 11, 10 and 11 bits to values in 0..1, [n, 3]."""
    return np.stack([(packed >> 21) / 2047, ((packed >> 11) & 1023) / 1023, (packed & 2047) / 2047], axis=1)


def _write(output: BinaryIO, arrays: scene_format.Arrays, rendering: Rendering) -> None:
    """Write a compressed PLY.

    Gaussians are sorted along a space-filling curve, so that chunks are compact and their bounds are tight.
    """
    count, coefficients = arrays["sh_rest"].shape[:2]
    order = scene_format.along_curve(arrays["means"])
    output.write(_header(count, coefficients, rendering))
    parts = [order[block] for block in scene_format.blocks(count)]
    packed = []
    for rows in parts:
        bounds_of, values = _pack({name: array[rows] for name, array in arrays.items() if name != "sh_rest"})
        output.write(bounds_of.astype("<f4").tobytes())
        packed.append(values.astype("<u4"))
    for values in packed:
        output.write(values.tobytes())
    if coefficients:
        for rows in parts:
            # channel-major, as in PLY
            rest = arrays["sh_rest"][rows].astype(np.float64).transpose(0, 2, 1)
            output.write(np.clip(np.floor(rest * 32 + 128), 0, 255).astype(np.uint8).tobytes())


def _header(count: int, coefficients: int, rendering: Rendering) -> bytes:
    harmonics = [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(3 * coefficients))]
    lines = [
        *("ply", "format binary_little_endian 1.0", *comment_lines(rendering)),
        *(f"element chunk {-(-count // CHUNK_ROWS)}", *(f"property float {name}" for name in _BOUNDS)),
        *(f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)),
        *(harmonics if coefficients else []),
        *("end_header", ""),
    ]
    return "\n".join(lines).encode()


def _pack(arrays: scene_format.Arrays) -> tuple[NDArray[np.float32], NDArray[np.uint32]]:
    """Return the bounds [chunks, 18] and compressed values [n, 4] of Gaussians that start at a chunk boundary."""
    starts = np.arange(0, len(arrays["means"]), CHUNK_ROWS)
    chunk = np.arange(len(arrays["means"])) // CHUNK_ROWS
    scales = np.clip(arrays["scales"], -_LARGEST_SCALE, _LARGEST_SCALE)
    bounds_of, fractions = [], []
    for values in (
        arrays["means"],
        scales,
        (arrays["sh_dc"].astype(np.float64) * SH_C0 + COLOR_OFFSET).astype(np.float32),
    ):
        low, high = np.minimum.reduceat(values, starts), np.maximum.reduceat(values, starts)
        bounds_of += [low, high]
        extent = high.astype(np.float64) - low
        fractions.append((values.astype(np.float64) - low[chunk]) / np.where(extent > 0, extent, 1)[chunk])
    largest, three = scene_format.without_largest(arrays["quats"])
    packed = [
        scene_format.join_bits(fractions[0], _THREE_BITS),
        scene_format.join_bits(np.column_stack([largest / 3, three / np.sqrt(2) + 0.5]), (2, 10, 10, 10)),
        scene_format.join_bits(fractions[1], _THREE_BITS),
        scene_format.join_bits(
            np.column_stack([fractions[2], scene_format.opacity_bytes(arrays["opacities"]) / 255]), (8, 8, 8, 8)
        ),
    ]
    return np.concatenate(bounds_of, axis=1), np.stack(packed, axis=1)


def _step(means: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the largest distance between positions that can be stored in the chunk of each Gaussian, [n]."""
    order = scene_format.along_curve(means)
    starts = np.arange(0, len(means), CHUNK_ROWS)
    ends = (side.reduceat(means[order].astype(np.float64), starts) for side in (np.maximum, np.minimum))
    steps = np.empty(len(means))
    steps[order] = (np.subtract(*ends) / (2047, 1023, 2047)).max(axis=1)[np.arange(len(means)) // CHUNK_ROWS]
    return steps


COMPRESSED_PLY = scene_format.SceneFormat(
    *("compressed.ply", "compressed PLY", 61, _matches_compressed, _read_compressed_header, _read, _write),
    ranges={"scales": (-_LARGEST_SCALE, _LARGEST_SCALE), "sh_rest": (-4.0, 4.0)},
    step=_step,
)
