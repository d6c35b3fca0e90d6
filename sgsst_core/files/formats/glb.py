"""Reader and writer of GLB with the glTF extension KHR_gaussian_splatting.

A GLB is a JSON document followed by binary data. The Gaussians are a mesh primitive of points: each attribute is an
accessor, which states offset, stride and type of its values in the data. Standard deviations and opacities are stored
as they are, rotations as xyzw. All sets of Gaussians become one scene, each where its node shows it. The ratified
specification is
https://github.com/KhronosGroup/glTF/tree/main/extensions/2.0/Khronos/KHR_gaussian_splatting.

glTF has y up, z forward and x left. Scenes are rotated by 180 degrees about z from and to the axes of a PLY, after the
transformation of the node that holds them.

Linear colors are converted to sRGB for each Gaussian.

The specification does not define antialiasing. Written files state the render mode in the `extras` of the primitive.
"""

import json
import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.advice import refuse_changed_meaning
from sgsst_core.files.formats import scene_format
from sgsst_core.scene.rendering import Rendering

_MAGIC = b"glTF"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_MAX_JSON_BYTES = 1 << 20
#: Maximum number of nodes above the one of the Gaussians.
_MAX_DEPTH = 64
_MAX_BYTES = (1 << 32) - 1
_EXTENSION = "KHR_gaussian_splatting"
#: Extensions that change nothing in what is read. Files that require another one are refused.
_HARMLESS = re.compile(
    rf"{_EXTENSION}|KHR_mesh_quantization|EXT_(mesh_features|structural_metadata)"
    r"|[A-Z]+_(materials|texture|lights|xmp|audio|animation)(_\w+)?"
)
_LINEAR = "lin_rec709_display"
_SUPPORTED = {
    "kernel": "ellipse",
    "colorSpace": "srgb_rec709_display",
    "projection": "perspective",
    "sortingMethod": "cameraDistance",
}

#: NumPy type codes of component types, and largest values of normalized integers.
_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_LARGEST = {"<i1": 127, "<u1": 255, "<i2": 32767, "<u2": 65535}
_COMPONENTS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_FLOAT, _BYTE, _POINTS, _ARRAY_BUFFER = 5126, 5121, 0, 34962
_MAX_STRIDE = 252

#: Attributes of the scene's tensors other than spherical harmonics, and their types.
_ATTRIBUTES = {
    "means": ("POSITION", "VEC3"),
    "quats": (f"{_EXTENSION}:ROTATION", "VEC4"),
    "scales": (f"{_EXTENSION}:SCALE", "VEC3"),
    "opacities": (f"{_EXTENSION}:OPACITY", "SCALAR"),
    "sh_dc": (f"{_EXTENSION}:SH_DEGREE_0_COEF_0", "VEC3"),
}
_HARMONICS = [f"{_EXTENSION}:SH_DEGREE_{degree}_COEF_{i}" for degree in (1, 2, 3) for i in range(2 * degree + 1)]

#: Range of written log scales, within that of float32, and largest written opacity, the last one below 1.
_LOG_SCALES = (-87.0, 88.0)
_LARGEST_OPACITY = 1 - 2.0**-24


@dataclass(frozen=True)
class Accessor:
    """Checked location of an attribute's values in the file.

    Attributes:
        offset: Byte offset of the first value.
        stride: Bytes from one value to the next.
        kind: dtype of a value with its components.
        largest: Integer that stands for 1 if integers are normalized; None otherwise.
    """

    offset: int
    stride: int
    kind: np.dtype
    largest: int | None


@dataclass(frozen=True)
class GlbPart:
    """Set of Gaussians of a GLB scene, as a node shows it.

    Attributes:
        accessors: Accessors by the names of the scene's tensors.
        harmonics: Accessors of the SH coefficients above degree 0.
        frame: Transformation to the axes of a PLY.
        tag: Render mode that the set states.
        linear: Whether colors are linear.
    """

    count: int
    accessors: dict[str, Accessor]
    harmonics: list[Accessor]
    frame: scene_format.Frame
    tag: scene_format.RenderTag
    linear: bool


