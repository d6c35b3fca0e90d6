"""Tests that ranks read a scene once per machine, share it without leaks, and refuse it if memory is too small."""

from __future__ import annotations

import gc
import hashlib
import os
import socket
import sys
from pathlib import Path
from unittest.mock import patch

import psutil
import pytest
import torch
from torch import Tensor

from sgsst_core import container
from sgsst_core.errors import SceneError, SceneTooLargeError
from sgsst_core.files import scene_file
from sgsst_core.files.formats import EXTRA_FORMATS
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.orbit.cameras import orbit
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.spherical_harmonics import rest_colors
from sgsst_core.scene.stored_harmonics import StoredHarmonics, held
from tests.small_scenes import wall
from tests.worker.ranks.spawn import on_ranks
from worker.inputs import read_shared_scene
from worker.processes import home

linux = pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="memory files are looked for in Linux's /proc")


def digest(scene: Scene) -> str:
    """Return a hash of all tensors of a scene."""
    return hashlib.sha256(b"".join(getattr(scene, name).numpy().tobytes() for name in TENSORS)).hexdigest()


def shared(collectives: Collectives, path: Path, drop: bool) -> tuple[str, bool, int, int, int]:
    """Share a scene file among ranks, and return what this rank sees.

    Returns:
        Digest of the scene, whether this rank has read the file, and the numbers of dropped rows, mappings, and leaked
        shared memory files.
    """
    file, reader = read_shared_scene(path, collectives, drop_invalid=drop)
    maps = Path("/proc/self/maps").read_text().count("memfd:sgsst-scene")
    file.scene.sh_dc[0] += 1.0  # must not be visible to other ranks
    collectives.all_gather(None)
    again = read_scene(path, drop_invalid=drop).scene.sh_dc
    assert float((file.scene.sh_dc - again).abs().sum()) == pytest.approx(3.0)
    file.scene.sh_dc[0] = again[0]
    digests, dropped = digest(file.scene), file.dropped
    del file
    gc.collect()
    left = sum(
        "memfd:sgsst-scene" in os.readlink(link) for link in Path("/proc/self/fd").iterdir() if link.is_symlink()
    )
    return digests, reader, dropped, maps, left


@linux
@pytest.mark.parametrize("drop", [False, True])
def test_one_rank_reads_and_shares_the_scene(tmp_path: Path, drop: bool) -> None:
    scene = wall(sh_degree=1)
    if drop:
        scene.opacities[7] = float("nan")
    write_scene(tmp_path / "scene.ply", scene)
    results = on_ranks(3, shared, tmp_path / "scene.ply", drop)
    alone = digest(read_scene(tmp_path / "scene.ply", drop_invalid=drop).scene)
    assert [rank[0] for rank in results] == [alone] * 3
    assert [rank[1] for rank in results] == [True, False, False]
    assert [rank[2] for rank in results] == [int(drop)] * 3
    assert all(rank[3] >= 1 for rank in results), "not mapped"
    assert [rank[4] for rank in results] == [0, 0, 0], "left behind"


def read_as_on_macos(collectives: Collectives, path: Path) -> tuple[str, bool, tuple[str, ...]]:
    """Return the digest of a scene, whether this rank has read its file, and its home, as a system without memfd."""
    memory_file = os.memfd_create
    try:
        del os.memfd_create
        with patch.object(sys, "platform", "darwin"):
            file, reader = read_shared_scene(path, collectives)
            return digest(file.scene), reader, home()
    finally:
        os.memfd_create = memory_file


