"""Tests of selecting the Gaussians of regions, and of the memory that a scene needs."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from sgsst_core import container
from sgsst_core.errors import ImageError, SceneError, SceneTooLargeError
from sgsst_core.files.formats import EXTRA_FORMATS
from sgsst_core.files.formats.spz import SPZ
from sgsst_core.files.images import save_png
from sgsst_core.files.scene_file import SceneFile, read_scene, write_scene
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.gaussians import Scene
from tests.sgsst_core.files.formats.samples import rewritten
from tests.small_scenes import cameras, wall, write_files
from tests.worker.ranks.spawn import on_ranks
from worker.inputs import check_memory, cropped, load_styles, select, select_regions, together
from worker.options import RegionRequest, parse_selection


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


def test_compressed_scene_needs_memory_of_its_floats(tmp_path: Path) -> None:
    """The requirement follows from the header, before the scene is decompressed."""
    path = tmp_path / "scene"
    for format in EXTRA_FORMATS:
        write_scene(path, wall(sh_degree=3), format)
        little = patch.object(container, "memory", return_value=container.Memory(1 << 40, 616 * 4 * 59))
        with little, pytest.raises(SceneTooLargeError, match="616 Gaussians need"):
            check_memory(path, ALONE)


def read_by_second_rank(collectives: Collectives, path: Path) -> str:
    """Read a scene on rank 1 alone, and return the error message of this rank."""
    with pytest.raises(SceneError) as caught:
        together(collectives, lambda: read_scene(path) if collectives.rank else None)
    return str(caught.value)


def test_invalid_scene_is_refused_on_every_rank(tmp_path: Path) -> None:
    scene = wall()
    scene.scales[3, 1] = float("nan")
    write_scene(tmp_path / "scene.ply", scene)
    messages = on_ranks(2, read_by_second_rank, tmp_path / "scene.ply")
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
        check_memory(path, ALONE)
