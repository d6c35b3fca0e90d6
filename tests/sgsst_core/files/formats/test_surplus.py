"""Tests of content that a scene file holds beyond what its header declares."""

from __future__ import annotations

import gzip
import json
import re
import struct
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sgsst_core.errors import SceneError
from sgsst_core.files.formats import by_name, read_scene_header
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.files.formats.samples import encoded, ksplat, refused
from tests.sgsst_core.splat_scenes import cloud
from tests.small_scenes import wall

NOTE = "the file has {} more than its header declares, which are not read; copy or export it again"


def fewer(data: bytes, count: int = 600) -> bytes:
    """Return a PLY whose header counts fewer Gaussians."""
    return data.replace(b"element vertex 616", f"element vertex {count}".encode())


def as_text(data: bytes) -> bytes:
    """Return a binary PLY of floats as text."""
    head, _, body = data.partition(b"end_header\n")
    width = head.count(b"property float")
    rows = np.frombuffer(body, "<f4").reshape(-1, width)
    lines = [" ".join(f"{value:.9g}" for value in row) for row in rows]
    return head.replace(b"binary_little_endian", b"ascii") + b"end_header\n" + "\n".join([*lines, ""]).encode()


def with_elements(data: bytes) -> bytes:
    """Return a PLY with faces and another element after its Gaussians."""
    lines = b"element face 2\nproperty list uchar int i\nelement view 1\nproperty double focal\nend_header\n"
    return data.replace(b"end_header\n", lines) + 2 * struct.pack("<B3i", 3, 0, 1, 2) + struct.pack("<d", 1)


@pytest.mark.parametrize("change", [bytes, as_text, with_elements])
def test_rows_beyond_the_declared_ones_are_counted(tmp_path: Path, change: Callable[[bytes], bytes]) -> None:
    path, data = tmp_path / "scene.ply", change(encoded(tmp_path, by_name("ply")))
    path.write_bytes(data + b"\n")
    assert read_scene(path).notes == ()
    if change is with_elements:
        path.write_bytes(data + b"more bytes")
        assert read_scene(path).notes == (NOTE.format("10 bytes"),)
        return
    path.write_bytes(fewer(data))
    loaded = read_scene(path)
    row_bytes = 26 * 4
    counted = "16 rows" if change is as_text else f"{16 * row_bytes} bytes (16 rows)"
    assert len(loaded.scene) == 600
    assert loaded.notes == (NOTE.format(counted),)
    write_stylized(loaded, tmp_path / "out.ply", torch.zeros(600, 3))
    assert read_scene(tmp_path / "out.ply").notes == loaded.notes


def text_transfer(data: bytes) -> bytes:
    return data.replace(b"\n", b"\r\n")


def text_transfer_of_the_end(data: bytes) -> bytes:
    """Return a PLY of which the header and the last line end in the data became CR LF."""
    head, _, body = data.partition(b"end_header\n")
    before, _, after = body.rpartition(b"\n")
    return text_transfer(head + b"end_header\n") + before + b"\r\n" + after


def text_transfer_of_the_data(data: bytes) -> bytes:
    head, _, body = data.partition(b"end_header\n")
    return head + b"end_header\n" + text_transfer(body)


def as_utf_8(data: bytes) -> bytes:
    head, _, body = data.partition(b"end_header\n")
    return head + b"end_header\n" + body.decode(errors="replace").encode()


def from_latin_1_to_utf_8(data: bytes) -> bytes:
    head, _, body = data.partition(b"end_header\n")
    return head + b"end_header\n" + body.decode("latin-1").encode()


