"""Tests of reading compressed PLY, SPZ and .splat, against gsply (except .splat) and values computed by hand.

Files with false headers and damaged content must be refused.
"""

from __future__ import annotations

import gzip
import struct
import tracemalloc
import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import gsply
import numpy as np
import pytest
import torch
import zstandard
from gsply.reader import read_compressed
from gsply.spz import read_spz, write_spz
from gsply.writer import write_compressed
from plyfile import PlyData, PlyElement

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import EXTRA_FORMATS, format_of_name, read_scene_header
from sgsst_core.files.formats.compressed_ply import COMPRESSED_PLY
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.formats.splat import SPLAT
from sgsst_core.files.formats.spz import SPZ
from sgsst_core.files.scene_file import read_scene, write_scene, write_stylized
from sgsst_core.quality.packed import measure_packed
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import basis, rest_colors, view_colors
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.splat_scenes import camera, cloud
from tests.small_scenes import cameras, wall

#: Half a turn about x, from the axes of a PLY to those of SPZ.
TURN = torch.tensor([1.0, -1.0, -1.0])


def scene_of(data: gsply.GSData | None) -> Scene:
    assert data is not None
    rest = np.zeros((len(data.means), 0, 3), np.float32) if data.shN is None else data.shN
    arrays = data.means, data.quats, data.scales, data.opacities.reshape(-1), data.sh0, rest
    return Scene(*(torch.from_numpy(np.ascontiguousarray(array)) for array in arrays))


def gsply_of(scene: Scene) -> gsply.GSData:
    arrays = {field.name: getattr(scene, field.name).numpy() for field in fields(scene)}
    rest = arrays["sh_rest"]
    return gsply.GSData.from_arrays(
        means=arrays["means"],
        scales=arrays["scales"],
        quats=arrays["quats"] / np.linalg.norm(arrays["quats"], axis=1, keepdims=True),
        opacities=arrays["opacities"],
        sh0=arrays["sh_dc"],
        shN=rest if rest.shape[1] else None,
        format="ply",
    )


def turned(scene: Scene) -> Scene:
    """Return the same Gaussians in SPZ's coordinate system, with SH coefficients fitted to give the same colors."""
    turn = torch.diag(TURN.double())
    directions = torch.nn.functional.normalize(
        torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)), dim=1
    )
    degree = scene.sh_degree
    rest = held(scene.sh_rest)
    if degree:
        seen = basis(directions, degree)
        there = basis(directions @ turn, degree)
        matrix = torch.linalg.lstsq(there, seen).solution.float()
        rest = torch.einsum("jk,nkc->njc", matrix, rest)
    w, x, y, z = scene.quats.unbind(1)
    return replace(scene, means=scene.means * TURN, quats=torch.stack([w, x, -y, -z], dim=1), sh_rest=rest)


def assert_close(found: Scene, expected: Scene, *, opacities: float = 1.1e-3, others: float = 3e-6) -> None:
    """Assert that scenes are equal up to rounding and the sign of quaternions, and that opacities are finite."""
    for field in fields(Scene):
        first, second = getattr(found, field.name).double(), getattr(expected, field.name).double()
        tolerance = others
        if field.name == "quats":
            first, second = (torch.nn.functional.normalize(each, dim=1) for each in (first, second))
            second = second * (first * second).sum(dim=1, keepdim=True).sign()
        if field.name == "opacities":
            assert bool(torch.isfinite(first).all())
            first, second, tolerance = first.sigmoid(), second.sigmoid(), opacities
        torch.testing.assert_close(first, second, rtol=tolerance, atol=tolerance)


# --- what gsply writes -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_compressed_ply_of_another_program_is_read_as_it_reads_it(tmp_path: Path, degree: int) -> None:
    path = tmp_path / "scene.ply"
    data = gsply_of(cloud(700, degree=degree))
    write_compressed(path, data.means, data.scales, data.quats, data.opacities, data.sh0, data.shN)
    assert read_scene_header(path).format is COMPRESSED_PLY
    found, reference = read_scene(path), read_compressed(path)
    assert found.scene.sh_degree == degree
    # gsply places the first and last level of SH coefficients in the middle of their steps instead of at the ends.
    expected = scene_of(reference)
    assert_close(replace(found.scene, sh_rest=expected.sh_rest), expected)
    rest = held(expected.sh_rest)
    inner = rest.abs() < 3.98
    torch.testing.assert_close(held(found.scene.sh_rest)[inner], rest[inner], rtol=0, atol=1e-6)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spz_of_another_program_is_read_as_it_reads_it_but_for_the_axes(
    tmp_path: Path, degree: int, version: int
) -> None:
    path = tmp_path / "scene"
    write_spz(path, gsply_of(cloud(700, degree=degree)), version=version)
    assert read_scene_header(path).format is SPZ
    found = read_scene(path)
    assert found.scene.sh_degree == degree
    assert_close(turned(found.scene), scene_of(read_spz(path)))


