"""Tests of compressed PLY, against gsply and false headers."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gsply.reader import read_compressed
from gsply.writer import write_compressed
from plyfile import PlyData, PlyElement

from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.compressed_ply import COMPRESSED_PLY
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.files.formats.samples import (
    assert_close,
    encoded,
    gsply_of,
    refused,
    scene_of,
)
from tests.sgsst_core.splat_scenes import cloud
from tests.small_scenes import wall


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_files_are_read_as_by_gsply(tmp_path: Path, degree: int) -> None:
    path = tmp_path / "scene.ply"
    data = gsply_of(cloud(700, degree=degree))
    write_compressed(path, data.means, data.scales, data.quats, data.opacities, data.sh0, data.shN)
    assert read_scene_header(path).format is COMPRESSED_PLY
    actual, reference = read_scene(path), read_compressed(path)
    assert actual.scene.sh_degree == degree
    # gsply places the first and last level of SH coefficients in the middle of their steps instead of at the ends.
    expected = scene_of(reference)
    assert_close(replace(actual.scene, sh_rest=expected.sh_rest), expected)
    rest = held(expected.sh_rest)
    inner = rest.abs() < 3.98
    torch.testing.assert_close(held(actual.scene.sh_rest)[inner], rest[inner], rtol=0, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gsply_reads_written_files(tmp_path: Path, degree: int) -> None:
    path = tmp_path / "scene"
    write_scene(path, cloud(700, degree=degree), COMPRESSED_PLY)
    loaded = read_scene(path).scene
    assert loaded.sh_degree == degree
    assert_close(loaded, scene_of(read_compressed(path)))


def test_files_without_color_bounds_are_read(tmp_path: Path) -> None:
    """Compressed PLYs of older versions have colors between 0 and 1."""
    path = tmp_path / "scene.ply"
    scene = replace(wall(), sh_dc=torch.zeros(616, 3))
    write_scene(path, scene, COMPRESSED_PLY)
    ply = PlyData.read(str(path), mmap=False)
    names = [name for name in ply["chunk"].data.dtype.names if name[-1] not in "rgb"]
    chunk = PlyElement.describe(np.array(ply["chunk"].data[names].tolist(), [(name, "<f4") for name in names]), "chunk")
    ply["vertex"].data["packed_color"] = 0xFF008080
    PlyData([chunk, ply["vertex"]], byte_order="<").write(str(path))
    loaded = read_scene(path).scene
    assert (0.5 + 0.28209479177387814 * loaded.sh_dc[0]).tolist() == pytest.approx([1, 0, 128 / 255], abs=1e-6)


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
def test_false_header_is_refused(tmp_path: Path, change: Callable[[bytes], bytes], message: str) -> None:
    data = encoded(tmp_path, COMPRESSED_PLY)
    changed = change(data)
    assert changed != data
    refused(tmp_path, changed, message)


def test_non_finite_bounds_are_refused_or_dropped(tmp_path: Path) -> None:
    data = encoded(tmp_path, COMPRESSED_PLY)
    start = data.index(b"end_header\n") + len(b"end_header\n")
    changed = data[:start] + struct.pack("<f", float("nan")) + data[start + 4 :]
    refused(tmp_path, changed, r"256 of 616 Gaussians hold NaN or infinite values: x \(256 NaN\).*--drop-invalid")
    loaded = read_scene(tmp_path / "scene.ply", drop_invalid=True)
    assert (len(loaded.scene), loaded.dropped) == (360, 256)
    write_stylized(loaded, tmp_path / "out.ply", torch.zeros(360, 3))
    assert len(read_scene(tmp_path / "out.ply").scene) == 360
