"""Tests of scene files: exact round trips, hostile files, SH attenuation, filtered and flat scenes, USD, colors."""

import math
import os
import re
import struct
import sys
import tracemalloc
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files import scene_file
from sgsst_core.files.formats import by_name, scene_format
from sgsst_core.files.formats.spz import SPZ
from sgsst_core.files.scene_file import (
    USD_SUFFIXES,
    apply_filter,
    check_usd,
    read_scene,
    write_colors,
    write_scene,
    write_stylized,
    write_usd,
)
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.refine import Refinement, parents_of, piece_counts
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering
from tests.sgsst_core.files.formats.samples import rewritten
from tests.sgsst_core.splat_scenes import cloud
from tests.small_scenes import cameras, wall

CODES = {"char": "b", "uchar": "B", "int16": "h", "ushort": "H", "int": "i", "uint32": "I", "float": "f", "double": "d"}
BASE = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
BASE += [f"scale_{i}" for i in range(3)] + [f"rot_{i}" for i in range(4)]
Rows = list[dict[str, Any]]


@dataclass
class File:
    """PLY file to write. Elements are tuples (name, properties, rows); properties are pairs (type, name).

    Types of list properties are written as in PLY headers, such as "list uchar int".
    """

    form: str
    elements: list[tuple[str, list[tuple[str, str]], Rows]]
    comments: list[bytes] = field(default_factory=list)
    newline: bytes = b"\n"

    def to_bytes(self) -> bytes:
        lines = [b"ply", f"format {self.form} 1.0".encode(), *self.comments]
        for name, properties, rows in self.elements:
            lines += [f"element {name} {len(rows)}".encode(), b"comment between"]
            lines += [f"property {kind} {prop}".encode() for kind, prop in properties]
        data = [line + self.newline for line in [*lines, b"end_header"]]
        for _, properties, rows in self.elements:
            data += [self._row(properties, row) for row in rows]
        return b"".join(data)

    def _row(self, properties: list[tuple[str, str]], row: dict[str, Any]) -> bytes:
        order = "<" if "little" in self.form else ">"
        tokens, data = [], b""
        for kind, name in properties:
            items = row[name] if kind.startswith("list") else [row[name]]
            if kind.startswith("list"):
                tokens.append(str(len(items)))
                data += struct.pack(order + CODES[kind.split()[1]], len(items))
            tokens += [repr(item) for item in items]
            data += struct.pack(f"{order}{len(items)}{CODES[kind.split()[-1]]}", *items)
        return "  ".join(tokens).encode() + b" " + self.newline if self.form == "ascii" else data


def second_reader(data: bytes) -> tuple[list[bytes], dict[str, Rows]]:
    """Read header lines and elements of any PLY by a simple reference implementation without plyfile or numpy."""
    newline = b"\r\n" if data.startswith(b"ply\r\n") else b"\n"
    head, _, body = data.partition(newline + b"end_header" + newline)
    lines = head.split(newline)
    form = next(line.split()[1] for line in lines if line.startswith(b"format"))
    order = {b"binary_little_endian": "<", b"binary_big_endian": ">", b"ascii": ""}[form]
    tokens, position = iter(body.split()) if not order else iter(()), 0

    def value(kind: str) -> Any:
        nonlocal position
        if not order:
            token = next(tokens)
            return float(token) if kind in "fd" else int(token)
        (item,) = struct.unpack_from(order + kind, body, position)
        position += struct.calcsize(order + kind)
        return item

    declared: list[tuple[str, int, list[list[str]]]] = []
    for words in (line.decode("latin-1").split() for line in lines):
        if words[:1] == ["element"]:
            declared.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"]:
            declared[-1][2].append(words[1:])
    elements: dict[str, Rows] = {}
    for name, count, properties in declared:
        elements[name] = []
        for _ in range(count):
            row: dict[str, Any] = {}
            for *kind, prop in properties:
                many = [value(CODES[kind[2]]) for _ in range(value(CODES[kind[1]]))] if kind[0] == "list" else None
                row[prop] = value(CODES[kind[0]]) if many is None else many
            elements[name].append(row)
    assert position == len(body) or not order
    return lines, elements


def f32(value: float) -> float:
    return struct.unpack("f", struct.pack("f", value))[0]