@dataclass(frozen=True)
class GlbHeader(scene_format.SceneHeader):
    """Header of a GLB scene, which consists of `parts`."""

    parts: list[GlbPart]


def _read_header(start: scene_format.FileStart) -> GlbHeader:
    path = start.path
    text, data = _chunks(start)
    try:
        document = json.loads(text)
        shown, hidden = _shown_splats(path, document)
        required = {each for each in document.get("extensionsRequired", []) if not _HARMLESS.fullmatch(each)}
        for primitive, _ in shown:
            required |= set(primitive["extensions"][_EXTENSION].get("extensions") or {})
        if required:
            raise SceneError(
                f"{path}: its Gaussians need the glTF extension {', '.join(sorted(required))[:80]}, which cannot be "
                "read. Export the GLB without compression."
            )
        parts = [_part(path, document, *each, data) for each in shown]
        notes = [f"{hidden} sets of Gaussians that no node shows are left out"] if hidden else []
        notes += ["animations are left out"] if document.get("animations") else []
        linear = "colors are linear, and converted to sRGB for each Gaussian; where Gaussians overlap, renders differ"
        notes += [linear] if any(part.linear for part in parts) else []
    except scene_format.WRONG_JSON as error:
        raise SceneError(f"{path}: is not a valid GLB scene ({repr(error)[:200]}). Export it again.") from error
    count = sum(part.count for part in parts)
    if count > len(data):
        raise SceneError(f"{path}: its nodes show {count} Gaussians, more than its {len(data)} bytes can hold.")
    if len({part.tag.rendering for part in parts}) > 1:
        raise SceneError(f"{path}: its {len(parts)} sets of Gaussians have different render modes. Export them apart.")
    coefficients = max(len(part.harmonics) for part in parts)
    return GlbHeader(GLB, count, coefficients, parts, notes=tuple(notes), tag=parts[0].tag)


def _chunks(start: scene_format.FileStart) -> tuple[bytes, range]:
    """Return the JSON document, and the byte offsets of the binary data."""
    path = start.path
    head = start.head.ljust(_HEADER.size + _CHUNK.size, b"\0")
    (_, version, length), (json_bytes, kind) = _HEADER.unpack_from(head), _CHUNK.unpack_from(head, _HEADER.size)
    if version != 2:
        raise SceneError(f"{path}: is GLB of version {version}; version 2 can be read. Export it again.")
    if length > start.size:
        raise scene_format.truncated(path, f"the GLB header declares {length} bytes of {start.size}")
    first = _HEADER.size + _CHUNK.size
    if kind != b"JSON" or json_bytes > start.size - first:
        raise scene_format.truncated(path, f"the GLB header declares {json_bytes} bytes of JSON")
    if json_bytes > _MAX_JSON_BYTES:
        raise SceneError(
            f"{path}: has {json_bytes} bytes of JSON; at most {_MAX_JSON_BYTES} can be read. Export the Gaussians "
            "without the other objects of the file."
        )
    offset = first + json_bytes + _CHUNK.size
    text, chunk = (
        scene_format.read_bytes(path, first, first + json_bytes),
        scene_format.read_bytes(path, first + json_bytes, offset),
    )
    size, kind = _CHUNK.unpack(chunk) if len(chunk) == _CHUNK.size else (0, b"BIN\0")
    if kind != b"BIN\0" or offset + size > max(start.size, offset):
        raise scene_format.truncated(path, f"the GLB declares {size} bytes of data after its JSON")
    return text, range(offset, offset + size)