@pytest.mark.parametrize("format", EXTRA_FORMATS)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_another_program_reads_what_is_written(tmp_path: Path, format: SceneFormat, degree: int) -> None:
    path = tmp_path / f"scene.{format.name}"
    write_scene(path, cloud(700, degree=degree), format)
    found = read_scene(path).scene
    assert found.sh_degree == degree
    data = read_spz(path) if format is SPZ else read_compressed(path)
    assert data is not None
    assert_close(turned(found) if format is SPZ else found, scene_of(data))


# --- values by hand --------------------------------------------------------------------------------------------------


def spz_bytes(version: int, count: int = 1, degree: int = 0, sections: bytes = b"", *, flags: int = 0) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, flags, 0) + sections)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz_by_hand(tmp_path: Path, version: int) -> None:
    position = struct.pack("<3e", 1.5, -2, 0.25)
    if version > 1:
        position = b"".join(round(value * 4096).to_bytes(3, "little", signed=True) for value in (1.5, -2, 0.25))
    # Half a turn about an axis between x and y: w = 0.6, x = 0, y = 0.8, z = 0, and the sign of y inverted.
    rotation = bytes([128, 26, 128])
    if version == 3:
        packed = 1 << 30  # y is the largest; x, z and w follow
        packed |= round(0.6 / 0.5**0.5 * 511)
        rotation = struct.pack("<I", packed)
    body = position + bytes([128]) + bytes([128, 0, 255]) + bytes([160, 176, 96]) + rotation
    path = tmp_path / "scene"
    path.write_bytes(spz_bytes(version, sections=body))
    scene = read_scene(path).scene
    assert scene.means.tolist() == [[1.5, 2, -0.25]]
    assert scene.opacities.sigmoid().tolist() == pytest.approx([128 / 255])
    assert scene.sh_dc[0].tolist() == pytest.approx([0.5 / 255 / 0.15, -0.5 / 0.15, 0.5 / 0.15], rel=1e-5)
    assert scene.scales.tolist() == [[0, 1, -4]]
    sign = 1 if version < 3 else -1
    assert scene.quats[0].tolist() == pytest.approx([0.6, 0, sign * 0.8, 0], abs=0.01)


def test_splat_by_hand(tmp_path: Path) -> None:
    path = tmp_path / "scene.bin"
    row = struct.pack("<6f8B", 1, 2, 3, 1, np.e, 0.5, 0, 255, 51, 128, 128, 205, 26, 128)
    path.write_bytes(row * 3)
    found = read_scene(path)
    scene = found.scene
    assert (found.format, len(scene), scene.sh_degree) == ("splat", 3, 0)
    assert scene.means[2].tolist() == [1, 2, 3]
    assert scene.scales[0].tolist() == pytest.approx([0, 1, np.log(0.5)])
    assert (0.5 + 0.28209479177387814 * scene.sh_dc[0]).tolist() == pytest.approx([0, 1, 0.2], abs=1e-6)
    assert float(scene.opacities[0].sigmoid()) == pytest.approx(128 / 255)
    assert scene.quats[0].tolist() == pytest.approx([0, 77 / 128, -102 / 128, 0])


def test_full_and_no_opacity_are_finite_and_come_back(tmp_path: Path) -> None:
    scene = replace(wall(), opacities=torch.cat([torch.full((308,), 1e4), torch.full((308,), -1e4)]))
    for format in EXTRA_FORMATS:
        path = tmp_path / f"scene.{format.name}"
        write_scene(path, scene, format)
        back = read_scene(path).scene
        assert sorted(set(back.opacities.sigmoid().tolist())) == pytest.approx([0.25 / 255, 1 - 0.25 / 255], rel=1e-4)
        write_scene(path, back, format)
        assert torch.equal(read_scene(path).scene.opacities.sort().values, back.opacities.sort().values)


