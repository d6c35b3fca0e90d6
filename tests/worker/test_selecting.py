"""Tests of selecting the Gaussians of regions in a loaded scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from plyfile import PlyData, PlyElement

from sgsst_core.errors import ImageError, SceneError, SettingsError
from sgsst_core.files.formats.spz import SPZ
from sgsst_core.files.images import save_png
from sgsst_core.files.scene_file import SceneFile, read_scene, write_scene
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.gaussians import Scene
from sgsst_core.style import Style
from tests.small_scenes import cameras, wall, write_files
from worker.inputs import cropped, load_styles, select, select_regions
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


def with_property(path: Path, values: np.ndarray, *, text: bool = False, order: str = "<") -> None:
    """Add a property `extra` with these values to a PLY file."""
    rows = PlyData.read(path)["vertex"].data
    kinds = [*rows.dtype.descr, ("extra", values.dtype.newbyteorder("=").str)]
    more = np.empty(len(rows), kinds)
    for name in rows.dtype.names or ():
        more[name] = rows[name]
    more["extra"] = values
    PlyData([PlyElement.describe(more, "vertex")], text=text, byte_order=order).write(path)


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
@pytest.mark.parametrize(("text", "order"), [(True, "="), (False, "<"), (False, ">")])
def test_extra_properties_are_selectable(tmp_path: Path, kind: str, text: bool, order: str) -> None:
    path = write_files(tmp_path, wall(6, 4))[0]
    values = np.arange(24).astype(kind)
    with_property(path, values, text=text, order=order)
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
    scene = wall(6, 4)
    scene.means[3, 0] = torch.nan
    path = write_files(tmp_path, wall(6, 4))[0]
    with_property(path, np.arange(24).astype("f4"))
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


def test_image_masks_of_some_views_select_gaussians(tmp_path: Path) -> None:
    """The masks are white where the right half of the scene is drawn. One of the views has no mask."""
    scene: Scene = wall()
    file = read_scene(write_files(tmp_path, scene)[0])
    views, folder = cameras(), tmp_path / "masks"
    folder.mkdir()
    right = (scene.means[:, 0] > 0).float()[:, None].expand(-1, 3).contiguous()
    for view in views[:2]:
        save_png(folder / f"{view.name}.png", make_rasterizer("cpu", scene).render(right, view))
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


def test_freezing_every_gaussian_is_refused(file: SceneFile) -> None:
    everything = region("a", "half-space=1,0,0,-100", freeze=True)
    with pytest.raises(SettingsError, match=r"Every Gaussian is frozen \(a\)"):
        labels_of(file, everything)
    assert select_regions((), file, cameras(), 0.2, load_styles) is None


def test_region_styles_are_loaded(tmp_path: Path, file: SceneFile) -> None:
    from worker.options import StyleFile

    save_png(tmp_path / "s.png", torch.full((8, 8, 3), 0.5))
    request = region("a", "half-space=1,0,0,0", styles=(StyleFile(tmp_path / "s.png"),), weight=2.0)
    regions = select_regions((request,), file, cameras(), 0.2, load_styles)
    assert regions is not None
    assert isinstance(regions.every[1].style, Style)
    assert (regions.every[1].style.names, regions.every[1].weight, regions.every[1].select) == (
        ("s.png",),
        2.0,
        "half-space=1,0,0,0",
    )


def test_masks_in_the_alpha_channel_select_what_is_opaque(tmp_path: Path) -> None:
    scene: Scene = wall()
    file = read_scene(write_files(tmp_path, scene)[0])
    view = cameras()[0]
    (tmp_path / "masks").mkdir()
    right = (scene.means[:, 0] > 0).float()[:, None].expand(-1, 3).contiguous()
    alpha = (make_rasterizer("cpu", scene).render(right, view)[..., 0] * 255).round().to(torch.uint8)
    image = Image.new("RGBA", (view.width, view.height), "white")
    image.putalpha(Image.fromarray(alpha.numpy()))
    image.save(tmp_path / "masks" / f"{view.name}.png")
    selected = select(parse_selection(f"masks={tmp_path / 'masks'}", "a"), file, [view], 0.2)
    clear = scene.means[:, 0].abs() > 0.15
    assert torch.equal(selected[clear], scene.means[clear, 0] > 0)
