"""Tests of SPZ, against gsply, values computed by hand and false headers."""

import gzip
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from backports import zstd
from gsply.spz import read_spz, write_spz
from scipy.spatial.transform import Rotation

from sgsst_core.errors import OutputError
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.formats.spz import SPZ, SPZ_3
from sgsst_core.files.library import load_scene, save
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import basis
from tests.sgsst_core.files.formats.samples import (
    assert_close,
    check_damage,
    encoded,
    gsply_of,
    refused,
    scene_of,
)
from tests.sgsst_core.splat_scenes import cloud
from tests.small_scenes import wall
from worker.derived import convert
from worker.job import SceneRequest

#: Half a turn about x, from the axes of a PLY (RDF) to RUB.
TURN = torch.tensor([1.0, -1.0, -1.0])


def rotated(scene: Scene) -> Scene:
    """Return the same Gaussians in the axes RUB, with SH coefficients fitted to give the same colors."""
    turn = torch.diag(TURN.double())
    directions = torch.nn.functional.normalize(
        torch.randn(200, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2)), dim=1
    )
    degree = scene.sh_degree
    rest = scene.sh_rest
    if degree:
        seen = basis(directions, degree)
        there = basis(directions @ turn, degree)
        matrix = torch.linalg.lstsq(there, seen).solution.float()
        rest = torch.einsum("jk,nkc->njc", matrix, rest)
    w, x, y, z = scene.quats.unbind(1)
    return replace(scene, means=scene.means * TURN, quats=torch.stack([w, x, -y, -z], dim=1), sh_rest=rest)


@pytest.mark.parametrize("version", [3, 4])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_files_are_read_as_by_gsply(tmp_path: Path, degree: int, version: int) -> None:
    path = tmp_path / "scene"
    write_spz(path, gsply_of(cloud(700, degree=degree)), version=version)
    assert read_scene_header(path).format is (SPZ_3 if version == 3 else SPZ)
    loaded = read_scene(path, spz_axes="rdf")
    assert loaded.scene.sh_degree == degree
    assert_close(loaded.scene, scene_of(read_spz(path)))
    assert_close(rotated(read_scene(path).scene), scene_of(read_spz(path)))


@pytest.mark.parametrize("format", [SPZ, SPZ_3], ids=lambda format: format.name)
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_reads_written_files(tmp_path: Path, degree: int, format: SceneFormat) -> None:
    path = tmp_path / "scene"
    for axes in ("rub", "rdf"):
        write_scene(path, cloud(700, degree=degree), format, axes)
        loaded = read_scene(path, spz_axes=axes).scene
        assert loaded.sh_degree == degree
        assert_close(rotated(loaded) if axes == "rub" else loaded, scene_of(read_spz(path)))


def axes_record(number: int) -> bytes:
    """Return the extension record that states the axes."""
    return struct.pack("<III", 0xADBE0003, 4, number)


def with_records(data: bytes, records: bytes) -> bytes:
    """Return an SPZ file of version 3 or 4 with other extension records."""
    if data.startswith(b"NGSP"):
        table = int.from_bytes(data[16:20], "little")
        head = data[:14] + b"\x02" + data[15:16] + struct.pack("<I", 32 + len(records)) + data[20:32]
        return head + records + data[table:]
    raw = bytearray(gzip.decompress(data))
    raw[14] = 2
    return gzip.compress(bytes(raw) + records)


@pytest.mark.parametrize("version", [3, 4])
def test_stated_axes_are_followed_unless_others_are_requested(tmp_path: Path, version: int) -> None:
    path = tmp_path / "scene"
    write_spz(path, gsply_of(cloud(700, degree=2)), version=version)
    plain, data = read_scene(path, spz_axes="rdf").scene, path.read_bytes()
    other = struct.pack("<II", 0x12340001, 5) + bytes(5)
    for number, rub in ((6, False), (4, True), (0, True)):
        path.write_bytes(with_records(data, other + axes_record(number)))
        loaded = read_scene(path).scene
        assert_close(rotated(loaded) if rub else loaded, plain)
        assert_close(read_scene(path, spz_axes="rdf").scene, plain)
        assert_close(rotated(read_scene(path, spz_axes="rub").scene), plain)


@pytest.mark.parametrize("version", [3, 4])
def test_unknown_extensions_are_left_out(tmp_path: Path, version: int) -> None:
    path = tmp_path / "scene"
    write_spz(path, gsply_of(cloud(700)), version=version)
    data = path.read_bytes()
    assert read_scene(path).notes == (
        "axes: read as rub; the file states none. If the scene is upside down, pass --spz-axes rdf",
    )
    assert not read_scene(path, spz_axes="rdf").notes
    records = axes_record(6) + struct.pack("<II", 0xADBE0002, 3) + b"abc" + struct.pack("<II", 7, 0)
    path.write_bytes(with_records(data, records + struct.pack("<II", 9, 1000)))
    assert read_scene(path).notes == ()