def test_bounds_without_colors(tmp_path: Path) -> None:
    """Compressed PLYs of older versions have colors between 0 and 1."""
    path = tmp_path / "scene.ply"
    scene = replace(wall(), sh_dc=torch.zeros(616, 3))
    write_scene(path, scene, COMPRESSED_PLY)
    ply = PlyData.read(str(path), mmap=False)
    kept = [name for name in ply["chunk"].data.dtype.names if name[-1] not in "rgb"]
    chunk = PlyElement.describe(np.array(ply["chunk"].data[kept].tolist(), [(name, "<f4") for name in kept]), "chunk")
    ply["vertex"].data["packed_color"] = 0xFF008080
    PlyData([chunk, ply["vertex"]], byte_order="<").write(str(path))
    found = read_scene(path).scene
    assert (0.5 + 0.28209479177387814 * found.sh_dc[0]).tolist() == pytest.approx([1, 0, 128 / 255], abs=1e-6)


# --- what is written -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("format", "bound"), [(COMPRESSED_PLY, 40), (SPZ, 40)])
def test_pictures_of_what_is_written_are_nearly_the_same(tmp_path: Path, format: SceneFormat, bound: float) -> None:
    scene = replace(cloud(2000, degree=3), opacities=torch.full((2000,), 2.0))
    path = tmp_path / f"scene.{format.name}"
    write_scene(path, scene, format)
    loss = measure_packed(path, scene, [camera(), camera(140, 90)], near=0.01)
    assert loss.psnr is not None
    assert loss.psnr > bound
    assert loss.as_dict() == {
        "name": path.name,
        "format": format.name,
        "bytes": path.stat().st_size,
        "views": ["test", "test"],
        "psnr_db": round(loss.psnr, 2),
    }


@pytest.mark.parametrize(("format", "bound"), [(COMPRESSED_PLY, 48), (SPZ, 53)])
def test_a_real_scene_loses_little(shared_data: Path, tmp_path: Path, format: SceneFormat, bound: float) -> None:
    """The plush toy has 47,974 Gaussians of degree 3, trained from photos."""
    folder = shared_data / "scenes" / "snowmiku_plush"
    scene = read_scene(next(folder.glob("*.ply"))).scene
    path = tmp_path / "plush"
    write_scene(path, scene, format)
    loss = measure_packed(path, scene, read_cameras(folder / "cameras.json"), near=0.01)
    assert loss.psnr is not None
    assert loss.psnr > bound
    assert loss.size < 3e6


def test_the_loss_is_that_of_pictures(tmp_path: Path) -> None:
    """The PSNR of one view is computed by hand."""
    scene, view = wall(sh_degree=1), cameras(1)[0]
    path = tmp_path / "scene.spz"
    write_scene(path, replace(scene, sh_dc=scene.sh_dc + 0.3), SPZ)
    back = read_scene(path).scene
    first, second = (
        make_rasterizer("cpu", each, near=0.01)
        .render(view_colors(each.sh_dc, rest_colors(each.sh_rest, each.means, view)), view)
        .clamp(0, 1)
        for each in (scene, back)
    )
    expected = -10 * torch.log10((first.double() - second.double()).square().mean())
    assert measure_packed(path, scene, [view], near=0.01).psnr == pytest.approx(float(expected))


def test_neighbors_share_bounds(tmp_path: Path) -> None:
    """Errors are small in any order of the scene; 1/1024 of the whole extent would be forty times larger."""
    scene = cloud(20_000)
    scene = scene.subset(torch.randperm(len(scene), generator=torch.Generator().manual_seed(1)))
    path = tmp_path / "scene.ply"
    write_scene(path, scene, COMPRESSED_PLY)
    back = read_scene(path).scene.means
    order, other = (each[:, 0].double().argsort() for each in (scene.means, back))
    extent = float(scene.means.max() - scene.means.min())
    error = (scene.means[order, 0] - back[other, 0]).abs().mean()
    assert float(error) < extent / 2048 / 10


def test_bands_that_are_zero_are_not_written(tmp_path: Path) -> None:
    scene = wall(sh_degree=3)
    held(scene.sh_rest)[:, 3:] = 0
    for format in EXTRA_FORMATS:
        path = tmp_path / f"scene.{format.name}"
        write_scene(path, scene, format)
        assert read_scene(path).scene.sh_degree == 1