def simple(count: int = 3, degree: int = 0, form: str = "binary_little_endian", **changes: Any) -> File:
    """Return a plain 3DGS file with `count` Gaussians; `changes` replace the values of properties by name."""
    names = BASE + [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    rows = [{name: f32(row + 0.01 * i) for i, name in enumerate(names)} | changes for row in range(count)]
    return File(form, [("vertex", [("float", name) for name in names], rows)])


def save(folder: Path, file: File | bytes) -> Path:
    path = folder / "scene.ply"
    path.write_bytes(file if isinstance(file, bytes) else file.to_bytes())
    return path


@st.composite
def files(draw: st.DrawFn) -> File:
    """Draw a valid 3DGS PLY with random degree, format, order, types, extra properties, elements and comments."""
    form = draw(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]))
    degree = draw(st.integers(0, 3))
    names = BASE + [f"f_rest_{i}" for i in range(3 * ((degree + 1) ** 2 - 1))]
    kinds = {name: draw(st.sampled_from(["float", "double"])) for name in ("f_dc_0", "f_dc_1", "f_dc_2", "x")}
    kinds |= {"scale_1": draw(st.sampled_from(["float", "double"])), "rot_2": draw(st.sampled_from(["float", "char"]))}
    extra = draw(st.lists(st.sampled_from(["nx", "ny", "red", "label", "F_DC_0", "f_rest_extra"]), unique=True))
    kinds |= {name: draw(st.sampled_from(list(CODES))) for name in extra}
    order = draw(st.permutations(names + extra))
    ranges = {"b": (-128, 127), "B": (0, 255), "h": (-(2**15), 2**15 - 1), "H": (0, 2**16 - 1)}

    def value(kind: str) -> Any:
        if kind == "float":
            return draw(st.floats(-(2.0**99), 2.0**99, width=32))
        if kind == "double":
            return draw(st.floats(-(2.0**99), 2.0**99))
        return draw(st.integers(*ranges.get(CODES[kind], (0, 2**31 - 1))))

    seed = {name: value(kinds.get(name, "float")) for name in order} | {"rot_0": 1.0}
    fresh = ["x", "f_dc_0", "f_dc_2", *extra]
    rows = [seed | {name: value(kinds.get(name, "float")) for name in fresh} for _ in range(draw(st.integers(1, 3)))]
    vertex = ("vertex", [(kinds.get(name, "float"), name) for name in order], rows)
    others: list[Any] = [
        ("camera", [("int", "view"), ("double", "focal")], [{"view": 7, "focal": 0.1}] * draw(st.integers(0, 2))),
        ("face", [("list uchar int", "vertex_indices"), ("float", "quality")], []),
    ]
    before = draw(st.integers(0, 2))
    comments = [b"comment made by \xc3\xa9", b"obj_info a  b ", b" "][: draw(st.integers(0, 3))]
    return File(form, [*others[:before], vertex, *others[before:]], comments, draw(st.sampled_from([b"\n", b"\r\n"])))


@settings(max_examples=120, deadline=None, suppress_health_check=list(HealthCheck))
@given(files(), st.floats(-50, 50, width=32))
def test_only_colors_of_any_3dgs_ply_change(tmp_path_factory: pytest.TempPathFactory, file: File, shift: float) -> None:
    folder = tmp_path_factory.mktemp("ply")
    source = read_scene(save(folder, file))
    _, kinds, rows = next(element for element in file.elements if element[0] == "vertex")
    scene = source.scene
    groups = {"means": ["x", "y", "z"], "opacities": ["opacity"], "sh_dc": [f"f_dc_{i}" for i in range(3)]}
    groups |= {"scales": [f"scale_{i}" for i in range(3)], "quats": [f"rot_{i}" for i in range(4)]}
    for name, columns in groups.items():
        expected = torch.tensor([[row[column] for column in columns] for row in rows], dtype=torch.float64)
        assert torch.equal(getattr(scene, name).reshape(expected.shape), expected.float())
    coefficients = scene.sh_rest.shape[1]
    for channel in range(3):
        for k in range(coefficients):
            column = f"f_rest_{channel * coefficients + k}"
            assert scene.sh_rest[:, k, channel].tolist() == [f32(row[column]) for row in rows]

    colors = scene.sh_dc + torch.tensor([shift, 0.0, -shift])
    write_stylized(source, folder / "out.ply", colors)
    lines, elements = second_reader((folder / "out.ply").read_bytes())
    expected_lines, expected_elements = second_reader(file.to_bytes())
    for index, (row, old) in enumerate(zip(elements["vertex"], expected_elements["vertex"], strict=True)):
        for channel in range(3):
            new, before = row[f"f_dc_{channel}"], old[f"f_dc_{channel}"]
            assert f32(new) == colors[index, channel]
            if (("double", f"f_dc_{channel}") in kinds) and f32(before) != colors[index, channel]:
                assert new == float(colors[index, channel])  # doubles hold the color exactly, in ASCII too
            if f32(before) == colors[index, channel]:
                assert new == before  # unchanged values keep their double precision
            old[f"f_dc_{channel}"] = new
    assert lines == expected_lines
    assert elements == expected_elements