@pytest.mark.parametrize("version", [3, 4])
def test_unknown_axes_are_refused_and_broken_records_ignored(tmp_path: Path, version: int) -> None:
    path = tmp_path / "scene"
    write_spz(path, gsply_of(cloud(700, degree=1)), version=version)
    data = path.read_bytes()
    refused(tmp_path, with_records(data, axes_record(17)), "coordinate system 17; 0 to 16 can be read")
    plain = read_scene(path).scene
    for records in (axes_record(4)[:-1], struct.pack("<II", 7, 2**32 - 1) + axes_record(4), b"\0" * 7):
        path.write_bytes(with_records(data, records))
        assert_close(read_scene(path).scene, plain)


#: Names of the format's coordinate systems (`CoordinateSystem` in splat-types.h): directions of x, y and z.
SYSTEMS = ["LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"]
SYSTEMS += ["LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"]


@pytest.mark.parametrize("number", range(1, 17))
def test_all_axes_are_read_and_written_back(tmp_path: Path, number: int) -> None:
    """A function of the direction d is the same in other axes, whose matrix may mirror."""
    first, again = tmp_path / "first", tmp_path / "again"
    name, scene = SYSTEMS[number - 1].lower(), cloud(700, degree=3)
    scene = replace(scene, sh_dc=scene.sh_dc.clamp(-3, 3), sh_rest=scene.sh_rest.clamp(-0.5, 0.5))
    write_scene(first, scene, SPZ, name)
    assert first.read_bytes()[32:44] == axes_record(number)
    loaded = read_scene(first)
    assert loaded.axes == name
    assert_close(loaded.scene, scene, opacities=0.01, others=0.1)
    write_scene(again, loaded.scene, SPZ, loaded.axes)
    assert_close(read_scene(again).scene, loaded.scene, opacities=0, others=0.02)
    columns = {"R": (0, 1), "L": (0, -1), "D": (1, 1), "U": (1, -1), "F": (2, 1), "B": (2, -1)}
    matrix = torch.zeros(3, 3)
    for axis, (row, sign) in enumerate(columns[letter] for letter in SYSTEMS[number - 1]):
        matrix[row, axis] = sign
    as_stored = read_with_axes(first, 6)
    assert torch.equal(as_stored.means @ matrix.T, loaded.scene.means)
    covariances = [covariance(each) for each in (as_stored, loaded.scene)]
    torch.testing.assert_close(matrix @ covariances[0] @ matrix.T, covariances[1], rtol=1e-3, atol=1e-6)
    directions = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=1)
    seen, there = (basis(each, 3) for each in (directions, directions @ matrix.double()))
    stored, read = (each.sh_rest.double() for each in (as_stored, loaded.scene))
    torch.testing.assert_close(
        torch.einsum("dk,nkc->ndc", there, stored), torch.einsum("dk,nkc->ndc", seen, read), rtol=1e-4, atol=1e-4
    )


def read_with_axes(path: Path, number: int) -> Scene:
    """Return the scene of a file of version 4 under other axes."""
    data = path.read_bytes()
    other = path.with_name("other")
    other.write_bytes(data[:40] + struct.pack("<I", number) + data[44:])
    return read_scene(other).scene


def covariance(scene: Scene) -> torch.Tensor:
    rotations = torch.from_numpy(Rotation.from_quat(scene.quats.numpy(), scalar_first=True).as_matrix()).float()
    axes = rotations * scene.scales.exp()[:, None]
    return axes @ axes.mT


def test_version_3_has_no_record_and_the_axes_of_the_library(tmp_path: Path) -> None:
    raw = gzip.decompress(encoded(tmp_path, SPZ_3))
    assert (raw[14], len(raw)) == (0, 16 + 616 * ROW)
    write_scene(tmp_path / "four", wall(sh_degree=1), SPZ)
    assert_close(*(read_scene(tmp_path / name).scene for name in ("good", "four")), opacities=0, others=0)
    write_scene(tmp_path / "rdf", wall(sh_degree=1), SPZ_3, "rdf")
    write_scene(tmp_path / "mirrored", wall(sh_degree=1), SPZ_3, "luf")
    assert gzip.decompress((tmp_path / "rdf").read_bytes()) != raw
    assert gzip.decompress((tmp_path / "mirrored").read_bytes()) == raw


def test_converted_scenes_keep_their_axes(tmp_path: Path) -> None:
    for name, number in (("luf", 7), ("rub", 4), ("rdf", 6)):
        source, out = tmp_path / "source.spz", tmp_path / "out.spz"
        write_scene(source, cloud(700), SPZ, name)
        convert(SceneRequest(scene=source), out, compare=False)
        assert out.read_bytes()[32:44] == axes_record(number)
        save(out, load_scene(source))
        assert out.read_bytes()[32:44] == axes_record(number)