def test_a_position_that_spz_cannot_hold_is_an_error_and_leaves_nothing(tmp_path: Path) -> None:
    scene = wall()
    scene.means[5, 1] = -1e7
    with pytest.raises(OutputError, match=r"cannot hold a Gaussian 1e\+07 from the origin"):
        write_scene(tmp_path / "scene.spz", scene, SPZ)
    assert list(tmp_path.iterdir()) == []


def test_a_float_ply_is_what_it_was(tmp_path: Path) -> None:
    """The file is bit-identical to plyfile's."""
    scene, path, other = cloud(300, degree=2), tmp_path / "a.ply", tmp_path / "b.ply"
    write_scene(path, scene)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(24))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    rest = held(scene.sh_rest).transpose(1, 2).reshape(300, 24)
    parts = [scene.means, torch.zeros(300, 3), scene.sh_dc, rest, scene.opacities[:, None], scene.scales, scene.quats]
    values = torch.cat(parts, dim=1).numpy()
    rows = np.array([tuple(row) for row in values.tolist()], [(name, "<f4") for name in names])
    PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(other))
    assert path.read_bytes() == other.read_bytes()


@pytest.mark.parametrize("format", EXTRA_FORMATS)
def test_a_packed_scene_becomes_a_float_ply_with_the_new_colors(tmp_path: Path, format: SceneFormat) -> None:
    packed, out = tmp_path / "scene.any", tmp_path / "out.ply"
    write_scene(packed, wall(sh_degree=2), format)
    source = read_scene(packed)
    colors = torch.randn(616, 3, generator=torch.Generator().manual_seed(1))
    write_stylized(source, out, colors)
    found = read_scene(out)
    assert found.format == "ply"
    assert torch.equal(found.scene.sh_dc, colors)
    for name in ("means", "quats", "scales", "opacities", "sh_rest"):
        assert torch.equal(getattr(found.scene, name), getattr(source.scene, name)), name


def test_names_tell_what_is_written() -> None:
    assert format_of_name("a.ply") is format_of_name("a.PLY") is PLY
    assert format_of_name("a.b.compressed.ply") is COMPRESSED_PLY
    assert format_of_name("a.SPZ") is SPZ
    assert format_of_name("a.splat") is SPLAT
    assert format_of_name("ply") is None


# --- files that lie --------------------------------------------------------------------------------------------------


def packed(tmp_path: Path, format: SceneFormat, degree: int = 1) -> bytes:
    write_scene(tmp_path / "good", wall(sh_degree=degree), format)
    return (tmp_path / "good").read_bytes()


def refused(tmp_path: Path, data: bytes, message: str, name: str = "scene.ply") -> None:
    path = tmp_path / name
    path.write_bytes(data)
    tracemalloc.start()
    try:
        with pytest.raises(SceneError, match=message) as caught:
            read_scene(path)
        assert tracemalloc.get_traced_memory()[1] < 64e6
    finally:
        tracemalloc.stop()
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data[:-1], "only .* follow it: the file is truncated"),
        (lambda data: data.replace(b"vertex 616", b"vertex 999999999"), "3 chunks, but 999999999 Gaussians make"),
        (
            lambda data: (
                data.replace(b"vertex 616", b"vertex 2560000000")
                .replace(b"chunk 3", b"chunk 10000000")
                .replace(b"sh 616", b"sh 2560000000")
            ),
            "truncated or its header is wrong",
        ),
        (lambda data: data.replace(b"chunk 3", b"chunk 4"), "4 chunks, but 616 Gaussians make 3"),
        (lambda data: data.replace(b"element sh 616", b"element sh 615"), "'sh' has 615 rows"),
        (lambda data: data.replace(b"property uchar f_rest_8\n", b""), "'sh' has 616 rows of 8 properties"),
        (lambda data: data.replace(b"element chunk", b"element chunks"), "without element 'chunk'"),
        (lambda data: data.replace(b"float min_x", b"int min_x"), "'chunk' has min_x missing or of another type"),
        (lambda data: data.replace(b"uint packed_scale", b"int packed_scale"), "'vertex' has packed_scale missing"),
        (lambda data: data.replace(b"uchar f_rest_3", b"char f_rest_3"), "'sh' has f_rest_3 missing"),
        (lambda data: data.replace(b"binary_little_endian", b"ascii"), "as text"),
        (lambda data: data.replace(b"vertex 616", b"vertex 0").replace(b"chunk 3", b"chunk 0"), "holds no Gaussians"),
    ],
)
def test_compressed_plys_that_lie(tmp_path: Path, change: Callable[[bytes], bytes], message: str) -> None:
    data = packed(tmp_path, COMPRESSED_PLY)
    changed = change(data)
    assert changed != data
    refused(tmp_path, changed, message)


