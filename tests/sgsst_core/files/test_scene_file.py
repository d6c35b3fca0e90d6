"""Tests of 3DGS PLY files: reading, compared with a second reader in this module, and writing with new f_dc."""

from __future__ import annotations

import math
import os
import struct
import tracemalloc
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files import stylized_ply
from sgsst_core.files.formats import scene_format
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.refine.split import Refinement, parents_of, piece_counts
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import held

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
    kinds |= {"scale_1": draw(st.sampled_from(list(CODES))), "rot_2": draw(st.sampled_from(["float", "char"]))}
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
    lists = [{"vertex_indices": [1, 2, 3][: draw(st.integers(0, 3))], "quality": 0.5} for _ in range(2)]
    others: list[Any] = [
        ("camera", [("int", "view"), ("double", "focal")], [{"view": 7, "focal": 0.1}] * draw(st.integers(0, 2))),
        ("face", [("list uchar int", "vertex_indices"), ("float", "quality")], lists),
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
            assert held(scene.sh_rest)[:, k, channel].tolist() == [f32(row[column]) for row in rows]

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


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("block", [1, 2, 1 << 16])
def test_only_color_bytes_change(tmp_path: Path, form: str, block: int, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (scene_format, stylized_ply):
        monkeypatch.setattr(module, "BLOCK_ROWS", block)
    file = simple(5, degree=1, form=form)
    behind = b"" if form == "ascii" else b"bytes behind the last element \xff\r\n"
    data = file.to_bytes() + behind
    source = read_scene(save(tmp_path, data))
    colors = torch.rand(5, 3)
    write_stylized(source, tmp_path / "out.ply", colors)
    for i, row in enumerate(file.elements[0][2]):
        row |= {f"f_dc_{c}": float(colors[i, c]) for c in range(3)}
    written = (tmp_path / "out.ply").read_bytes()
    if form == "ascii":
        old, new = data.split(b"\n"), written.split(b"\n")
        assert [len(line.split(b" ")) for line in new] == [len(line.split(b" ")) for line in old]
        rows = second_reader(written)[1]["vertex"]
        assert [{name: f32(value) for name, value in row.items()} for row in rows] == file.elements[0][2]
    else:
        assert written == file.to_bytes() + behind
    assert torch.equal(read_scene(tmp_path / "out.ply").scene.sh_dc, colors)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("dropped", [False, True])
def test_children_of_split_gaussians_inherit_all_properties(
    tmp_path: Path, form: str, dropped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (scene_format, stylized_ply):
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


def test_scales_stored_as_integers_cannot_be_split(tmp_path: Path) -> None:
    file = simple(2, scale_1=-3)
    properties = file.elements[0][1]
    properties[properties.index(("float", "scale_1"))] = ("char", "scale_1")
    source = read_scene(save(tmp_path, file))
    pieces = torch.tensor([[1, 1, 1], [3, 1, 1]], dtype=torch.uint8)
    with pytest.raises(SceneError, match="scale_1 are stored as integers"):
        source.refined(Refinement(pieces, 1, 4))


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
    with pytest.raises(OutputError):
        write_stylized(source, tmp_path / "missing" / "out.ply", source.scene.sh_dc)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_non_finite_values_are_counted_by_property_or_dropped(tmp_path: Path, form: str) -> None:
    file = simple(5, degree=1, form=form)
    file.elements.append(("after", [("uchar", "a")], [{"a": 3}]))
    rows = file.elements[0][2]
    rows[1] |= {"scale_1": float("inf"), "f_rest_2": float("nan")}
    rows[3] |= {"scale_1": float("-inf")}
    path = save(tmp_path, file)
    with pytest.raises(SceneError, match=r"2 of 5 .*scale_1 \(2 infinite\), f_rest_2 \(1 NaN\).*--drop-invalid"):
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
    with pytest.raises(
        SceneError, match=r"2 of 5 Gaussians have a quaternion of length 0.*first: Gaussian 2.*--drop-i"
    ):
        read_scene(path)
    file.elements[0][2][1]["x"] = float("nan")
    with pytest.raises(
        SceneError, match=r"3 of 5 Gaussians hold NaN .*x \(1 NaN\), or have .* \(2, first: Gaussian 2\)"
    ):
        read_scene(save(tmp_path, file))
    source = read_scene(path, drop_invalid=True)
    assert source.scene.means[:, 1].tolist() == [f32(0.01), f32(3.01)]
    assert bool(source.scene.quats.any(dim=1).all())


def test_double_beyond_float32_counts_as_infinite(tmp_path: Path) -> None:
    file = simple(2)
    file.elements[0][1][0] = ("double", "x")
    file.elements[0][2][0]["x"] = 1e300
    with pytest.raises(SceneError, match=r"1 of 2 .*x \(1 infinite\)"):
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
        (header("element edge 0", "property list uchar int i"), "a PLY without vertices; missing: x, y, z, rot_0"),
        (header("element vertex 0", *GAUSSIAN), "holds no Gaussians"),
        (header("element vertex 1", *GAUSSIAN, "property list uchar int tags"), "'tags' is a list"),
        (
            header("element vertex 1", *GAUSSIAN).replace(b"float f_dc_1", b"uchar f_dc_1"),
            "f_dc_1 is stored as integers",
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
            "a point cloud .*missing: rot_0, .*f_dc_2, opacity",
        ),
        (
            header("element vertex 1", "property float x", "element face 1", "property list uchar int i"),
            "a mesh .*missing: y, z, rot_0",
        ),
        (header("element vertex 1", "property uint packed_position"), "not a readable compressed PLY"),
        (
            header("element vertex 1", *(line for line in GAUSSIAN if "rot_2" not in line)),
            "something else; missing: rot_2",
        ),
    ],
)
def test_invalid_scenes_are_refused_with_the_reason(tmp_path: Path, data: bytes, message: str) -> None:
    path = save(tmp_path, data)
    with pytest.raises(SceneError, match=message) as caught:
        read_scene(path)
    assert str(path) in str(caught.value)


def test_missing_files_and_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match=r"none\.ply: cannot be read: No such file"):
        read_scene(tmp_path / "none.ply")
    with pytest.raises(SceneError, match="is a folder"):
        read_scene(tmp_path)


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("element", ["vertex", "face", "other"])
def test_header_beyond_the_file_size_never_allocates(tmp_path: Path, form: str, element: str) -> None:
    file = simple(3, form=form)
    file.elements += [
        ("face", [("list uchar int", "i")], [{"i": [1, 2]}]),
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


def test_list_beyond_the_file_size_never_allocates(tmp_path: Path) -> None:
    file = simple(1)
    file.elements.insert(0, ("face", [("list uint32 double", "i")], [{"i": [1.0]}]))
    data = file.to_bytes()
    start = data.index(b"end_header\n") + len(b"end_header\n")
    with pytest.raises(SceneError, match="ends within element 'face'"):
        read_scene(save(tmp_path, data[:start] + b"\xff\xff\xff\xff" + data[start + 4 :]))
    data = data.replace(b"list uint32", b"list int")
    start = data.index(b"end_header\n") + len(b"end_header\n")
    with pytest.raises(SceneError, match="a list of length -1"):
        read_scene(save(tmp_path, data[:start] + b"\xff\xff\xff\xff" + data[start + 4 :]))
    rows = (1 << 21) + 1
    data = data.replace(b"list int", b"list char").replace(b"element face 1", f"element face {rows}".encode())
    start = data.index(b"end_header\n") + len(b"end_header\n")
    with pytest.raises(SceneError, match="has 2,097,153 rows with lists, of at most 2,097,152"):
        read_scene(save(tmp_path, data[:start] + bytes(rows) + data[start:]))


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_every_truncation_is_detected(tmp_path: Path, form: str) -> None:
    file = simple(2, form=form)
    file.elements += [("face", [("list uchar int", "i"), ("float", "q")], [{"i": [1, 2], "q": 0.5}])]
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


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_written_scene_round_trips(tmp_path: Path, degree: int) -> None:
    generator = torch.Generator().manual_seed(1)
    shapes = {"means": (7, 3), "quats": (7, 4), "scales": (7, 3), "opacities": (7,), "sh_dc": (7, 3)}
    shapes["sh_rest"] = (7, (degree + 1) ** 2 - 1, 3)
    scene = Scene(*(torch.randn(shape, generator=generator) for shape in shapes.values()))
    write_scene(tmp_path / "new.ply", scene)
    back = read_scene(tmp_path / "new.ply").scene
    assert back.sh_degree == degree
    for name in shapes:
        assert torch.equal(getattr(back, name), getattr(scene, name))


@pytest.mark.parametrize("name", ["snowmiku_plush", "playbot_synthetic_sh2"])
def test_stylized_real_scenes_differ_only_in_colors(shared_data: Path, tmp_path: Path, name: str) -> None:
    path = shared_data / "scenes" / name / "point_cloud.ply"
    source = read_scene(path)
    colors = source.scene.sh_dc.flip(0) + 0.25
    write_stylized(source, tmp_path / "out.ply", colors)
    old, new = PlyData.read(path)["vertex"].data, PlyData.read(tmp_path / "out.ply")["vertex"].data
    assert old.dtype == new.dtype
    for column in old.dtype.names:
        if column.startswith("f_dc_"):
            assert np.array_equal(new[column], colors[:, int(column[-1])].numpy())
        else:
            assert np.array_equal(new[column], old[column])
    before, after = path.read_bytes(), (tmp_path / "out.ply").read_bytes()
    start = before.index(b"end_header\n") + len(b"end_header\n")
    assert after[:start] == before[:start]
    assert len(after) == len(before)
    # Colors by their position in the row, read without plyfile and without the project's header parser.
    names = [line.split()[-1] for line in before[:start].split(b"\n") if line.startswith(b"property")]
    row = 4 * len(names)
    for index in (0, 1, len(old) // 2, len(old) - 1):
        values = struct.unpack_from(f"<{len(names)}f", after, start + index * row)
        assert [values[names.index(f"f_dc_{c}".encode())] for c in range(3)] == colors[index].tolist()