def _shown_splats(path: Path, document: dict[str, Any]) -> tuple[list[tuple[dict[str, Any], NDArray[np.float64]]], int]:
    """Return each primitive of Gaussians with the transformation [4, 4] of the node that shows it.

    A mesh that several nodes show is returned as often. If no node shows any Gaussians, each is returned with the
    identity.

    Returns:
        Primitives with their transformations, and the number of other primitives of Gaussians, which no node shows.
    """
    meshes, nodes = document.get("meshes", []), document.get("nodes", [])
    splats = {
        index: own
        for index, mesh in enumerate(meshes)
        if (own := [each for each in mesh["primitives"] if _EXTENSION in each.get("extensions", {})])
    }
    if not splats:
        raise SceneError(
            f"{path}: holds {len(meshes)} meshes but no Gaussians ({_EXTENSION}). Train Gaussians on the object first."
        )
    showing = [(index, node["mesh"]) for index, node in enumerate(nodes) if node.get("mesh") in splats]
    if not showing:
        return [(each, np.eye(4)) for own in splats.values() for each in own], 0
    parents = {child: index for index, node in enumerate(nodes) for child in node.get("children", [])}
    shown = [(each, _node_matrix(nodes, parents, index, np.eye(4))) for index, mesh in showing for each in splats[mesh]]
    return shown, sum(len(own) for mesh, own in splats.items() if mesh not in {mesh for _, mesh in showing})


@np.errstate(over="ignore", invalid="ignore")  # the transformation is checked
def _part(
    path: Path, document: dict[str, Any], primitive: dict[str, Any], matrix: NDArray[np.float64], data: range
) -> GlbPart:
    """Parse a primitive of Gaussians. Errors of `WRONG_JSON` mean that a value is missing or wrong."""
    declared = primitive["extensions"][_EXTENSION]
    linear = declared.get("colorSpace") == _LINEAR
    for name, supported in _SUPPORTED.items():
        if declared.get(name, supported) != supported and not (linear and name == "colorSpace"):
            raise SceneError(
                f"{path}: its Gaussians have {name} {str(declared[name])[:40]!r}; only {supported!r} can be read. "
                "Export it again."
            )
    attributes = primitive["attributes"]
    refuse_changed_meaning(path, attributes)
    count = scene_format.whole_number("count", document["accessors"][attributes["POSITION"]]["count"], 1)
    try:
        frame = scene_format.Frame.of(scene_format.Y_UP @ matrix)
    except ValueError as error:
        raise SceneError(f"{path}: {error}, by the transformation of its node. Export it without that.") from error
    tag = scene_format.extras_tag(primitive.get("extras"), "the extras of the GLB")
    present = sum(name in attributes for name in _HARMONICS)
    coefficients = min(number for number in scene_format.COEFFICIENTS.values() if number >= present)
    return GlbPart(
        count,
        {name: _accessor(document, attributes, *each, count, data) for name, each in _ATTRIBUTES.items()},
        [_accessor(document, attributes, name, "VEC3", count, data) for name in _HARMONICS[:coefficients]],
        frame,
        tag,
        linear,
    )


def _accessor(
    document: dict[str, Any], attributes: dict[str, int], name: str, shape: str, count: int, data: range
) -> Accessor:
    """Check that the values of an attribute lie in the binary data."""
    if name not in attributes:
        raise ValueError(f"the Gaussians have no attribute {name}")
    entry = document["accessors"][attributes[name]]
    if entry["type"] != shape or entry["count"] != count or "sparse" in entry:
        raise ValueError(f"accessor of {name}: {entry}")
    view = document["bufferViews"][entry["bufferView"]]
    if view.get("buffer") != 0 or "uri" in document["buffers"][0] or view.get("extensions"):
        raise ValueError(f"buffer view {entry['bufferView']} is not in the file, or compressed")
    start = scene_format.whole_number("byteOffset", view.get("byteOffset", 0))
    size = scene_format.whole_number("byteLength", view["byteLength"])
    if start + size > len(data):
        raise ValueError(f"buffer view {entry['bufferView']}: {view}, more than its {len(data)} bytes can hold")
    code = _TYPES[entry["componentType"]]
    kind = np.dtype((code, (_COMPONENTS[shape],)))
    stride = scene_format.whole_number("stride", view.get("byteStride", kind.itemsize))
    first = scene_format.whole_number("byteOffset", entry.get("byteOffset", 0))
    if first + (count - 1) * stride + kind.itemsize > size or not kind.itemsize <= stride <= _MAX_STRIDE:
        raise ValueError(f"accessor of {name}: {count} values are more than its {size} bytes can hold")
    largest = _LARGEST.get(code) if entry.get("normalized", False) else None
    return Accessor(data.start + start + first, stride, kind, largest)