@pytest.mark.parametrize("name", ["ply", "compressed.ply"])
@pytest.mark.parametrize(
    "change",
    [text_transfer, text_transfer_of_the_end, text_transfer_of_the_data, as_utf_8, from_latin_1_to_utf_8],
)
def test_binary_plys_that_were_transferred_as_text_are_refused(
    tmp_path: Path, name: str, change: Callable[[bytes], bytes]
) -> None:
    write_scene(tmp_path / "good", cloud(2000, degree=1), by_name(name))
    data = (tmp_path / "good").read_bytes()
    broken = change(data)
    surplus = len(broken) - len(data) - (broken.index(b"end_header") - data.index(b"end_header"))
    surplus -= broken.startswith(b"ply\r\n")
    refused(tmp_path, broken, rf"has {surplus} bytes? more than its header declares\. Was it transferred as text")
    with pytest.raises(SceneError, match="transferred as text"):
        read_scene(tmp_path / "scene.ply", drop_invalid=True)


def test_invalid_rows_before_a_surplus_are_not_dropped(tmp_path: Path) -> None:
    """A byte too many shifts all values after it."""
    write_scene(tmp_path / "good", cloud(2000, degree=1))
    data = (tmp_path / "good").read_bytes()
    middle = len(data) // 2
    refused(tmp_path, data[:middle] + b"\x7f" + data[middle:], "not as the header declares: the file has 1 byte more")