@pytest.mark.parametrize("form", ["binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("block", [1, 2, 1 << 16])
def test_only_color_bytes_change(tmp_path: Path, form: str, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (scene_format, scene_file):
        monkeypatch.setattr(module, "BLOCK_ROWS", block)
    file = simple(5, degree=1, form=form)
    behind = b"bytes behind the last element \xff\r\n"
    source = read_scene(save(tmp_path, file.to_bytes() + behind))
    colors = torch.rand(5, 3)
    write_stylized(source, tmp_path / "out.ply", colors)
    for i, row in enumerate(file.elements[0][2]):
        row |= {f"f_dc_{c}": float(colors[i, c]) for c in range(3)}
    assert (tmp_path / "out.ply").read_bytes() == file.to_bytes() + behind
    assert torch.equal(read_scene(tmp_path / "out.ply").scene.sh_dc, colors)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("dropped", [False, True])
def test_children_of_split_gaussians_inherit_all_properties(
    tmp_path: Path, form: str, dropped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (scene_format, scene_file):
        monkeypatch.setattr(module, "BLOCK_ROWS", 2)
    file = simple(5, degree=1, form=form)
    properties, rows = file.elements[0][1], file.elements[0][2]
    properties.insert(3, ("uchar", "label"))
    properties[properties.index(("float", "y"))] = ("double", "y")
    for i, row in enumerate(rows):
        row |= {"label": 40 + i, "y": row["y"] + 1e-12, "scale_0": -1.0 - i, "scale_1": -2.0, "scale_2": -3.0}
    if dropped:
        rows[1]["opacity"] = math.nan
    behind = b"" if form == "ascii" or dropped else b"behind"
    source = read_scene(save(tmp_path, file.to_bytes() + behind), drop_invalid=dropped)
    pieces = torch.ones(len(source.scene), 3, dtype=torch.uint8)
    pieces[-1], pieces[0, 1] = torch.tensor([3, 4, 1]), 5
    refinement = Refinement(pieces, 2, int(piece_counts(pieces).sum()))
    refined = source.refined(refinement)
    assert source.refined(None) is source
    with pytest.raises(SceneError, match="split already"):
        refined.refined(refinement)
    assert refined.dropped == int(dropped)
    colors = torch.rand(len(refined.scene), 3)
    write_stylized(refined, tmp_path / "out.ply", colors)
    written = (tmp_path / "out.ply").read_bytes()
    assert written.endswith(behind)
    loaded = read_scene(tmp_path / "out.ply").scene
    for name in ("means", "quats", "scales", "opacities", "sh_rest"):
        assert torch.equal(getattr(loaded, name), getattr(refined.scene, name)), name
    assert torch.equal(loaded.sh_dc, colors)
    remaining = [row for i, row in enumerate(rows) if not (dropped and i == 1)]
    parents = [remaining[parent] for parent in parents_of(pieces).tolist()]
    for row, parent in zip(second_reader(written.removesuffix(behind))[1]["vertex"], parents, strict=True):
        assert row["label"] == parent["label"]
        if parent not in (remaining[0], remaining[-1]):
            assert row["y"] == parent["y"], "what is not cut keeps its double precision"


def test_unchanged_colors_write_the_same_bytes(tmp_path: Path) -> None:
    text = simple(form="ascii").to_bytes().replace(b"  ", b"\t ").replace(b"0.03", b"+.30e-1")
    source = read_scene(save(tmp_path, text))
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc)
    assert (tmp_path / "out.ply").read_bytes() == text


def test_source_can_be_overwritten(tmp_path: Path) -> None:
    source = read_scene(save(tmp_path, simple()))
    write_stylized(source, source.path, torch.zeros(3, 3))
    assert not read_scene(source.path).scene.sh_dc.any()
    assert os.listdir(tmp_path) == ["scene.ply"]


def test_source_changed_since_reading_is_refused(tmp_path: Path) -> None:
    source = read_scene(save(tmp_path, simple()))
    save(tmp_path, simple(4))
    with pytest.raises(SceneError, match="was changed after it was read"):
        write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc)
    assert os.listdir(tmp_path) == ["scene.ply"]


def test_invalid_colors_are_refused(tmp_path: Path) -> None:
    source = read_scene(save(tmp_path, simple()))
    for wrong in (torch.zeros(2, 3), torch.full((3, 3), torch.nan)):
        with pytest.raises(ValueError, match="sh_dc must be finite"):
            write_stylized(source, tmp_path / "out.ply", wrong)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_non_finite_values_are_counted_by_property_or_dropped(tmp_path: Path, form: str) -> None:
    file = simple(5, degree=1, form=form)
    file.elements.append(("after", [("uchar", "a")], [{"a": 3}]))
    rows = file.elements[0][2]
    rows[1] |= {"scale_1": float("inf"), "f_rest_2": float("nan")}
    rows[3] |= {"scale_1": float("-inf")}
    path = save(tmp_path, file)
    with pytest.raises(SceneError, match=r"2 of 5 .*scale_1, f_rest_2.*--drop-invalid"):
        read_scene(path)
    source = read_scene(path, drop_invalid=True)
    assert (len(source.scene), source.dropped) == (3, 2)
    colors = torch.tensor([[9.0] * 3, [8.0] * 3, [7.0] * 3])
    write_stylized(source, tmp_path / "out.ply", colors)
    lines, elements = second_reader((tmp_path / "out.ply").read_bytes())
    left = [rows[i] | {f"f_dc_{c}": value for c in range(3)} for i, value in ((0, 9.0), (2, 8.0), (4, 7.0))]
    assert elements == {"vertex": left, "after": [{"a": 3}]}
    assert lines == [line.replace(b"vertex 5", b"vertex 3") for line in second_reader(path.read_bytes())[0]]


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_infinite_opacities_are_clamped_and_preserved_in_the_file(tmp_path: Path, form: str) -> None:
    file = simple(5, form=form)
    file.elements[0][2][1]["opacity"], file.elements[0][2][3]["opacity"] = float("inf"), float("-inf")
    source = read_scene(save(tmp_path, file))
    assert (source.dropped, source.clamped) == (0, 2)
    expected = torch.tensor([0.25 / 255, 1 - 0.25 / 255])
    torch.testing.assert_close(source.scene.opacities[[3, 1]].sigmoid(), expected, rtol=1e-5, atol=0)
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc)
    rows = second_reader((tmp_path / "out.ply").read_bytes())[1]["vertex"]
    assert [rows[1]["opacity"], rows[3]["opacity"]] == [float("inf"), float("-inf")]


def test_scene_without_finite_gaussians_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="No valid Gaussians remain"):
        read_scene(save(tmp_path, simple(x=float("nan"))), drop_invalid=True)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_zero_quaternions_are_refused_by_row_or_dropped(tmp_path: Path, form: str) -> None:
    file = simple(5, form=form)
    rotation = [f"rot_{i}" for i in range(4)]
    file.elements[0][1][:] = [("double" if name in rotation else kind, name) for kind, name in file.elements[0][1]]
    file.elements[0][2][2] |= dict.fromkeys(rotation, 0.0)
    file.elements[0][2][4] |= dict.fromkeys(rotation, 1e-60)  # nothing in float32
    path = save(tmp_path, file)
    with pytest.raises(SceneError, match=r"2 of 5 Gaussians .*no rotation: quaternions of length 0.*--drop-i"):
        read_scene(path)
    file.elements[0][2][1]["x"] = float("nan")
    with pytest.raises(SceneError, match=r"3 of 5 Gaussians hold NaN .*: x, quaternions of length 0"):
        read_scene(save(tmp_path, file))
    source = read_scene(path, drop_invalid=True)
    assert source.scene.means[:, 1].tolist() == [f32(0.01), f32(3.01)]
    assert bool(source.scene.quats.any(dim=1).all())


