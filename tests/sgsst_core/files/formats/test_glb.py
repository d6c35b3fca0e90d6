"""Tests of GLB: values computed by hand, transformations of nodes, integers, and false files."""

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.glb import GLB
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.scene.spherical_harmonics import rest_colors
from tests.sgsst_core.files.formats.samples import assert_close, check_documents, encoded, refused
from tests.sgsst_core.splat_scenes import camera, cloud

PREFIX = "KHR_gaussian_splatting:"


def split(data: bytes) -> tuple[dict[str, Any], bytes]:
    """Return the document and the data of a GLB."""
    size = struct.unpack_from("<I", data, 12)[0]
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def joined(document: dict[str, Any], data: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 28 + len(text) + len(data), len(text), 0x4E4F534A)
    return head + text + struct.pack("<I4s", len(data), b"BIN\0") + data


def by_hand(**changes: Any) -> bytes:
    """Return a GLB of two Gaussians, with integers where they are allowed, in interleaved rows of 48 bytes."""
    rows = [
        struct.pack("<3f4bbxxx3fHxx3f", *position, *quat, 0, *scale, opacity, *color)
        for position, quat, scale, opacity, color in (
            ((1, 2, 3), (0, 0, 0, 127), (1, 2, 4), 65535 // 2, (0.5, -0.5, 1)),
            ((-1, 0, 5), (127, 0, 0, 0), (0.5, 0.5, 0.5), 13107, (0, 0, 2)),
        )
    ]
    layout = {
        "POSITION": (0, 5126, "VEC3", False),
        PREFIX + "ROTATION": (12, 5120, "VEC4", True),
        PREFIX + "SCALE": (20, 5126, "VEC3", False),
        PREFIX + "OPACITY": (32, 5123, "SCALAR", True),
        PREFIX + "SH_DEGREE_0_COEF_0": (36, 5126, "VEC3", False),
    }
    document: dict[str, Any] = {
        "asset": {"version": "2.0"},
        "extensionsUsed": ["KHR_gaussian_splatting"],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {
                "primitives": [
                    {
                        "attributes": {name: index for index, name in enumerate(layout)},
                        "mode": 0,
                        "extensions": {
                            "KHR_gaussian_splatting": {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
                        },
                    }
                ]
            }
        ],
        "accessors": [
            {"bufferView": 0, "byteOffset": at, "componentType": kind, "type": name, "normalized": normal, "count": 2}
            for at, kind, name, normal in layout.values()
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": 4, "byteLength": 96, "byteStride": 48}],
        "buffers": [{"byteLength": 100}],
    }
    for path, value in changes.items():
        *folders, last = path.split("__")
        target: Any = document
        for name in folders:
            target = target[int(name) if isinstance(target, list) else name]
        target[int(last) if isinstance(target, list) else last] = value
    return joined(document, bytes(4) + b"".join(rows))


def read(tmp_path: Path, data: bytes) -> Any:
    (tmp_path / "scene").write_bytes(data)
    return read_scene(tmp_path / "scene").scene


def test_values_match_those_computed_by_hand(tmp_path: Path) -> None:
    scene = read(tmp_path, by_hand())
    assert scene.means.tolist() == [[-1, -2, 3], [1, 0, 5]]
    half = 32767 / 65535
    torch.testing.assert_close(scene.opacities, torch.tensor([half, 0.2]).logit())
    torch.testing.assert_close(scene.scales.exp(), torch.tensor([[1.0, 2, 4], [0.5, 0.5, 0.5]]))
    assert scene.sh_dc.tolist() == [[0.5, -0.5, 1], [0, 0, 2]]
    # rotations by 180 degrees about z and, for the second Gaussian, about x before it, which is one about y
    assert scene.quats.abs().tolist() == [[0, 0, 0, 1], [0, 0, 1, 0]]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_written_values_round_trip(tmp_path: Path, degree: int) -> None:
    scene = cloud(500, degree=degree)
    write_scene(tmp_path / "scene.glb", scene, GLB)
    loaded = read_scene(tmp_path / "scene.glb").scene
    assert_close(loaded, scene, opacities=1e-6)
    for name in ("means", "sh_dc", "sh_rest"):
        assert torch.equal(getattr(loaded, name), getattr(scene, name)), name
    torch.testing.assert_close(loaded.opacities, scene.opacities, rtol=1e-5, atol=1e-2)


def test_document_follows_the_specification(tmp_path: Path) -> None:
    document, data = split(encoded(tmp_path, GLB, degree=1))
    primitive = document["meshes"][0]["primitives"][0]
    assert document["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
    }
    names = {"SCALE", "ROTATION", "OPACITY", "SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{i}" for i in range(3))}
    assert set(primitive["attributes"]) == {"POSITION", "COLOR_0", *(PREFIX + name for name in names)}
    assert document["buffers"] == [{"byteLength": len(data)}]
    for name, index in primitive["attributes"].items():
        entry = document["accessors"][index]
        view = document["bufferViews"][entry["bufferView"]]
        if "SCALE" in name or "OPACITY" in name:
            values = np.frombuffer(data, "<f4", view["byteLength"] // 4, view["byteOffset"])
            assert values.min() > 0
        if "OPACITY" in name:
            assert values.max() < 1
        if "ROTATION" in name:
            values = np.frombuffer(data, "<f4", view["byteLength"] // 4, view["byteOffset"]).reshape(-1, 4)
            np.testing.assert_allclose(np.linalg.norm(values, axis=1), 1, rtol=1e-6)
        assert view["byteOffset"] % 4 == 0


def test_extreme_sizes_and_opacities_are_written_finite(tmp_path: Path) -> None:
    scene = cloud(40)
    scene.scales[:20], scene.scales[20:] = -200, 200
    scene.opacities[:20], scene.opacities[20:] = -1000, 1000
    write_scene(tmp_path / "scene.glb", scene, GLB)
    loaded = read_scene(tmp_path / "scene.glb")
    assert not loaded.clamped
    assert loaded.scene.scales.abs().amin() > 86
    assert loaded.scene.opacities.abs().amin() > 16


def test_node_transformations_are_applied(tmp_path: Path) -> None:
    """A node is rotated by 90 degrees about x, with a parent that scales and translates, in both notations."""
    turn = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    parent = {"children": [1], "scale": [2, 2, 2], "translation": [10, 0, 0]}
    whole = [2, 0, 0, 0, 0, 0, 2, 0, 0, -2, 0, 0, 10, 0, 0, 1]
    for nodes in ([parent, {"mesh": 0, "rotation": turn}], [{"mesh": 0, "matrix": whole}]):
        scene = read(tmp_path, by_hand(nodes=nodes))
        # (1, 2, 3) becomes (1, -3, 2), (12, -6, 4), and (-12, 6, 4) in the axes of a PLY
        torch.testing.assert_close(scene.means[0], torch.tensor([-12.0, 6, 4]))
        torch.testing.assert_close(scene.scales[0].exp(), torch.tensor([2.0, 4, 8]))


def test_all_sets_of_gaussians_become_one_scene(tmp_path: Path) -> None:
    """Two primitives of a mesh, another mesh with harmonics that two nodes show, and a mesh that no node shows."""
    document, data = split(by_hand())
    (primitive,) = document["meshes"][0]["primitives"]
    colors = primitive["attributes"][PREFIX + "SH_DEGREE_0_COEF_0"]
    harmonics = {f"{PREFIX}SH_DEGREE_1_COEF_{index}": colors for index in range(3)}
    second = primitive | {"attributes": primitive["attributes"] | harmonics}
    points = {"attributes": {"POSITION": 0}, "mode": 0}
    document["meshes"] = [{"primitives": [primitive, points, primitive]}, {"primitives": [second]}]
    document["meshes"].append({"primitives": [primitive] * 3})
    document["nodes"] = [
        {"mesh": 0, "translation": [0, 10, 0]},
        {"children": [2, 3], "scale": [2, 2, 2]},
        {"mesh": 1},
        {"mesh": 1, "translation": [1, 0, 0]},
    ]
    path = tmp_path / "scene.glb"
    path.write_bytes(joined(document, data + bytes(60)))
    file = read_scene(path)
    assert len(file.scene) == read_scene_header(path).count == 8
    assert file.notes == ("3 sets of Gaussians that no node shows are left out",)
    y_up = torch.tensor([[1.0, 12, 3], [-1, 10, 5]] * 2 + [[2, 4, 6], [-2, 0, 10], [4, 4, 6], [0, 0, 10]])
    torch.testing.assert_close(file.scene.means, y_up * torch.tensor([-1.0, -1, 1]))
    torch.testing.assert_close(file.scene.scales[:, 0].exp(), torch.tensor([1, 0.5, 1, 0.5, 2, 1, 2, 1]))
    assert file.scene.sh_degree == 1
    rest = file.scene.sh_rest
    assert not rest[:4].any()
    assert rest[4:].abs().sum() == 2 * 3 * (0.5 + 0.5 + 1 + 2)


@pytest.mark.parametrize(
    "name",
    ["KHR_materials_unlit", "EXT_texture_webp", "KHR_lights_punctual", "KHR_xmp_json_ld", "EXT_structural_metadata"],
)
def test_required_extensions_of_other_objects_are_harmless(tmp_path: Path, name: str) -> None:
    required = ["KHR_gaussian_splatting", name]
    assert len(read(tmp_path, by_hand(extensionsRequired=required))) == 2


def test_animations_are_noted(tmp_path: Path) -> None:
    (tmp_path / "scene.glb").write_bytes(by_hand(animations=[{"channels": [], "samplers": []}]))
    assert read_scene(tmp_path / "scene.glb").notes == ("animations are left out",)


def test_infinite_opacities_are_clamped(tmp_path: Path) -> None:
    document, data = split(by_hand())
    rows = bytearray(data)
    rows[4 + 32 : 4 + 34] = b"\xff\xff"
    (tmp_path / "scene").write_bytes(joined(document, bytes(rows)))
    file = read_scene(tmp_path / "scene")
    assert file.clamped == 1
    assert bool(torch.isfinite(file.scene.opacities).all())


def test_colors_for_other_programs_are_linear(tmp_path: Path) -> None:
    scene = cloud(500)
    write_scene(tmp_path / "scene.glb", scene, GLB)
    document, data = split((tmp_path / "scene.glb").read_bytes())
    entry = document["accessors"][document["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"]]
    view = document["bufferViews"][entry["bufferView"]]
    stored = np.frombuffer(data, np.uint8, view["byteLength"], view["byteOffset"]).reshape(-1, 4) / 255
    srgb = np.where(stored <= 0.0031308, 12.92 * stored, 1.055 * stored ** (1 / 2.4) - 0.055)[:, :3]
    expected = np.clip(0.5 + 0.28209479 * scene.sh_dc.numpy(), 0, 1)
    assert np.abs(srgb - expected).max() < 0.026  # half a step of 8 bits, in the dark
    assert np.abs(srgb - expected)[expected > 0.5].max() < 0.003
    np.testing.assert_allclose(stored[:, 3], scene.opacities.sigmoid().numpy(), atol=0.5 / 255 + 1e-6)


def test_linear_colors_become_srgb(tmp_path: Path) -> None:
    """Those of a Gaussian in any direction, as far as they are close to its color of degree 0."""
    scene = cloud(500, degree=1)
    scene = replace(scene, sh_dc=scene.sh_dc.clamp(-1.5, 3), sh_rest=scene.sh_rest * 1e-3)
    write_scene(tmp_path / "linear.glb", scene, GLB)
    document, data = split((tmp_path / "linear.glb").read_bytes())
    document["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"] |= {
        "colorSpace": "lin_rec709_display",
    }
    (tmp_path / "linear.glb").write_bytes(joined(document, data))
    file = read_scene(tmp_path / "linear.glb")
    assert [note.partition(",")[0] for note in file.notes] == [
        "colors are linear",
    ]
    view = camera()
    linear, srgb = (
        0.5 + 0.28209479 * each.sh_dc.double() + rest_colors(each.sh_rest, each.means, view)
        for each in (scene, file.scene)
    )
    expected = torch.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear.clamp_min(1e-9) ** (1 / 2.4) - 0.055)
    torch.testing.assert_close(srgb, expected, rtol=0, atol=2e-3)


def test_checks_read_only_the_header(tmp_path: Path) -> None:
    document, data = split(encoded(tmp_path, GLB))
    (tmp_path / "scene").write_bytes(joined(document, bytes(len(data))))
    assert read_scene_header(tmp_path / "scene").count == 616


MESH = {"meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}]}
FIRST = "meshes__0__primitives__0__"


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (joined(MESH, b""), "holds 1 meshes but no Gaussians"),
        (joined({}, b""), "holds 0 meshes but no Gaussians"),
        (joined({"meshes": 3}, b""), "not a valid GLB scene"),
        (by_hand(extensionsRequired=["EXT_meshopt_compression"]), "EXT_meshopt_compression, which cannot be read"),
        (
            by_hand(
                **{
                    FIRST + "extensions__KHR_gaussian_splatting__extensions": {
                        "KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}
                    }
                }
            ),
            "compression_spz_2, which cannot be read",
        ),
        (by_hand(**{FIRST + "extensions__KHR_gaussian_splatting__kernel": "box"}), "kernel 'box'"),
        (
            by_hand(**{FIRST + "extensions__KHR_gaussian_splatting__colorSpace": "lin_rec2020_display"}),
            "colorSpace 'lin_rec2020_display'",
        ),
        (by_hand(**{FIRST + "attributes": {"POSITION": 0}}), "no attribute KHR_gaussian_splatting:ROTATION"),
        (by_hand(**{FIRST + f"attributes__{PREFIX}SH_DEGREE_1_COEF_1": 0}), "no attribute .*SH_DEGREE_1_COEF_0"),
        (by_hand(accessors__0__count=3), "not a valid GLB scene"),
        (by_hand(accessors__0__count=10**12), "not a valid GLB scene"),
        (by_hand(accessors__0__count=0), "count: 0"),
        (by_hand(accessors__0__count=2.0), "count: 2.0"),
        (by_hand(accessors__0__byteOffset=-4), "not a valid GLB scene"),
        (by_hand(accessors__0__componentType=9), "not a valid GLB scene"),
        (by_hand(accessors__0__type="MAT4"), "not a valid GLB scene"),
        (by_hand(accessors__0__sparse={}), "not a valid GLB scene"),
        (by_hand(accessors__0__bufferView=7), "not a valid GLB scene"),
        (by_hand(bufferViews__0__byteLength=97), "97, .*more than its 100 bytes can hold"),
        (by_hand(bufferViews__0__byteLength=95), "more than its 95 bytes can hold"),
        (by_hand(bufferViews__0__byteStride=0), "not a valid GLB scene"),
        (by_hand(bufferViews__0__byteOffset=2**70), "not a valid GLB scene"),
        (by_hand(buffers__0__uri="../../etc/passwd"), "is not in the file"),
        (by_hand(nodes=[{"mesh": 0}] * 51), r"scene\.glb: its nodes show 102 Gaussians, more than its 100 bytes"),
        (by_hand(nodes=[{"mesh": 0, "scale": [1, 2, 1]}]), "distorts the scene"),
        (by_hand(nodes=[{"mesh": 0, "scale": [1, 1, -1]}]), r"scene\.glb: the transformation mirrors or distorts"),
        (by_hand(nodes=[{"mesh": 0, "scale": [1e200, 1e200, 1e200]}]), "not finite"),
        (by_hand(nodes=[{"mesh": 0, "rotation": [0, 0, 0, 0]}]), "rotation"),
        (by_hand(nodes=[{"mesh": 0, "matrix": [1, 2]}]), "not a valid GLB scene"),
        (by_hand(nodes=[{"children": [i + 1]} for i in range(64)] + [{"mesh": 0}]), "nested too deeply"),
        (by_hand(nodes=[{"mesh": 0, "children": [0], "scale": [2, 2, 2]}]), "form a cycle"),
        (by_hand()[:-1], "is truncated"),
        (by_hand()[:300], "is truncated"),
        (by_hand()[:19], "is truncated"),
        (by_hand().replace(b"BIN\0", b"TXT\0"), "of data after its JSON"),
        (by_hand().replace(b"JSON", b"json"), "of JSON"),
        (by_hand()[:4] + b"\1" + by_hand()[5:], "GLB of version 1"),
        (by_hand()[:12] + struct.pack("<I", 2**32 - 4) + by_hand()[16:], "4294967292 bytes of JSON"),
        (
            joined({"meshes": "x" * (1 << 20)}, b""),
            "bytes of JSON; at most 1048576 can be read. Export the Gaussians without",
        ),
        (b"glTF" + struct.pack("<IIII", 2, 20 + 200_000, 200_000, 0x4E4F534A) + b"[" * 200_000, "RecursionError"),
    ],
)
def test_false_file_is_refused(tmp_path: Path, data: bytes, message: str) -> None:
    refused(tmp_path, data, message, "scene.glb")


def test_wrong_document_values_are_refused(tmp_path: Path) -> None:
    placed = {"mesh": 0, "translation": [0, 0, 0], "rotation": [0, 0, 0, 1], "scale": [1, 1, 1]}
    document, data = split(by_hand(nodes=[placed]))
    check_documents(tmp_path / "scene", document, lambda changed: joined(changed, data))


@pytest.mark.parametrize("key", ["matrix", "rotation", "scale", "translation"])
def test_text_in_a_transformation_is_refused(tmp_path: Path, key: str) -> None:
    numbers = {"matrix": 16, "rotation": 4}.get(key, 3)
    refused(tmp_path, by_hand(nodes__0={"mesh": 0, key: ["1_0"] * numbers}), "values that are not numbers")