def test_file_names_in_the_gzip_header_are_skipped(tmp_path: Path) -> None:
    """File systems allow 255 bytes."""
    data = encoded(tmp_path, SPZ_3)
    named = data[:3] + b"\x08" + data[4:10] + b"n" * 255 + b"\0" + data[10:]
    (tmp_path / "scene").write_bytes(named)
    assert_close(read_scene(tmp_path / "scene").scene, read_scene(tmp_path / "good").scene, opacities=0, others=0)


@pytest.mark.parametrize("format", [SPZ, SPZ_3], ids=lambda format: format.name)
def test_levels_of_detail_are_refused(tmp_path: Path, format: SceneFormat) -> None:
    data = encoded(tmp_path, format)
    raw = bytearray(gzip.decompress(data) if format is SPZ_3 else data)
    raw[14] |= 0x80
    refused(tmp_path, bytes(raw), "levels of detail of Spark")


@pytest.mark.parametrize("version", [1, 2, 3])
def test_files_without_their_gzip_layer_are_read(tmp_path: Path, version: int) -> None:
    raw = gzip.decompress(encoded(tmp_path, SPZ_3))
    if version < 3:
        sections = (bytes(range(6 if version == 1 else 9)) * 700, bytes(700), bytes(2100), bytes(2100), bytes(2100))
        raw = gzip.decompress(spz_bytes(version, 700, sections=b"".join(sections)))
    scenes = []
    for data in (raw, gzip.compress(raw)):
        (tmp_path / "scene").write_bytes(data)
        assert read_scene_header(tmp_path / "scene").format is SPZ_3
        scenes.append(read_scene(tmp_path / "scene"))
    assert_close(scenes[0].scene, scenes[1].scene, opacities=0, others=0)
    assert scenes[0].notes == scenes[1].notes
    refused(tmp_path, raw[:-40], "the file is truncated")


def test_degree_4_is_read_as_degree_3(tmp_path: Path) -> None:
    """Each Gaussian has 15 coefficients per channel of degree 1 to 3, and then 9 of degree 4."""
    write_scene(tmp_path / "three", cloud(700, degree=3), SPZ_3)
    raw = gzip.decompress((tmp_path / "three").read_bytes())
    body, harmonics = raw[: 16 + 700 * 20], np.frombuffer(raw[16 + 700 * 20 :], np.uint8).reshape(700, 45)
    more = np.concatenate([harmonics, np.full((700, 27), 200, np.uint8)], axis=1)
    (tmp_path / "four").write_bytes(
        gzip.compress(body[:12] + b"\4" + body[13:14] + bytes(2) + body[16:] + more.tobytes())
    )
    first, second = (read_scene(tmp_path / name).scene for name in ("three", "four"))
    assert_close(first, second, opacities=0, others=0)


def spz_bytes(version: int, count: int = 1, degree: int = 0, sections: bytes = b"", *, flags: int = 0) -> bytes:
    return gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", version, count, degree, 12, flags, 0) + sections)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_values_match_those_computed_by_hand(tmp_path: Path, version: int) -> None:
    position = struct.pack("<3e", 1.5, -2, 0.25)
    if version > 1:
        position = b"".join(round(value * 4096).to_bytes(3, "little", signed=True) for value in (1.5, -2, 0.25))
    # Half a turn about an axis between x and y: w = 0.6, x = 0, y = 0.8, z = 0, as RUB: the sign of y inverted.
    rotation = bytes([128, 26, 128])
    if version == 3:
        packed = 1 << 30  # y is the largest; x, z and w follow
        packed |= round(0.6 / 0.5**0.5 * 511)
        rotation = struct.pack("<I", packed)
    body = position + bytes([128]) + bytes([128, 0, 255]) + bytes([160, 176, 96]) + rotation
    path = tmp_path / "scene"
    path.write_bytes(spz_bytes(version, sections=body))
    scene = read_scene(path, spz_axes="rub").scene
    assert scene.means.tolist() == [[1.5, 2, -0.25]]
    assert scene.opacities.sigmoid().tolist() == pytest.approx([128 / 255])
    assert scene.sh_dc[0].tolist() == pytest.approx([0.5 / 255 / 0.15, -0.5 / 0.15, 0.5 / 0.15], rel=1e-5)
    assert scene.scales.tolist() == [[0, 1, -4]]
    sign = 1 if version < 3 else -1
    assert scene.quats[0].tolist() == pytest.approx([0.6, 0, sign * 0.8, 0], abs=0.01)


def test_position_out_of_range_is_refused_without_a_file(tmp_path: Path) -> None:
    scene = wall()
    scene.means[5, 1] = -1e7
    with pytest.raises(OutputError, match=r"cannot hold a Gaussian 1e\+07 from the origin"):
        write_scene(tmp_path / "scene.spz", scene, SPZ)
    assert list(tmp_path.iterdir()) == []