@linux
def test_every_rank_reads_the_scene_where_memory_files_are_missing(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene.ply", wall(sh_degree=1))
    results = on_ranks(2, read_as_on_macos, tmp_path / "scene.ply")
    assert [rank[0] for rank in results] == [digest(read_scene(tmp_path / "scene.ply").scene)] * 2
    assert [rank[1] for rank in results] == [True, False]
    assert [rank[2] for rank in results] == [(socket.gethostname(), psutil.Process().username())] * 2


@linux
@pytest.mark.parametrize("format", EXTRA_FORMATS)
def test_compressed_scene_is_read_once(tmp_path: Path, format: SceneFormat) -> None:
    path = tmp_path / "scene"
    write_scene(path, wall(sh_degree=1), format)
    results = on_ranks(2, shared, path, False)
    assert [rank[0] for rank in results] == [digest(read_scene(path).scene)] * 2
    assert [rank[1] for rank in results] == [True, False]


def test_compressed_scene_needs_memory_of_its_floats(tmp_path: Path) -> None:
    """The requirement follows from the header, before the scene is decompressed."""
    path = tmp_path / "scene"
    for format in EXTRA_FORMATS:
        write_scene(path, wall(sh_degree=3), format)
        little = patch.object(container, "memory", return_value=container.Memory(1 << 40, 616 * 4 * 59))
        with little, pytest.raises(SceneTooLargeError, match="616 Gaussians need"):
            read_shared_scene(path, ALONE)


def shared_colors(collectives: Collectives, path: Path, drop: bool) -> tuple[bool, Tensor, Tensor]:
    """Return whether this rank leaves SH coefficients in the file, the coefficients, and the colors in a view."""
    with patch.object(scene_file, "HELD_BYTES", 0):
        scene = read_shared_scene(path, collectives, drop_invalid=drop)[0].scene
    stored = isinstance(scene.sh_rest, StoredHarmonics)
    return stored, held(scene.sh_rest), rest_colors(scene.sh_rest, scene.means, orbit(scene, 1)[0])


@linux
@pytest.mark.parametrize("drop", [False, True])
def test_every_rank_reads_stored_harmonics_from_the_file(tmp_path: Path, drop: bool) -> None:
    scene = wall(sh_degree=2)
    if drop:
        scene.opacities[7] = float("nan")
    write_scene(tmp_path / "scene.ply", scene)
    plain = read_scene(tmp_path / "scene.ply", drop_invalid=drop).scene
    colors = rest_colors(plain.sh_rest, plain.means, orbit(plain, 1)[0])
    for stored, values, own in on_ranks(2, shared_colors, tmp_path / "scene.ply", drop):
        assert stored
        assert torch.equal(values, held(plain.sh_rest))
        assert torch.equal(own, colors)


def refused(collectives: Collectives, path: Path) -> str:
    """Return the error message of a rank that refuses the scene."""
    with pytest.raises(SceneError) as caught:
        read_shared_scene(path, collectives)
    return str(caught.value)


def test_invalid_scene_is_refused_on_every_rank(tmp_path: Path) -> None:
    scene = wall()
    scene.scales[3, 1] = float("nan")
    write_scene(tmp_path / "scene.ply", scene)
    messages = on_ranks(2, refused, tmp_path / "scene.ply")
    assert messages[0] == messages[1]
    assert "scale_1" in messages[0]


def test_scene_beyond_memory_is_refused_with_figures(tmp_path: Path) -> None:
    """The file is sparse, with the size of a billion Gaussians, none of which is stored."""
    path = tmp_path / "scene.ply"
    write_scene(path, wall(sh_degree=3))
    head, end, body = path.read_bytes().partition(b"end_header\n")
    rows = len(wall())
    count = 1_000_000_000
    path.write_bytes(head.replace(f"vertex {rows}".encode(), f"vertex {count}".encode()) + end)
    try:
        os.truncate(path, path.stat().st_size + count * (len(body) // rows))
    except OSError as error:
        pytest.skip(f"no file of this size here: {error}")
    with pytest.raises(SceneTooLargeError, match=r"1,000,000,000 Gaussians need \d+\.\d+ GB .* are free"):
        read_shared_scene(path, ALONE)


def test_single_rank_copies_nothing(tmp_path: Path) -> None:
    write_scene(tmp_path / "scene.ply", wall())
    file, reader = read_shared_scene(tmp_path / "scene.ply", ALONE)
    assert reader
    assert torch.equal(file.scene.means, read_scene(tmp_path / "scene.ply").scene.means)
