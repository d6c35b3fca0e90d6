"""Tests of selecting the Gaussians of regions, and of reading a scene once per machine."""

import gc
import hashlib
import os
import socket
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement
from torch import Tensor

from sgsst_core import container
from sgsst_core.errors import ImageError, SceneError, SceneTooLargeError
from sgsst_core.files import scene_file
from sgsst_core.files.formats import EXTRA_FORMATS
from sgsst_core.files.formats.spz import SPZ
from sgsst_core.files.images import save_png
from sgsst_core.files.scene_file import SceneFile, read_scene, write_scene
from sgsst_core.orbit import orbit
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.spherical_harmonics import rest_colors
from sgsst_core.scene.stored_harmonics import StoredHarmonics, held
from tests.sgsst_core.files.formats.samples import rewritten
from tests.small_scenes import cameras, wall, write_files
from tests.worker.ranks.spawn import on_ranks
from worker.inputs import cropped, load_styles, read_shared_scene, select, select_regions
from worker.options import RegionRequest, parse_selection
from worker.processes import home


def region(name: str, spec: str, **values: Any) -> RegionRequest:
    return RegionRequest(name, parse_selection(spec, name), **values)


def labels_of(file: SceneFile, *requests: RegionRequest) -> list[int]:
    regions = select_regions(requests, file, cameras(), 0.2, load_styles)
    assert regions is not None
    return regions.labels.tolist()


@pytest.fixture
def file(tmp_path: Path) -> SceneFile:
    return read_scene(write_files(tmp_path, wall(6, 4))[0])


def test_later_region_wins_overlaps(file: SceneFile) -> None:
    wide, narrow = region("a", "half-space=1,0,0,-1"), region("b", "half-space=1,0,0,1")
    x = file.scene.means[:, 0]
    assert labels_of(file, wide, narrow) == [0 if v < -1 else 1 if v < 1 else 2 for v in x.tolist()]
    assert labels_of(file, narrow, wide) == [0 if v < -1 else 2 for v in x.tolist()]
    regions = select_regions((narrow, wide), file, cameras(), 0.2, load_styles)
    assert regions is not None
    assert [each.selected for each in regions.every] == [0, int((x >= 1).sum()), int((x >= -1).sum())]


def test_crop_leaves_what_is_not_frozen_if_the_rest_is(file: SceneFile) -> None:
    right, far, x = region("a", "half-space=1,0,0,-1"), region("b", "half-space=1,0,0,1"), file.scene.means[:, 0]
    rest = RegionRequest("rest", freeze=True)
    remaining = cropped([right, rest], file, 0.2)
    assert remaining is not None
    assert remaining.tolist() == (x >= -1).tolist()
    between = cropped([right, replace(far, freeze=True), rest], file, 0.2)
    assert between is not None
    assert between.tolist() == ((x >= -1) & (x < 1)).tolist()
    for requests in ([right], [replace(right, freeze=True)], [region("a", "half-space=1,0,0,-9"), rest], [rest]):
        assert cropped(requests, file, 0.2) is None


@pytest.mark.parametrize("kind", ["i4", "u1", "f8", "f4"])
@pytest.mark.parametrize("form", ["text", "little", "big"])
def test_extra_properties_are_selectable(tmp_path: Path, kind: str, form: str) -> None:
    path = write_files(tmp_path, wall(6, 4))[0]
    values = np.arange(24).astype(kind)
    rewritten(path, path.name, lambda name: kind if name == "extra" else "f4", form=form, extra=values)
    selection = parse_selection("property=extra>=20", "a")
    assert select(selection, read_scene(path), cameras(), 0.2).tolist() == (values >= 20).tolist()
    assert int(select(parse_selection("property=extra=7", "a"), read_scene(path), cameras(), 0.2).sum()) == 1


def test_standard_properties_are_selectable_in_every_format(tmp_path: Path, file: SceneFile) -> None:
    packed = tmp_path / "wall.spz"
    write_scene(packed, file.scene, SPZ)
    for source in (file, read_scene(packed)):
        assert select(parse_selection("property=opacity>4", "a"), source, cameras(), 0.2).all()
        assert not select(parse_selection("property=z<2", "a"), source, cameras(), 0.2).any()
        with pytest.raises(SceneError, match=r"no property 'extra'. There are f_dc_0, "):
            select(parse_selection("property=extra>4", "a"), source, cameras(), 0.2)


def test_dropped_rows_are_dropped_from_masks_and_properties(tmp_path: Path) -> None:
    path = write_files(tmp_path, wall(6, 4))[0]
    rewritten(path, path.name, lambda _: "f4", extra=np.arange(24))
    rows = PlyData.read(path)["vertex"].data.copy()
    rows["x"][3] = np.nan
    PlyData([PlyElement.describe(rows, "vertex")]).write(path)
    file = read_scene(path, drop_invalid=True)
    mask = np.zeros(24)
    mask[[3, 5]] = 1
    np.save(tmp_path / "m.npy", mask)
    (tmp_path / "m.bin").write_bytes(np.packbits(mask.astype(bool), bitorder="little").tobytes())
    wanted = [0, 0, 0, 0, 1, *[0] * 18]  # the file's row 5 is the scene's row 4
    for name in ("m.npy", "m.bin"):
        assert labels_of(file, region("a", f"mask={tmp_path}/{name}")) == wanted
    assert labels_of(file, region("a", "property=extra=5")) == wanted


@pytest.mark.parametrize("in_alpha", [False, True])
def test_image_masks_of_some_views_select_gaussians(tmp_path: Path, in_alpha: bool) -> None:
    """The masks are white or opaque where the right half of the scene is drawn. One of the views has no mask."""
    scene: Scene = wall()
    file = read_scene(write_files(tmp_path, scene)[0])
    views, folder = cameras(), tmp_path / "masks"
    folder.mkdir()
    right = (scene.means[:, 0] > 0).float()[:, None].expand(-1, 3).contiguous()
    for view in views[:2]:
        mask = Image.fromarray((make_rasterizer("cpu", scene).render(right, view) * 255).round().byte().numpy())
        if in_alpha:
            mask, alpha = Image.new("RGBA", mask.size, "white"), mask.getchannel(0)
            mask.putalpha(alpha)
        mask.save(folder / f"{view.name}.png")
    selected = select(parse_selection(f"masks={folder}", "a"), file, views, 0.2)
    clear = scene.means[:, 0].abs() > 0.15
    assert torch.equal(selected[clear], scene.means[clear, 0] > 0)


def test_invalid_mask_folders_are_refused(tmp_path: Path, file: SceneFile) -> None:
    views, empty = cameras(), tmp_path / "none"
    empty.mkdir()
    for folder, message in ((tmp_path / "nowhere", "not a folder of masks"), (empty, "no mask for any of 3 views")):
        with pytest.raises(ImageError, match=message):
            labels_of(file, region("a", f"masks={folder}"))
    save_png(empty / f"{views[0].name}.png", torch.zeros(10, 64, 3))
    with pytest.raises(ImageError, match="another aspect"):
        labels_of(file, region("a", f"masks={empty}"))


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
    assert ([rank[0] for rank in results], [rank[1] for rank in results]) == ([alone] * 3, [True, False, False])
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