@np.errstate(over="ignore", invalid="ignore")  # the transformation is checked
def _node_matrix(
    nodes: list[dict[str, Any]], parents: dict[int, int], index: int, below: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return a transformation [4, 4] below a node after those of the node, and of the nodes above it."""
    for _ in range(_MAX_DEPTH):
        below = _local_matrix(nodes[index]) @ below
        if index not in parents:
            return below
        index = parents[index]
    raise ValueError("the nodes are nested too deeply, or form a cycle")


def _local_matrix(node: dict[str, Any]) -> NDArray[np.float64]:
    """Return a node's own transformation [4, 4]: a matrix in column order, or translation, rotation and scale."""
    if "matrix" in node:
        return scene_format.json_numbers(node["matrix"], 16).reshape(4, 4).T
    quat = scene_format.json_numbers(node.get("rotation", [0, 0, 0, 1]), 4)
    if not 0.5 < np.linalg.norm(quat) < 2:
        raise ValueError(f"rotation: {quat}")
    x, y, z, w = quat / np.linalg.norm(quat)
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= scene_format.json_numbers(node.get("scale", [1, 1, 1]), 3)
    matrix[:3, 3] = scene_format.json_numbers(node.get("translation", [0, 0, 0]), 3)
    return matrix


@np.errstate(over="ignore", invalid="ignore")  # invalid values are reported later
def _read(file: scene_format.OpenScene, header: scene_format.SceneHeader, into: scene_format.Arrays) -> None:
    """Fill the arrays of a scene. Opacities of 0 and 1 and standard deviations of 0 become infinite."""
    assert isinstance(header, GlbHeader)
    converters: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
        "means": np.asarray,
        "quats": lambda values: np.roll(values, 1, axis=1),
        "scales": lambda values: scene_format.logarithms(file.path, values),
        "opacities": lambda values: scene_format.logits(file.path, values)[:, 0],
        "sh_dc": np.asarray,
    }
    first = 0
    for part in header.parts:
        arrays = {name: array[first : first + part.count] for name, array in into.items()}
        first += part.count
        for name, convert in converters.items():
            for block, values in _values(file, part.accessors[name], part.count):
                arrays[name][block] = convert(values)
        for index, accessor in enumerate(part.harmonics):
            for block, values in _values(file, accessor, part.count):
                arrays["sh_rest"][block, index] = values
        arrays["sh_rest"][:, len(part.harmonics) :] = 0
        part.frame.apply(arrays)
        if part.linear:
            _convert_linear(arrays)


@np.errstate(invalid="ignore")
def _convert_linear(arrays: scene_format.Arrays) -> None:
    """Convert linear colors to sRGB in place (IEC 61966-2-1); harmonics by the slope at the color of degree 0."""
    colors = np.maximum(COLOR_OFFSET + SH_C0 * arrays["sh_dc"].astype(np.float64), 0)
    dark, power = colors <= 0.0031308, np.maximum(colors, 0.0031308) ** (1 / 2.4)
    encoded = np.where(dark, 12.92 * colors, 1.055 * power - 0.055)
    slopes = np.where(dark, 12.92, 1.055 / 2.4 * power / np.maximum(colors, 0.0031308))
    arrays["sh_dc"][:] = (encoded - COLOR_OFFSET) / SH_C0
    arrays["sh_rest"] *= slopes[:, None].astype(np.float32)


def _values(
    file: scene_format.OpenScene, accessor: Accessor, count: int
) -> Iterator[tuple[slice, NDArray[np.float64]]]:
    """Yield the values of an accessor block by block, as slices of Gaussians and [n, components]."""
    for block in scene_format.blocks(count):
        rows = block.stop - block.start
        data_bytes = (rows - 1) * accessor.stride + accessor.kind.itemsize
        data = scene_format.read_rows(
            file, np.dtype(np.uint8), accessor.offset + block.start * accessor.stride, data_bytes
        )
        values = np.ndarray((rows,), accessor.kind, data, 0, (accessor.stride,)).astype(np.float64)
        yield block, values if accessor.largest is None else np.maximum(values / accessor.largest, -1)