def test_signaling_nans_give_no_numpy_warning(tmp_path: Path) -> None:
    data = encoded(tmp_path, by_name("ply"))
    (tmp_path / "scene.ply").write_bytes(data[:-16] + struct.pack("<4I", 0x7F800001, 0, 0, 0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(SceneError, match=r"rot_0 \(1 NaN\)"):
            read_scene(tmp_path / "scene.ply")


def shorter_glb(data: bytes) -> bytes:
    return data.replace(b'"count": 616', b'"count": 600')


def longer_glb(data: bytes) -> bytes:
    """Return a GLB whose binary chunk has 40 bytes more than its buffer declares."""
    size = struct.unpack_from("<I", data, 12)[0]
    head, text, body = data[:20], data[20 : 20 + size], data[28 + size :] + b"x" * 40
    whole = struct.pack("<I", len(data) + 40)
    return head[:8] + whole + head[12:] + text + struct.pack("<I4s", len(body), b"BIN\0") + body


def trailing(count: int) -> Callable[[bytes], bytes]:
    return lambda data: data + b"x" * count


@pytest.mark.parametrize(
    ("name", "change", "surplus"),
    [
        *((name, trailing(20), "20 bytes") for name in ("compressed.ply", "spz", "v3.spz", "sog", "glb")),
        ("sog", lambda data: b"PK\3\4" + bytes(6) + data, "10 bytes"),
        ("glb", shorter_glb, f"{16 * 12} bytes"),
        ("glb", longer_glb, "40 bytes"),
        ("v3.spz", lambda data: gzip.compress(gzip.decompress(data) + b"12345"), "5 bytes"),
    ],
)
def test_surplus_of_compressed_scenes_is_counted(
    tmp_path: Path, name: str, change: Callable[[bytes], bytes], surplus: str
) -> None:
    path, data = tmp_path / "scene", encoded(tmp_path, by_name(name))
    for harmless in (data, data + b"\r\n", data + bytes(100)):
        path.write_bytes(harmless)
        assert read_scene(path, spz_axes="rub").notes == ()
    path.write_bytes(change(data))
    assert read_scene(path, spz_axes="rub").notes == (NOTE.format(surplus),)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_surplus_of_ksplat_is_counted(tmp_path: Path, level: int) -> None:
    path, data = tmp_path / "scene.ksplat", ksplat(wall(sh_degree=1), level)
    path.write_bytes(data + bytes(64))
    assert read_scene(path).notes == ()
    path.write_bytes(data + b"x" * 64)
    assert read_scene_header(path).notes == (NOTE.format("64 bytes"),)


@pytest.mark.parametrize("compress", [gzip.compress, bytes])
@pytest.mark.parametrize("extended", [True, False])
def test_spz_that_counts_fewer_gaussians_is_refused(
    tmp_path: Path, compress: Callable[[bytes], bytes], extended: bool
) -> None:
    """The attributes of all Gaussians follow each other, so that a wrong count shifts them."""
    raw = bytearray(gzip.decompress(encoded(tmp_path, by_name("v3.spz"))))
    raw[8:12] = struct.pack("<I", 600)
    if not extended:
        raw[14] = 0
    refused(tmp_path, compress(bytes(raw)), r"continues by \d+ bytes after all Gaussians", "scene.spz")
    data = bytearray(encoded(tmp_path, by_name("spz")))
    data[8:12] = struct.pack("<I", 600)
    refused(tmp_path, bytes(data), "belong to 600 Gaussians", "scene.spz")


def units(scene: Scene, *, scales: bool, opacities: bool) -> Scene:
    """Return a scene with activated scales or opacities in place of their logarithms and logits."""
    return replace(
        scene,
        scales=scene.scales.exp() if scales else scene.scales,
        opacities=scene.opacities.sigmoid() if opacities else scene.opacities,
    )


@pytest.mark.parametrize("scene", [wall(sh_degree=1), cloud(2000, degree=1)], ids=["wall", "cloud"])
@pytest.mark.parametrize("name", ["ply", "compressed.ply", "spz", "v3.spz", "sog", "glb"])
@pytest.mark.parametrize(("scales", "opacities"), [(True, True), (True, False), (False, True)])
def test_activated_values_are_refused(tmp_path: Path, scene: Scene, name: str, scales: bool, opacities: bool) -> None:
    """Formats that store opacities cannot show that logits of opacities were taken for logits."""
    path = tmp_path / "scene"
    write_scene(path, units(scene, scales=scales, opacities=opacities), by_name(name))
    if opacities and not scales and name != "ply":
        assert len(read_scene(path).scene) == len(scene)
        return
    expected = "its log scales go from .* stored as they are" if scales else "its logits of opacities go from"
    with pytest.raises(SceneError, match=rf"{expected}.*activated.*Export the scene again"):
        read_scene(path)


def test_scenes_in_small_units_are_read(tmp_path: Path) -> None:
    """In millimeters, all Gaussians may be larger than 1."""
    scene = cloud(2000, degree=0)
    shift = float(-scene.scales.min()) + 0.1
    large = replace(scene, means=scene.means * float(np.exp(shift)), scales=scene.scales + shift)
    write_scene(tmp_path / "scene.ply", large)
    assert torch.equal(read_scene(tmp_path / "scene.ply").scene.scales, large.scales)


def test_gaussians_larger_than_the_scene_are_read(tmp_path: Path) -> None:
    """They are neither plausible as logarithms nor as they are."""
    write_scene(tmp_path / "scene.ply", replace(wall(), scales=torch.full((616, 3), 6.0)))
    assert len(read_scene(tmp_path / "scene.ply").scene) == 616


def test_colors_in_place_of_coefficients_are_noticed(tmp_path: Path) -> None:
    path, colors = tmp_path / "scene.ply", torch.rand(616, 3, generator=torch.Generator().manual_seed(1))
    write_scene(path, replace(wall(), sh_dc=colors * 255))
    with pytest.raises(SceneError, match=r"colors \(f_dc\) go from .* colors of 0 to 255"):
        read_scene(path)
    write_scene(path, replace(wall(), sh_dc=colors))
    assert ["if they are colors of 0 to 1" in note for note in read_scene(path).notes] == [True]


@pytest.mark.parametrize("largest", [100, 255])
def test_opacities_of_0_to_100_or_255_are_noticed(tmp_path: Path, largest: int) -> None:
    path, opacities = tmp_path / "scene.ply", torch.linspace(0, largest, 616)
    write_scene(path, replace(wall(), opacities=opacities))
    (note,) = read_scene(path).notes
    assert note.startswith(f"logits of opacities go from 0 to {largest}, which is opaque; if they are opacities")
    write_scene(path, replace(wall(), opacities=opacities - 3))
    assert read_scene(path).notes == ()


@pytest.mark.parametrize(
    ("attribute", "values", "message"),
    [
        ("SCALE", wall().scales.numpy(), "scales are negative, so they are logarithms"),
        ("OPACITY", wall().opacities.numpy(), r"opacities are not in 0\.\.1, so they are logits"),
    ],
)
def test_logarithms_in_a_glb_are_refused(tmp_path: Path, attribute: str, values: np.ndarray, message: str) -> None:
    data = encoded(tmp_path, by_name("glb"))
    size = struct.unpack_from("<I", data, 12)[0]
    document = json.loads(data[20 : 20 + size])
    index = document["meshes"][0]["primitives"][0]["attributes"][f"KHR_gaussian_splatting:{attribute}"]
    start = 28 + size + document["bufferViews"][index]["byteOffset"]
    raw = values.astype("<f4").tobytes()
    refused(tmp_path, data[:start] + raw + data[start + len(raw) :], message, "scene.glb")


def test_logarithms_in_a_splat_are_refused(tmp_path: Path) -> None:
    row = struct.pack("<6f8B", 1, 2, 3, -4, -5, -2, 0, 255, 51, 128, 255, 128, 128, 128)
    refused(tmp_path, 40 * row, "scales are negative", "scene.splat")


@pytest.mark.parametrize("level", [0, 1])
def test_logarithms_in_a_ksplat_are_refused(tmp_path: Path, level: int) -> None:
    scene = wall()
    data = ksplat(replace(scene, scales=torch.full_like(scene.scales, 0.5)), level)
    old, new = (np.full(3, value, "<f2" if level else "<f4").tobytes() for value in (np.exp(np.float32(0.5)), -2.0))
    refused(tmp_path, re.sub(re.escape(old), new, data), "scales are negative", "scene.ksplat")


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("trbf_center", "trbf_scale", "motion_0"), "'trbf_center', so it is a dynamic scene.*Export one moment"),
        (("motion_3",), "'motion_3', so it is a dynamic scene"),
        (("t", "scale_t", "rot_r_0"), "'t', so it is a dynamic scene"),
        (("rot_r_3",), "'rot_r_3', so it is a dynamic scene"),
        (("velocity_x",), "'velocity_x', so it is a dynamic scene"),
        (("motion_x",), "'motion_x', so it is a dynamic scene"),
        (("opacity_t",), "'opacity_t', so it is a dynamic scene"),
        (("t_start", "t_end"), "'t_start', so it is a dynamic scene"),
        (("vx", "vy", "vz"), "'vx', so it is a dynamic scene"),
        (("binding_0",), "'binding_0', .*relative to a mesh"),
        (("beta",), "'beta', .*another kernel"),
    ],
)
@pytest.mark.parametrize("name", ["ply", "compressed.ply"])
def test_properties_that_change_the_meaning_are_refused(
    tmp_path: Path, name: str, names: tuple[str, ...], message: str
) -> None:
    data = encoded(tmp_path, by_name(name))
    end = b"element sh" if name == "compressed.ply" else b"end_header"
    lines = "".join(f"property float {each}\n" for each in names).encode()
    head, _, body = data.partition(end)
    refused(tmp_path, head + lines + end + body + bytes(4 * 616 * len(names)), message)


def test_properties_of_other_meanings_are_read(tmp_path: Path) -> None:
    """Names that begin or end as those of dynamic scenes do."""
    names = ("label", "confidence", "type", "tint", "weight", "variance", "rot_reference", "shading", "timestamp")
    data = encoded(tmp_path, by_name("ply"))
    lines = "".join(f"property float {each}\n" for each in names).encode()
    head, _, body = data.partition(b"end_header\n")
    row = len(body) // 616
    rows = b"".join(body[i : i + row] + bytes(4 * len(names)) for i in range(0, len(body), row))
    (tmp_path / "scene.ply").write_bytes(head + lines + b"end_header\n" + rows)
    assert read_scene(tmp_path / "scene.ply").notes == ()