ROW = 20 + 9


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (spz_bytes(3, 616, 1, bytes(616 * ROW - 1)), "ends before all Gaussians"),
        (spz_bytes(3, 616, 1, bytes(616 * ROW))[:-9], "ends before all Gaussians"),
        (spz_bytes(3, 4_000_000_000, 3, bytes(1000)), "declares 4000000000 Gaussians, which take 260000000016 bytes"),
        (spz_bytes(3, 616, 1, bytes(616 * ROW + (64 << 20))), "continues after all Gaussians"),
        (spz_bytes(5, 616, 1, bytes(616 * ROW)), "version 5, which cannot be read. Export it as SPZ 4 or 3"),
        (spz_bytes(3, 616, 5, bytes(100)), "SH degree 5; 0 to 4 can be read. Export it as PLY"),
        (spz_bytes(3, 0, 0), "holds no Gaussians"),
        (gzip.compress(b"NGSP" + bytes(3)), "ends within its SPZ header"),
        (spz_bytes(4, 616, 1, bytes(616 * ROW)), "version 4 in a gzip stream, which cannot be read"),
        *((spz_bytes(3, 616, 1, bytes(616 * ROW))[:end], "ends within its SPZ header") for end in (2, 10, 12)),
        (gzip.compress(b"something else that was packed"), "a gzip file, but no SPZ"),
        (b"\x1f\x8b" + bytes(100), "damaged gzip file"),
        (b"NGSP" + bytes(5), "ends within its SPZ header"),
        (
            b"NGSP" + struct.pack("<IIBBBBI", 4, 616, 1, 12, 0, 6, 32) + bytes(12),
            "6 streams with their table at byte 32",
        ),
        (b"NGSP" + struct.pack("<IIBBBBI", 4, 616, 1, 12, 0, 5, 32) + bytes(92), "5 streams"),
        (
            b"NGSP" + struct.pack("<IIBBBBI", 4, 616, 0, 12, 0, 5, 32) + bytes(12) + struct.pack("<10Q", *[9, 9] * 5),
            "9 bytes that become 9; 5544 belong to 616 Gaussians",
        ),
        (
            b"NGSP" + struct.pack("<IIBBBBI", 4, 1, 0, 12, 0, 5, 32) + bytes(12) + struct.pack("<10Q", *[2**60, 9] * 5),
            "a stream of 1152921504606846976 bytes",
        ),
        (
            b"NGSP"
            + struct.pack("<IIBBBBI", 4, 10**9, 0, 12, 0, 5, 32)
            + bytes(12)
            + struct.pack("<10Q", 20, 9 * 10**9, *(20, 10**9), *(20, 3 * 10**9) * 2, 20, 4 * 10**9)
            + bytes(100),
            "a stream of 20 bytes that become 9000000000; 9000000000 belong to 1000000000 Gaussians",
        ),
    ],
)
def test_false_header_is_refused(tmp_path: Path, data: bytes, message: str) -> None:
    refused(tmp_path, data, message)


def test_wrong_checksum_or_damaged_data_is_refused(tmp_path: Path) -> None:
    data = encoded(tmp_path, SPZ_3)
    refused(tmp_path, data[:-5] + bytes([data[-5] ^ 1]) + data[-4:], "damaged: .*incorrect data check")
    refused(tmp_path, data[:200] + bytes(50) + data[250:], "the compressed data")


def test_false_streams_of_version_4_are_refused(tmp_path: Path) -> None:
    """Streams are truncated, too long or damaged, after a correct table."""
    sections = [bytes(size) for size in (9, 1, 3, 3, 4)]
    for index, wrong, message in ((0, bytes(8), "ends before"), (2, bytes(1 << 27), "continues"), (4, None, "damaged")):
        bodies = [zstd.compress(section) for section in sections]
        bodies[index] = zstd.compress(wrong) if wrong is not None else b"nonsense"
        table = b"".join(struct.pack("<QQ", len(body), len(s)) for body, s in zip(bodies, sections, strict=True))
        head = b"NGSP" + struct.pack("<IIBBBBI", 4, 1, 0, 12, 0, 5, 32) + bytes(12)
        refused(tmp_path, head + table + b"".join(bodies), message)


def test_random_damage_never_crashes_the_reader(tmp_path: Path) -> None:
    """The damage is within the gzip stream, or in a file of version 4."""
    check_damage(tmp_path / "scene", zlib.decompress(encoded(tmp_path, SPZ_3), 31), wrap=gzip.compress)
    write_spz(tmp_path / "four", gsply_of(wall(sh_degree=1)), version=4)
    check_damage(tmp_path / "scene", (tmp_path / "four").read_bytes())