def test_double_beyond_float32_counts_as_infinite(tmp_path: Path) -> None:
    file = simple(2)
    file.elements[0][1][0] = ("double", "x")
    file.elements[0][2][0]["x"] = 1e300
    with pytest.raises(SceneError, match=r"1 of 2 .*: x\."):
        read_scene(save(tmp_path, file))


def test_non_finite_values_in_extra_properties_are_ignored(tmp_path: Path) -> None:
    file = simple(2)
    file.elements[0][1].append(("float", "nx"))
    for row in file.elements[0][2]:
        row["nx"] = float("nan")
    assert len(read_scene(save(tmp_path, file)).scene) == 2


def header(*lines: str) -> bytes:
    return "\n".join(["ply", "format binary_little_endian 1.0", *lines, "end_header", ""]).encode()


GAUSSIAN = [f"property float {name}" for name in BASE]


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "is empty"),
        (b"\x89PNG\r\n", "expected PLY, compressed PLY"),
        (b"plywood", "no PLY header"),
        (b"ply\nformat ascii 1.0\nelement vertex 3\n", "no 'end_header'"),
        (b"ply\nelement vertex 3\nend_header\n", "line 2 .*element vertex 3"),
        (b"ply\nend_header\n", "no 'format' line"),
        (b"ply\nformat binary_pdp_endian 1.0\nend_header\n", "line 2 "),
        (header("element vertex -1"), "line 3 .*vertex -1"),
        (header("element vertex 1_0"), "line 3 "),
        (header("element vertex " + "9" * 5000), "line 3 "),
        (header("property float x"), "line 3 "),
        (header("element vertex 1", "property half x"), "line 4 .*half x"),
        (header("element vertex 1", "property list float int x"), "line 4 "),
        (header("element vertex 1", "property float x", "property double x"), r"vertex\.x twice"),
        (header("element a 1", "property int b", "element a 1", "property int b"), "'a' twice"),
        (header("element a 1000000000000000"), "'a' of the PLY header has no property"),
        (header("element edge 0", "property list uchar int i"), "not a 3DGS scene; missing: x, y, z, rot_0"),
        (header("element vertex 0", *GAUSSIAN), "holds no Gaussians"),
        (
            header("element vertex 1", *GAUSSIAN, "property list uchar int tags"),
            "element 'vertex' holds lists .tags., which 3DGS",
        ),
        (
            header("element vertex 1", *GAUSSIAN).replace(b"float f_dc_1", b"uchar f_dc_1"),
            "stores f_dc_1 as integers",
        ),
        (
            header("element vertex 1", *GAUSSIAN, *(f"property float f_rest_{i}" for i in range(12))),
            "12 f_rest .*0, 9, 24",
        ),
        (
            header("element vertex 1", *GAUSSIAN, *(f"property float f_rest_{i}" for i in range(1, 10))),
            "missing: f_rest_0",
        ),
        (
            header("element vertex 1", "property float x", "property float y", "property float z"),
            "missing: rot_0, .*f_dc_2, opacity. .* a point cloud, train",
        ),
        (
            header("element vertex 1", "property float x", "element face 1", "property list uchar int i"),
            "missing: y, z, rot_0",
        ),
        (header("element vertex 1", *GAUSSIAN).replace(b"float scale_1", b"int scale_1"), "stores scale_1 as integers"),
        (header("element vertex 1", "property uint packed_position"), "a compressed PLY without element 'chunk'"),
        (
            header("element vertex 1", *(line for line in GAUSSIAN if "rot_2" not in line)),
            "missing: rot_2",
        ),
    ],
)
def test_invalid_scenes_are_refused_with_the_reason(tmp_path: Path, data: bytes, message: str) -> None:
    path = save(tmp_path, data)
    with pytest.raises(SceneError, match=message) as caught:
        read_scene(path)
    assert str(path) in str(caught.value)