def _write(output: BinaryIO, arrays: scene_format.Arrays, rendering: Rendering) -> None:
    """Write a GLB with float32 attributes, and colors for programs that show only points."""
    arrays = {name: array.copy() for name, array in arrays.items()}
    scene_format.Frame.of(scene_format.Y_UP).apply(arrays)
    columns = _columns(arrays)
    data_bytes = sum(column.nbytes for _, column in columns)
    text = json.dumps(_document(columns, data_bytes, scene_format.extras_of(rendering))).encode()
    text += b" " * (-len(text) % 4)
    length = _HEADER.size + 2 * _CHUNK.size + len(text) + data_bytes
    if length > _MAX_BYTES:
        raise OutputError(f"GLB cannot hold {len(arrays['means'])} Gaussians, which take {length} bytes. Write a PLY.")
    output.write(_HEADER.pack(_MAGIC, 2, length) + _CHUNK.pack(len(text), b"JSON") + text)
    output.write(_CHUNK.pack(data_bytes, b"BIN\0"))
    for _, column in columns:
        output.write(np.ascontiguousarray(column).data)


@np.errstate(over="ignore")
def _columns(arrays: scene_format.Arrays) -> list[tuple[str, NDArray[Any]]]:
    """Return the attributes of a scene in glTF's axes and their values, [n, components]."""
    opacities = np.clip(1 / (1 + np.exp(-arrays["opacities"].astype(np.float64))), 1e-37, _LARGEST_OPACITY)
    quats = np.roll(arrays["quats"].astype(np.float64), -1, axis=1)
    colors = np.clip(COLOR_OFFSET + SH_C0 * arrays["sh_dc"].astype(np.float64), 0, 1)
    linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)  # as glTF requires
    values = {
        "means": arrays["means"],
        "quats": quats / np.linalg.norm(quats, axis=1, keepdims=True),
        "scales": np.exp(np.clip(arrays["scales"].astype(np.float64), *_LOG_SCALES)),
        "opacities": opacities[:, None],
        "sh_dc": arrays["sh_dc"],
    }
    harmonics = zip(_HARMONICS, arrays["sh_rest"].swapaxes(0, 1), strict=False)
    return [
        *((_ATTRIBUTES[name][0], each.astype("<f4")) for name, each in values.items()),
        *((name, each.astype("<f4")) for name, each in harmonics),
        ("COLOR_0", np.rint(255 * np.column_stack([linear, opacities])).astype(np.uint8)),
    ]


def _document(columns: list[tuple[str, NDArray[Any]]], data_bytes: int, extras: dict[str, Any]) -> dict[str, Any]:
    """Return the glTF document of a scene whose columns follow each other in the data."""
    accessors: list[dict[str, Any]] = []
    views, offset = [], 0
    names = {components: name for name, components in _COMPONENTS.items()}
    for index, (_, column) in enumerate(columns):
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": column.nbytes, "target": _ARRAY_BUFFER})
        accessors.append(
            {"bufferView": index, "componentType": _FLOAT, "count": len(column), "type": names[column.shape[1]]}
        )
        offset += column.nbytes
    accessors[0] |= {"min": columns[0][1].min(axis=0).tolist(), "max": columns[0][1].max(axis=0).tolist()}
    accessors[-1] |= {"componentType": _BYTE, "normalized": True}
    primitive = {
        "attributes": {name: index for index, (name, _) in enumerate(columns)},
        "mode": _POINTS,
        "extensions": {_EXTENSION: _SUPPORTED},
        **({"extras": extras} if extras else {}),
    }
    return {
        "asset": {"version": "2.0", "generator": "sgsst"},
        "extensionsUsed": [_EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": data_bytes}],
    }


def _matches(start: scene_format.FileStart) -> bool:
    return start.head.startswith(_MAGIC)


GLB = scene_format.SceneFormat(
    *("glb", "GLB", 240, _matches, _read_header, _read, _write),
    media_type="model/gltf-binary",
    ranges={"scales": _LOG_SCALES},
)