def test_bounds_that_are_no_numbers(tmp_path: Path) -> None:
    data = packed(tmp_path, COMPRESSED_PLY)
    start = data.index(b"end_header\n") + len(b"end_header\n")
    changed = data[:start] + struct.pack("<f", float("nan")) + data[start + 4 :]
    refused(tmp_path, changed, r"256 of 616 Gaussians hold NaN or infinite values: x \(256 NaN\).*--drop-invalid")
    kept = read_scene(tmp_path / "scene.ply", drop_invalid=True)
    assert (len(kept.scene), kept.dropped) == (360, 256)
    write_stylized(kept, tmp_path / "out.ply", torch.zeros(360, 3))
    assert len(read_scene(tmp_path / "out.ply").scene) == 360


ROW = 20 + 9


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (spz_bytes(3, 616, 1, bytes(616 * ROW - 1)), "ends before all Gaussians"),
        (spz_bytes(3, 616, 1, bytes(616 * ROW))[:-9], "ends before all Gaussians"),
        (spz_bytes(3, 4_000_000_000, 3, bytes(1000)), "declares 4000000000 Gaussians, which take 260000000016 bytes"),
        (spz_bytes(3, 616, 1, bytes(616 * ROW + (64 << 20))), "continues after all Gaussians"),
        (spz_bytes(5, 616, 1, bytes(616 * ROW)), "version 5, which cannot be read.*splat-transform"),
        (spz_bytes(3, 616, 4, bytes(100)), "SH degree 4; 0 to 3 can be read.*splat-transform"),
        (spz_bytes(3, 0, 0), "holds no Gaussians"),
        (gzip.compress(b"NGSP" + bytes(3)), "ends within its SPZ header"),
        (gzip.compress(b"something else that was packed"), "a gzip file, but no SPZ"),
        (b"\x1f\x8b" + bytes(100), "damaged gzip file"),
        (b"NGSP" + bytes(5), "ends within its SPZ header"),
        (b"NGSP" + struct.pack("<IIBBBBI", 4, 616, 1, 12, 0, 6, 32) + bytes(12), "6 streams, listed at byte 32"),
        (b"NGSP" + struct.pack("<IIBBBBI", 4, 616, 1, 12, 0, 5, 32) + bytes(92), "5 streams"),
        (
            b"NGSP" + struct.pack("<IIBBBBI", 4, 616, 0, 12, 0, 5, 32) + bytes(12) + struct.pack("<10Q", *[9, 9] * 5),
            "9 bytes that become 9; 5544 belong to 616 Gaussians",
        ),
        (
            b"NGSP" + struct.pack("<IIBBBBI", 4, 1, 0, 12, 0, 5, 32) + bytes(12) + struct.pack("<10Q", *[2**60, 9] * 5),
            "a stream of 1152921504606846976 bytes",
        ),
    ],
)
def test_spz_that_lies(tmp_path: Path, data: bytes, message: str) -> None:
    refused(tmp_path, data, message)


def test_spz_with_a_wrong_checksum_or_damaged_data(tmp_path: Path) -> None:
    data = packed(tmp_path, SPZ)
    refused(tmp_path, data[:-5] + bytes([data[-5] ^ 1]) + data[-4:], "damaged: .*incorrect data check")
    refused(tmp_path, data[:200] + bytes(50) + data[250:], "the compressed data")


def test_extensions_behind_the_data_are_passed_over(tmp_path: Path) -> None:
    raw = bytearray(gzip.decompress(packed(tmp_path, SPZ)))
    raw[14] = 2
    (tmp_path / "more").write_bytes(gzip.compress(bytes(raw) + bytes(1000)))
    first, second = (read_scene(tmp_path / name).scene for name in ("good", "more"))
    assert torch.equal(first.means, second.means)


