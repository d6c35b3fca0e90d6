"""Tests of .splat and .ksplat files."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from sgsst_core.errors import SceneError
from sgsst_core.files.scene_file import read_scene
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.files.formats.samples import SPLAT_ROW, assert_close, check_damage, ksplat, refused
from tests.sgsst_core.splat_scenes import cloud


def test_values_match_those_computed_by_hand_of_splat(tmp_path: Path) -> None:
    path = tmp_path / "scene.bin"
    row = struct.pack("<6f8B", 1, 2, 3, 1, np.e, 0.5, 0, 255, 51, 128, 128, 205, 26, 128)
    path.write_bytes(row * 3)
    loaded = read_scene(path)
    scene = loaded.scene
    assert (loaded.format, len(scene), scene.sh_degree) == ("splat", 3, 0)
    assert scene.means[2].tolist() == [1, 2, 3]
    assert scene.scales[0].tolist() == pytest.approx([0, 1, np.log(0.5)])
    assert (0.5 + 0.28209479177387814 * scene.sh_dc[0]).tolist() == pytest.approx([0, 1, 0.2], abs=1e-6)
    assert float(scene.opacities[0].sigmoid()) == pytest.approx(128 / 255)
    assert scene.quats[0].tolist() == pytest.approx([0, 77 / 128, -102 / 128, 0])


def test_truncated_file_and_flat_gaussian_are_refused(tmp_path: Path) -> None:
    refused(
        tmp_path, SPLAT_ROW * 40 + bytes(5), "40 Gaussians of 32 bytes and 5 bytes more: it is truncated", "a.splat"
    )
    flat = struct.pack("<6f8B", 1, 2, 3, 0, 1, 1, 0, 255, 51, 128, 255, 128, 128, 128)
    refused(tmp_path, SPLAT_ROW * 300 + flat, r"1 of 301 Gaussians hold .*scale_0\.", "a.splat")
    loaded = read_scene(tmp_path / "a.splat", drop_invalid=True)
    assert (len(loaded.scene), loaded.dropped) == (300, 1)


def test_random_damage_never_crashes_the_reader_of_splat(tmp_path: Path) -> None:
    check_damage(tmp_path / "scene", SPLAT_ROW * 100)


def scene(degree: int = 2, count: int = 700) -> Scene:
    """Return a scene whose values have the range of the format."""
    expected = cloud(count, degree=degree)
    return replace(expected, sh_dc=expected.sh_dc.clamp(-1.7, 1.7), sh_rest=expected.sh_rest.clamp(-1.4, 1.4))


def read(tmp_path: Path, data: bytes) -> Scene:
    (tmp_path / "scene").write_bytes(data)
    file = read_scene(tmp_path / "scene")
    assert file.format == "ksplat"
    return file.scene


@pytest.mark.parametrize("degree", [0, 1, 2])
@pytest.mark.parametrize("level", [0, 1, 2])
def test_all_compression_levels_are_read(tmp_path: Path, level: int, degree: int) -> None:
    expected = scene(degree)
    actual = read(tmp_path, ksplat(expected, level))
    assert actual.sh_degree == degree
    colors = replace(actual, sh_dc=expected.sh_dc, opacities=expected.opacities)
    assert float((actual.sh_dc - expected.sh_dc).abs().max()) <= 0.5 / 255 / 0.282 * 1.01
    assert float((actual.opacities.sigmoid() - expected.opacities.sigmoid()).abs().max()) < 0.51 / 255
    if level == 2 and degree:
        assert float((actual.sh_rest - expected.sh_rest).abs().max()) <= 1.5 / 255 * 1.01
        colors = replace(colors, sh_rest=expected.sh_rest)
    assert_close(colors, expected, others=1e-3 if level else 1e-6)


def test_values_match_those_computed_by_hand_of_ksplat(tmp_path: Path) -> None:
    """Two Gaussians in two buckets of a level 1 file: the first one is full, the second one holds one of two."""
    head = struct.pack("<4BIIIIH", 0, 1, 0, 0, 1, 1, 2, 2, 1).ljust(4096, b"\0")
    section = struct.pack("<IIIIfHxxIIIIH", 2, 4, 1, 2, 8.0, 12, 4, 0, 1, 1, 0).ljust(1024, b"\0")
    buckets = struct.pack("<I6f", 1, 10, 20, 30, -10, -20, -30)
    rows = b"".join(
        struct.pack("<3H3e4e4B", *steps, 1, 2, 0, 1, 0, 0, 0, 0, 255, 51, 128) for steps in ((4, 5, 0), (8, 4, 3))
    )
    result = read(tmp_path, head + section + buckets + rows + bytes(48))
    assert result.means.tolist() == [[10, 21, 26], [-6, -20, -31]]
    torch.testing.assert_close(result.scales[0].exp(), torch.tensor([1.0, 2, 2.0**-25]))
    assert result.quats.tolist() == [[1, 0, 0, 0]] * 2
    torch.testing.assert_close(0.5 + 0.28209479 * result.sh_dc[1], torch.tensor([0, 1, 0.2]))
    torch.testing.assert_close(result.opacities[0].sigmoid(), torch.tensor(128 / 255))


def test_sections_of_different_sh_degree_are_read(tmp_path: Path) -> None:
    """Missing SH coefficients are 0; empty sections are skipped."""
    parts = scene(2, 300), scene(0, 200)
    one, other = (ksplat(part, 1) for part in parts)
    head = bytearray(one[:4096])
    struct.pack_into("<IIII", head, 4, 3, 3, 500, 500)
    empty = bytes(1024)
    data = bytes(head) + one[4096:5120] + empty + other[4096:5120] + one[5120:] + other[5120:]
    actual = read(tmp_path, data)
    assert (len(actual), actual.sh_degree) == (500, 2)
    assert not actual.sh_rest[300:].any()
    expected = torch.cat([read(tmp_path, each).means for each in (one, other)])
    assert torch.equal(actual.means, expected)


def test_standard_deviations_of_0_are_refused(tmp_path: Path) -> None:
    data = ksplat(scene(0, 100), 0)
    refused(tmp_path, data[:5132] + bytes(4) + data[5136:], r"scale_0\.")


def changed(place: int, *values: int, level: int = 1) -> bytes:
    data = bytearray(ksplat(scene(1), level))
    struct.pack_into(f"<{len(values)}I", data, place, *values)
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (changed(4, 2**32 - 1), "declares 4294967295 sections"),
        (changed(4, 1025), "declares 1025 sections"),
        (changed(16, 699), "declares 699 Gaussians, but its sections hold 700"),
        (changed(4096, 699), "declares 700 Gaussians, but its sections hold 699"),
        (changed(4096, 701), "section 0 of the .ksplat file is wrong"),
        (changed(4100, 2**31), "ends after its"),
        (changed(4096 + 12, 2**31), "ends after its"),
        (changed(4096 + 32, 3), "section 0 of the .ksplat file is wrong"),
        (changed(4096 + 36, 2**31), "section 0 of the .ksplat file is wrong"),
        (changed(4096 + 40, 3), "section 0 of the .ksplat file is wrong"),
        (changed(4096 + 8, 200), "Gaussians beyond its buckets"),
        (changed(5120, 187), "Gaussians beyond its buckets"),
        (ksplat(scene(1), 1)[:-1], "ends after its"),
        (ksplat(scene(1), 0)[:5000], "declares 1 sections in 5000 bytes"),
    ],
)
def test_false_file_is_refused(tmp_path: Path, data: bytes, message: str) -> None:
    refused(tmp_path, data, message, "scene.ksplat")


@pytest.mark.parametrize("level", [0, 1, 2])
def test_random_damage_never_crashes_the_reader_of_ksplat(tmp_path: Path, level: int) -> None:
    good = ksplat(scene(1, 60), level)
    check_damage(tmp_path / "scene", good)
    # the headers are mostly empty, so that changes in their fields are made on their own
    fields = bytes(4096)
    check_damage(
        tmp_path / "scene",
        good[:44] + good[4096 : 4096 + 42] + good[5120:],
        lambda data: (data[:44] + fields)[:4096] + (data[44:86] + fields)[:1024] + data[86:],
    )
    for stop in (4095, 4096, 5120, len(good) - 1):
        (tmp_path / "scene").write_bytes(good[:stop])
        with pytest.raises(SceneError):
            read_scene(tmp_path / "scene")