def test_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"none\.ply: cannot be read: No such file"):
        read_scene(tmp_path / "none.ply")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("element", ["vertex", "edge", "other"])
def test_header_beyond_the_file_size_never_allocates(tmp_path: Path, form: str, element: str) -> None:
    file = simple(3, form=form)
    file.elements += [
        ("edge", [("int", "i")], [{"i": 1}]),
        ("other", [("double", "a")], [{"a": 1.0}]),
    ]
    count = 3 if element == "vertex" else 1
    data = file.to_bytes().replace(f"element {element} {count}".encode(), f"element {element} {10**12}".encode())
    path = save(tmp_path, data)
    tracemalloc.start()
    with pytest.raises(SceneError, match="truncated or its header is wrong"):
        read_scene(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 << 20


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("before", [False, True])
def test_lists_are_refused_unless_they_have_no_rows(tmp_path: Path, form: str, before: bool) -> None:
    file = simple(1, form=form)
    rows: Rows = [{"i": [1, 2]}]
    file.elements.insert(0 if before else 1, ("face", [("list uchar int", "i")], rows))
    with pytest.raises(SceneError, match=r"element 'face' holds lists \(i\), which 3DGS scenes do not have"):
        read_scene(save(tmp_path, file))
    rows.clear()
    assert len(read_scene(save(tmp_path, file)).scene) == 1


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_every_truncation_is_detected(tmp_path: Path, form: str) -> None:
    file = simple(2, form=form)
    file.elements += [("other", [("int", "i"), ("float", "q")], [{"i": 7, "q": 0.5}])]
    data = file.to_bytes()
    # ASCII may lose its final space and newline, and a truncated last number is still a number.
    for stop in range(len(data) - (5 if form == "ascii" else 1)):
        with pytest.raises(SceneError):
            read_scene(save(tmp_path, data[:stop]))


@pytest.mark.parametrize(
    ("old", "new"), [(b"0.03", b"wrong"), (b"0.03", b"0.03 1.5"), (b"0.03", b"\xff"), (b"0.03", b"1_0")]
)
def test_non_numeric_text_is_refused(tmp_path: Path, old: bytes, new: bytes) -> None:
    with pytest.raises(SceneError, match="cannot be read as PLY"):
        read_scene(save(tmp_path, simple(form="ascii").to_bytes().replace(old, new)))


ATTENUATIONS = (1e-9, 0.25, 0.7, 1.0)


@pytest.fixture
def small_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (scene_format, scene_file):
        monkeypatch.setattr(module, "BLOCK_ROWS", 17)


def written(folder: Path, degree: int = 3) -> Path:
    write_scene(folder / "scene.ply", cloud(60, degree=degree))
    return folder / "scene.ply"


def in_another_encoding(path: Path, form: str) -> Path:
    """Write the same scene as text, as big-endian, with doubles, or with another property between the coefficients."""
    double = "f_rest" if form == "doubles" else "nothing"
    extra = {"extra": 0} if form == "mixed up" else {}
    return rewritten(path, "other.ply", lambda name: "<f8" if double in name else "<f4", form=form, **extra)


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize("form", ["plain", "text", "big", "doubles", "mixed up"])
@pytest.mark.parametrize("attenuation", ATTENUATIONS)
def test_file_contains_the_attenuated_coefficients(tmp_path: Path, form: str, attenuation: float) -> None:
    path = written(tmp_path)
    if form != "plain":
        path = in_another_encoding(path, form)
    source = read_scene(path)
    wanted = source.scene.attenuated(attenuation)
    colors = source.scene.sh_dc + 1
    write_stylized(source, tmp_path / "out.ply", colors, sh_attenuation=attenuation)
    loaded = read_scene(tmp_path / "out.ply").scene
    rest = torch.zeros_like(loaded.sh_rest) if attenuation == 1 else wanted.sh_rest
    assert torch.equal(loaded.sh_rest, rest)
    if attenuation == 1:
        assert wanted.sh_degree == 0
        assert not torch.signbit(loaded.sh_rest).any()
    assert torch.equal(loaded.sh_dc, colors)
    for name in ("means", "quats", "scales", "opacities"):
        assert torch.equal(getattr(loaded, name), getattr(source.scene, name))
    before, after = (PlyData.read(each)["vertex"].data for each in (path, tmp_path / "out.ply"))
    assert before.dtype == after.dtype
    for name in set(before.dtype.names) - {"f_dc_0", "f_dc_1", "f_dc_2"}:
        if "rest" not in name:
            assert np.array_equal(before[name], after[name])


@pytest.mark.usefixtures("small_blocks")
@pytest.mark.parametrize(("degree", "attenuation"), [(3, 0.0), (3, 1e-9), (0, 0.5)])
def test_file_is_bit_identical_without_attenuation(tmp_path: Path, degree: int, attenuation: float) -> None:
    source = read_scene(written(tmp_path, degree))
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc, sh_attenuation=attenuation)
    assert (tmp_path / "out.ply").read_bytes() == source.path.read_bytes()
    assert attenuation == 1e-9 or source.scene.attenuated(attenuation) is source.scene