def test_spz_4_streams_that_lie(tmp_path: Path) -> None:
    """Streams are truncated, too long or damaged, behind a correct table."""
    sections = [bytes(size) for size in (9, 1, 3, 3, 4)]
    for index, wrong, message in ((0, bytes(8), "ends before"), (2, bytes(1 << 27), "continues"), (4, None, "damaged")):
        bodies = [zstandard.compress(section) for section in sections]
        bodies[index] = zstandard.compress(wrong) if wrong is not None else b"nonsense"
        table = b"".join(struct.pack("<QQ", len(body), len(s)) for body, s in zip(bodies, sections, strict=True))
        head = b"NGSP" + struct.pack("<IIBBBBI", 4, 1, 0, 12, 0, 5, 32) + bytes(12)
        refused(tmp_path, head + table + b"".join(bodies), message)


def test_splats_that_lie(tmp_path: Path) -> None:
    row = struct.pack("<6f8B", 1, 2, 3, 1, 1, 1, 0, 255, 51, 128, 255, 128, 128, 128)
    refused(tmp_path, row * 40 + bytes(5), "40 Gaussians of 32 bytes and 5 bytes more: it is truncated", "a.splat")
    flat = struct.pack("<6f8B", 1, 2, 3, 0, 1, 1, 0, 255, 51, 128, 255, 128, 128, 128)
    refused(tmp_path, row * 300 + flat, r"1 of 301 Gaussians hold .*scale_0 \(1 infinite\)", "a.splat")
    kept = read_scene(tmp_path / "a.splat", drop_invalid=True)
    assert (len(kept.scene), kept.dropped) == (300, 1)


@pytest.mark.parametrize(
    "data", [b"", b"hello", b"\x89PNG\r\n\x1a\n" + bytes(300), b"a text of words. " * 200, bytes(3200)]
)
def test_other_files(tmp_path: Path, data: bytes) -> None:
    refused(tmp_path, data, "expected PLY, compressed PLY, SPZ or .splat")


def ksplat() -> bytes:
    head = struct.pack("<4BIIIIHHfff", 0, 1, 0, 0, 1, 1, 616, 616, 1, 0, 0, 0, 0)
    return head + bytes(4096 + 1024 - len(head)) + bytes(616 * 24)


@pytest.mark.parametrize(
    ("data", "name", "message"),
    [
        (b"PK\x03\x04" + bytes(100), "scene.sog", "as .sog scenes are.*splat-transform scene.sog scene.ply"),
        (
            b'{"version": 2, "means": {"files": ["means_l.webp"]}}',
            "meta.json",
            "a SOG scene.*splat-transform meta.json scene.ply",
        ),
        (ksplat(), "scene.ksplat", "a .ksplat scene.*splat-transform scene.ksplat scene.ply"),
    ],
)
def test_forms_that_are_not_read_name_the_converter(tmp_path: Path, data: bytes, name: str, message: str) -> None:
    refused(tmp_path, data, message, name)


def test_random_changes_never_break_a_reader(tmp_path: Path) -> None:
    """A damaged file gives a `SceneError` or a scene of finite values."""
    generator = np.random.default_rng(3)
    path = tmp_path / "scene"
    row = struct.pack("<6f8B", 1, 2, 3, 1, 1, 1, 0, 255, 51, 128, 255, 128, 128, 128)
    write_spz(tmp_path / "four", gsply_of(wall(sh_degree=1)), version=4)
    goods = [*(packed(tmp_path, format) for format in EXTRA_FORMATS), row * 100, (tmp_path / "four").read_bytes()]
    goods.append(zlib.decompress(goods[1], 31))
    for trial in range(400):
        data = bytearray(goods[trial % len(goods)])
        for _ in range(generator.integers(1, 8)):
            place = int(generator.integers(0, min(len(data), 1500) if generator.random() < 0.7 else len(data)))
            data[place] = int(generator.integers(0, 256))
        if generator.random() < 0.3:
            del data[int(generator.integers(0, len(data))) :]
        path.write_bytes(gzip.compress(bytes(data)) if trial % len(goods) == 4 else bytes(data))
        try:
            scene = read_scene(path).scene
        except SceneError:
            continue
        assert all(bool(torch.isfinite(getattr(scene, field.name)).all()) for field in fields(scene)), trial