@pytest.mark.usefixtures("small_blocks")
def test_compressed_scenes_are_attenuated_in_their_ply(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene.spz", cloud(60, degree=1), SPZ)
    source = read_scene(tmp_path / "scene.spz")
    write_stylized(source, tmp_path / "out.ply", source.scene.sh_dc, sh_attenuation=0.25)
    assert torch.equal(read_scene(tmp_path / "out.ply").scene.sh_rest, source.scene.sh_rest * 0.75)


def with_filter(path: Path, scene: Scene, deviations: torch.Tensor, *, text: bool = False) -> Path:
    """Write a PLY with the property filter_3D."""
    write_scene(path, scene)
    return rewritten(path, path.name, lambda _: "<f4", form="text" if text else "little", filter_3D=deviations.numpy())


def without_thickness(path: Path, scene: Scene) -> Path:
    """Write a PLY without the property scale_2."""
    write_scene(path, scene)
    return rewritten(path, path.name, lambda name: None if name == "scale_2" else "<f4")


def deviations_of(scene: Scene) -> torch.Tensor:
    return torch.linspace(0, 0.1, len(scene))


@pytest.mark.parametrize("text", [False, True])
def test_filter_is_applied_and_preserved(tmp_path: Path, text: bool) -> None:
    scene = wall(sh_degree=1)
    path, out = with_filter(tmp_path / "scene.ply", scene, deviations_of(scene), text=text), tmp_path / "out.ply"
    file = read_scene(path)
    variances, added = scene.scales.double().exp().square(), deviations_of(scene).double().square()[:, None]
    opacities = scene.opacities.double().sigmoid() * (variances / (variances + added)).prod(dim=1).sqrt()
    assert torch.allclose(file.scene.scales.double().exp().square(), variances + added, rtol=1e-5)
    assert torch.allclose(file.scene.opacities.double().sigmoid(), opacities, rtol=1e-5)
    assert file.scene.opacities[0] == scene.opacities[0]
    assert file.scene.rendering == file.tag.rendering == Rendering("antialiased", 0.1)
    assert "filter_3D" in file.tag.reason
    write_stylized(file, out, torch.zeros_like(file.scene.sh_dc))
    before, after = (PlyData.read(each)["vertex"].data for each in (path, out))
    assert (after["f_dc_0"] == 0).all()
    for name in set(before.dtype.names) - {"f_dc_0", "f_dc_1", "f_dc_2"}:
        assert np.array_equal(before[name], after[name]), name


def test_comment_outweighs_the_property(tmp_path: Path) -> None:
    path = with_filter(tmp_path / "scene.ply", wall(), deviations_of(wall()))
    path.write_bytes(path.read_bytes().replace(b"element vertex", b"comment SplatRenderMode: default\nelement vertex"))
    file = read_scene(path)
    assert file.scene.rendering == CLASSIC
    assert not torch.equal(file.scene.scales, wall().scales)


@pytest.mark.parametrize("text", [False, True])
def test_split_gaussians_have_no_filter(tmp_path: Path, text: bool) -> None:
    scene, out = wall(), tmp_path / "out.ply"
    file = read_scene(with_filter(tmp_path / "scene.ply", scene, deviations_of(scene), text=text))
    pieces = torch.ones(len(scene), 3, dtype=torch.uint8)
    pieces[::2, 0] = 3
    refined = file.refined(Refinement(pieces, len(scene) // 2, 2 * len(scene)))
    write_stylized(refined, out, refined.scene.sh_dc)
    again, view = read_scene(out).scene, cameras()[1]
    assert not PlyData.read(out)["vertex"].data["filter_3D"].any()
    assert again.rendering == file.scene.rendering
    first, second = (make_rasterizer("cpu", each).coverage(view) for each in (refined.scene, again))
    assert torch.allclose(first, second, atol=1e-6)


def test_filters_of_any_size_are_exact() -> None:
    scales = np.array([[-80.0, -80, -80], [80, 80, 80], [0, 0, 0], [0, 0, 0], [-5, 0, 5]], np.float32)
    logits = np.array([np.inf, 90, -90, 3, 3], np.float32)
    filters = np.array([1e-30, 1e-30, 1.0, 0.0, -1.0])
    filtered, opacities = scales.copy(), logits.copy()
    apply_filter(filtered, opacities, filters)
    assert filtered[0] == pytest.approx(np.log(1e-30), rel=1e-6)
    assert np.array_equal(filtered[[1, 3]], scales[[1, 3]])
    assert opacities[[1, 3]].tolist() == [90, 3]
    assert opacities[0] == pytest.approx(3 * (-80 - np.log(1e-30)), rel=1e-5)  # a logit of -33 is the logarithm
    assert opacities[2] == pytest.approx(-90 - 1.5 * np.log(2), rel=1e-6)
    assert filtered[4] == pytest.approx(np.log(np.exp(2 * scales[4].astype(np.float64)) + 1) / 2, rel=1e-6)


def test_invalid_filters_are_reported(tmp_path: Path) -> None:
    filters = deviations_of(wall())
    filters[7] = torch.nan
    path = with_filter(tmp_path / "scene.ply", wall(), filters)
    with pytest.raises(SceneError, match=re.escape("1 of 616 Gaussians hold NaN")):
        read_scene(path)
    assert read_scene(path, drop_invalid=True).dropped == 1


def test_flat_scene_is_rendered_without_thickness_and_preserved(tmp_path: Path) -> None:
    scene, out = wall(sh_degree=1), tmp_path / "out.ply"
    path = without_thickness(tmp_path / "scene.ply", scene)
    file = read_scene(path)
    assert file.scene.rendering == Rendering("2dgs")
    assert torch.equal(file.scene.scales[:, :2], scene.scales[:, :2])
    assert "thickness" in file.tag.warnings[0][0]
    thin = replace(scene, scales=scene.scales - torch.tensor([0.0, 0.0, 60.0]))
    for view in cameras():
        first, second = (make_rasterizer("cpu", each).coverage(view) for each in (file.scene, thin))
        assert torch.equal(first, second)
    write_stylized(file, out, torch.zeros_like(scene.sh_dc))
    names = PlyData.read(out)["vertex"].data.dtype.names
    assert "scale_2" not in names
    assert read_scene(out).scene.rendering == Rendering("2dgs")


@pytest.mark.parametrize("name", ["spz", "sog", "glb", "compressed.ply", "ply"])
def test_flat_scene_is_written_in_every_format(tmp_path: Path, name: str) -> None:
    file = read_scene(without_thickness(tmp_path / "scene.ply", wall()))
    write_scene(tmp_path / "out", file.scene, by_name(name))
    again, view = read_scene(tmp_path / "out").scene, cameras()[1]
    first, second = (make_rasterizer("cpu", each).coverage(view) for each in (file.scene, again))
    assert torch.allclose(first, second, atol=0.02)


def test_flat_gaussians_can_be_split(tmp_path: Path) -> None:
    file, out = read_scene(without_thickness(tmp_path / "scene.ply", wall())), tmp_path / "out.ply"
    pieces = torch.ones(616, 3, dtype=torch.uint8)
    pieces[:, :2] = 3
    refined = file.refined(Refinement(pieces, 616, 9 * 616))
    write_stylized(refined, out, refined.scene.sh_dc)
    assert torch.equal(read_scene(out).scene.scales, refined.scene.scales)


pxr = pytest.importorskip("pxr", reason="usd-core is not installed")


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("suffix", USD_SUFFIXES)
def test_written_values_match_the_scene(tmp_path: Path, suffix: str, degree: int) -> None:
    """Values are linear, axes have y up, and coefficients follow each other by Gaussian."""
    from pxr import Usd, UsdGeom, UsdVol

    scene, path = cloud(300, degree=degree), tmp_path / f"scene{suffix}"
    write_usd(path, scene)
    stage = Usd.Stage.Open(str(path))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1)
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert splats

    def values(name: str) -> np.ndarray:
        return np.array(stage.GetDefaultPrim().GetAttribute(name).Get())

    flip = np.array([-1, -1, 1])
    np.testing.assert_array_equal(values("positions"), scene.means.numpy() * flip)
    np.testing.assert_allclose(values("scales"), scene.scales.double().exp(), rtol=1e-6)
    np.testing.assert_allclose(values("opacities"), scene.opacities.double().sigmoid(), rtol=1e-6)
    assert int(values("radiance:sphericalHarmonicsDegree")) == degree
    harmonics = values("radiance:sphericalHarmonicsCoefficients").reshape(300, -1, 3)
    assert harmonics.shape == (300, (degree + 1) ** 2, 3)
    np.testing.assert_array_equal(harmonics[:, 0], scene.sh_dc.numpy())
    signs = np.array([-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])[: harmonics.shape[1] - 1, None]
    np.testing.assert_array_equal(harmonics[:, 1:], scene.sh_rest.numpy() * signs)
    quats = scene.quats.double().numpy()
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    for index, actual in enumerate(splats.GetOrientationsAttr().Get()):
        expected = (-z[index], -y[index], x[index], w[index])  # a rotation by 180 degrees about z comes first
        assert (actual.GetReal(), *actual.GetImaginary()) == pytest.approx(expected, abs=1e-6)
    low, high = splats.GetExtentAttr().Get()
    assert bool((np.array(low) < values("positions")).all() and (np.array(high) > values("positions")).all())


def test_missing_extra_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [*sys.modules]:
        if name.partition(".")[0] == "pxr":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "path", [])
    with pytest.raises(OutputError, match=r"pip install 'sgsst-service\[usd\]'"):
        check_usd(Path("scene.usdc"))


def test_colors_round_trip_within_the_error_bound(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scene_format, "BLOCK_ROWS", 100)
    generator = torch.Generator().manual_seed(1)
    size = torch.rand(1003, 3, generator=generator) * 14 - 9  # from 1e-9 to 1e5
    sh_dc = torch.randn(1003, 3, generator=generator).sign() * 10.0**size
    sh_dc[0] = torch.tensor([1e30, -65520.0, 65519.0])
    path = tmp_path / "stylized_ply.f16"
    write_colors(path, sh_dc)
    assert path.stat().st_size == 6 * 1003
    actual = np.fromfile(path, "<f2").reshape(-1, 3).astype(np.float64)
    exact = sh_dc.double().clamp(-65504, 65504).numpy()
    assert (np.abs(actual - exact) <= np.maximum(2.0**-11 * np.abs(exact), 2.0**-25)).all()
    assert actual[0].tolist() == [65504, -65504, 65504]
