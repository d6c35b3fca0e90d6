"""Tests that cameras and photos are read together, and that the plan reports what was done to them."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from api.cli.scene_tools import render_panorama
from sgsst_core.errors import CameraError, ImageError
from sgsst_core.files.formats import by_name
from sgsst_core.files.images import BLACK, check_names, find_masks, load_photo, save_png
from sgsst_core.files.scene_file import read_scene, write_scene
from sgsst_core.planning.survey import shown_by
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import FACES, look_at
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering
from sgsst_core.scene.spherical_harmonics import scene_colors
from tests.sgsst_core.objects import figure, ground, joined
from tests.small_scenes import ball, blind_camera, cameras, wall, write_files
from worker import inputs
from worker.derived import video_cameras
from worker.inputs import Capture, about_notes, about_rendering, choose_axes, read_capture, read_scene_and_capture
from worker.job import SceneRequest
from worker.options import VideoOptions

SCENE = wall()


def request(folder: Path, **options: Any) -> SceneRequest:
    ply, file, _ = write_files(folder, SCENE)
    return SceneRequest(scene=ply, cameras=file, **options)


def lines(capture: Capture) -> list[str]:
    return [f"{line.item}: {line.decision}: {line.reason}" for line in capture.decisions]


def write_photos(folder: Path, names: list[str], size: tuple[int, int] = (64, 48)) -> Path:
    folder.mkdir()
    for name in names:
        Image.linear_gradient("L").resize(size).save(folder / f"{name}.png")
    return folder


def distorted(path: Path, count: int = 3, **values: Any) -> Path:
    """Write a transforms.json whose first `count` cameras have coefficients."""
    flip = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64).diag()
    frames = [
        {
            "file_path": view.name,
            "transform_matrix": (torch.linalg.inv(view.world_to_camera) @ flip).tolist(),
            **(values if index < count else {}),
        }
        for index, view in enumerate(cameras())
    ]
    path.write_text(json.dumps({"fl_x": 64, "w": 64, "h": 48, "frames": frames}))
    return path


def test_cameras_without_distortion_and_photos_need_no_line(tmp_path: Path) -> None:
    capture = read_capture(request(tmp_path), SCENE)
    assert lines(capture.with_photos(None).checked(SCENE, 0.2)) == []
    photos = write_photos(tmp_path / "photos", ["view_0", "view_1", "view_2"])
    assert lines(capture.with_photos(photos)) == []
    half = read_capture(request(tmp_path, resolution=32), SCENE).with_photos(photos)
    assert (lines(half), half.cameras[0].width) == ([], 32)


def test_photos_mostly_without_cameras_or_with_several_are_reported(tmp_path: Path) -> None:
    photos = write_photos(
        tmp_path / "photos", ["view_0", "view_1", "view_2", *(f"other_{index}" for index in range(5))]
    )
    (line,) = lines(read_capture(request(tmp_path), SCENE).with_photos(photos))
    assert line.startswith("photos: warning: 5 files are not used: they have the name of no camera: other_0.png, ")
    entries = json.loads((tmp_path / "cameras.json").read_text())
    entries[1]["img_name"] = "view_0"
    (tmp_path / "cameras.json").write_text(json.dumps(entries))
    capture = read_capture(SceneRequest(scene=tmp_path / "scene.ply", cameras=tmp_path / "cameras.json"), SCENE)
    shared = lines(capture.with_photos(photos))[0]
    assert shared.startswith(
        "photos: warning: 1 belong to several cameras each, of which they can show one: the names "
    )


def test_photos_may_have_another_size_and_missing_ones_are_reported(tmp_path: Path) -> None:
    capture = read_capture(request(tmp_path), SCENE)
    photos = write_photos(tmp_path / "photos", ["view_0", "view_2"], (128, 96))
    with_photos = capture.with_photos(photos)
    assert [view.name for view in with_photos.cameras] == ["view_0", "view_2"]
    assert lines(with_photos) == [
        "photos: warning: 1 of 3 views are left out: they have no photo: view_1",
    ]
    (photos / "view_7.png").write_bytes((photos / "view_2.png").read_bytes())
    assert "photos: 1 files are not used: they have the name of no camera: view_7.png" in lines(
        capture.with_photos(photos)
    )
    (photos / "view_2.png").unlink()
    with pytest.raises(ImageError, match="no photo for 2 of 3 views: view_1, view_2"):
        capture.with_photos(photos)


def test_distortion_is_ignored_without_photos_and_removed_from_them(tmp_path: Path) -> None:
    source = request(tmp_path).model_copy(update={"cameras": distorted(tmp_path / "transforms.json", 2, k1=0.2)})
    capture = read_capture(source, SCENE)
    plain = capture.with_photos(None)
    assert lines(plain) == [
        "lenses: only the pinhole part of the cameras is used: 2 of 3 cameras have lens distortion (OPENCV); renders "
        "have no distortion, and there are no photos to undistort"
    ]
    assert {(view.width, view.height) for view in plain.cameras} == {(64, 48)}
    photos = write_photos(tmp_path / "photos", ["view_0", "view_1", "view_2"])
    with_photos = capture.with_photos(photos)
    assert lines(with_photos)[0].startswith("lenses: the photos are undistorted: 2 of 3 cameras have lens distortion")
    sizes = [(view.width, view.height) for view in with_photos.cameras]
    assert sizes[0] == sizes[1] < sizes[2] == (64, 48)
    assert with_photos.photos
    assert load_photo(with_photos.photos[0], with_photos.cameras[0]).shape == (*sizes[0][::-1], 3)


def test_photos_of_lenses_without_a_formula_are_refused(tmp_path: Path) -> None:
    file = distorted(tmp_path / "transforms.json", camera_model="FISHEYE624")
    capture = read_capture(request(tmp_path).model_copy(update={"cameras": file}), SCENE)
    assert "lenses: only the pinhole part" in lines(capture.with_photos(None))[0]
    with pytest.raises(CameraError, match="FISHEYE624 cannot be undistorted here"):
        capture.with_photos(write_photos(tmp_path / "photos", ["view_0", "view_1", "view_2"]))


def panoramas(folder: Path, *, width: int = 256) -> Path:
    """Write a transforms.json with two panoramas at the first two `cameras`, and the last camera as a pinhole."""
    file = distorted(folder / "transforms.json", 2, camera_model="EQUIRECTANGULAR", w=width, h=width // 2)
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        frame["file_path"] = f"images/{frame['file_path']}.png"
    file.write_text(json.dumps(content))
    return file


def test_panoramas_become_cube_faces_with_their_photos(tmp_path: Path) -> None:
    """Photos are panoramas that are rendered of the scene, level as the cameras are."""
    source = request(tmp_path).model_copy(update={"cameras": panoramas(tmp_path)})
    capture = read_capture(source, SCENE)
    assert len(capture.cameras) == 13
    assert capture.names == tuple(f"images/view_{index}.png" for index in range(3))
    panorama = "cameras: 2 of 3 are panoramas, six views each: views are pinholes: one for each face of a cube"
    (line,) = lines(capture.with_photos(None).checked(SCENE, 0.2))
    assert line.startswith(panorama)
    photos = tmp_path / "images"
    photos.mkdir()
    for index in range(2):
        wide = source.model_copy(update={"resolution": 256})
        camera = render_panorama(wide, BLACK, f"images/view_{index}.png", photos / f"view_{index}.png")
        assert camera.name == f"images/view_{index}.png.front"
    rasterizer = make_rasterizer("cpu", SCENE)
    save_png(photos / "view_2.png", rasterizer.render(scene_colors(SCENE, capture.cameras[2]), capture.cameras[2]))
    with_photos = capture.with_photos(photos).checked(SCENE, 0.2)
    assert [text.partition(":")[0] for text in lines(with_photos)] == ["cameras"]
    assert with_photos.photos
    for photo, camera in zip(with_photos.photos, with_photos.cameras, strict=True):
        seen = load_photo(photo, camera)
        rendered = rasterizer.render(scene_colors(SCENE, camera), camera).clamp(0, 1)
        assert seen.shape == rendered.shape
        assert float((seen - rendered).square().mean().sqrt()) < 0.03, camera.name

    (photos / "view_1.png").unlink()
    missing = lines(capture.with_photos(photos))
    assert "photos: warning: 6 of 13 views are left out: they have no photo: images/view_1.png" in missing
    check_names(photos, capture.names)


def test_masks_of_panoramas_apply_to_their_faces(tmp_path: Path) -> None:
    cameras = read_capture(request(tmp_path).model_copy(update={"cameras": panoramas(tmp_path)}), SCENE).cameras
    (tmp_path / "masks").mkdir()
    upper_half = Image.new("L", (256, 128))
    upper_half.paste(255, (0, 0, 256, 64))
    upper_half.save(tmp_path / "masks" / "view_0.png.mask.png")
    masks = {view.name: mask for view, mask in zip(cameras, find_masks(tmp_path / "masks", cameras), strict=True)}
    assert [name for name, mask in masks.items() if mask] == [f"images/view_0.png.{face}" for face in FACES]
    expected = {"front": 0.5, "right": 0.5, "back": 0.5, "left": 0.5, "up": 1.0, "down": 0.0}
    for view in cameras:
        if mask := masks[view.name]:
            inside = float(load_photo(mask, view, color_managed=False).mean())
            assert inside == pytest.approx(expected[view.name.rpartition(".")[2]], abs=0.01)


def test_panoramas_say_nothing_about_the_coordinate_frame(tmp_path: Path) -> None:
    """Together, the faces of a panorama show a small object in any frame; most of them show nothing of it."""
    source = request(tmp_path).model_copy(update={"cameras": panoramas(tmp_path)})
    capture = read_capture(source, SCENE)
    alone = replace(capture, cameras=[view for view in capture.cameras if view.panorama])
    assert [line.item for line in alone.checked(ball(), 0.2).decisions] == ["cameras"]
    with pytest.raises(CameraError, match="sees a Gaussian"):
        capture.checked(rotated(SCENE), 0.2)  # the pinhole sees nothing


def test_cameras_between_the_centers_of_gaussians_see_a_sample_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inputs, "_MAX_GAUSSIANS", 2 * 154)
    scene, up = wall(), torch.tensor([0.0, -1.0, 0.0])
    close = look_at("close", torch.zeros(3), torch.tensor([0.0, 0.0, 3.0]), up, width=8, height=8, focal=400)
    assert shown_by(scene.means, [close], 0.2).together == 0
    inputs.check_something_in_view(scene, [blind_camera(), close], 0.2)
    with pytest.raises(CameraError, match="None of the 2 cameras sees a Gaussian"):
        inputs.check_something_in_view(scene, [blind_camera(), blind_camera()], 0.2)


def test_videos_lead_through_the_front_faces_of_panoramas(tmp_path: Path) -> None:
    source = request(tmp_path).model_copy(update={"cameras": panoramas(tmp_path)})
    through = read_capture(source, SCENE).cameras
    path = video_cameras(SCENE, source, through, VideoOptions(fps=3, seconds=1), 64, even=True)
    ends = [frame.world_to_camera for frame in (path[0], path[-1])]
    for pose, expected in zip(ends, (through[0], through[2]), strict=True):
        assert torch.allclose(pose, expected.world_to_camera, atol=1e-6)


def spz(folder: Path, scene: Scene) -> SceneRequest:
    """Write an SPZ file that does not state its axes."""
    path = folder / "scene.spz"
    write_scene(path, scene, by_name("v3.spz"), "rdf")
    return SceneRequest(scene=path, cameras=write_files(folder)[1])


def rotated(scene: Scene) -> Scene:
    """Return a scene whose positions are rotated by 180 degrees about x."""
    return replace(scene, means=scene.means * torch.tensor([1.0, -1.0, -1.0]))


def test_cameras_determine_axes_of_spz_without_stated_axes(tmp_path: Path) -> None:
    upright, other = tmp_path / "upright", tmp_path / "turned"
    for folder, scene in ((upright, SCENE), (other, rotated(SCENE))):
        folder.mkdir()
        source = spz(folder, scene)
        axes, about = choose_axes(source)
        assert axes == ("rub" if folder is other else "rdf")
        assert not read_scene(source.scene, spz_axes=axes).notes
        read = read_scene(source.scene, spz_axes=axes).scene
        assert torch.allclose(read.means, SCENE.means, atol=1e-3)
        assert len(about) == (folder is other)
    assert about[0].decision == "the scene is rotated by 180 degrees about x (rub: y up, z backward)"
    assert choose_axes(source.model_copy(update={"spz_axes": "rdf"}))[1] == []
    assert choose_axes(source.model_copy(update={"cameras": None, "orbit": 3}))[1] == []


def test_scene_that_cameras_see_under_both_axes_gets_a_note(tmp_path: Path) -> None:
    path, shift = tmp_path / "scene.spz", torch.eye(4, dtype=torch.float64)
    shift[2, 3] = 3
    views = [replace(view, world_to_camera=view.world_to_camera @ shift) for view in cameras()]
    centered = replace(ball(), means=ball().means - torch.tensor([0.0, 0.0, 3.0]))
    write_scene(path, centered, by_name("spz"))
    source = SceneRequest(scene=path, cameras=write_files(tmp_path, centered, views)[1])
    assert not describe_axes(source)
    remove_axes(path)
    note = "axes: read as rub; the file states none. If the scene is upside down, pass --spz-axes rdf"
    assert describe_axes(source) == note
    assert describe_axes(source.model_copy(update={"cameras": None, "orbit": 3})) == note
    assert not describe_axes(source.model_copy(update={"spz_axes": "rdf"}))


def describe_axes(source: SceneRequest) -> str:
    """Return what plans say about the axes of a scene."""
    return "".join(line.reason for line in about_notes(read_scene_and_capture(source)[0]))


def remove_axes(path: Path) -> None:
    """Remove the extension with the axes from an SPZ file of version 4 that was written by `write_scene`."""
    data = bytearray(path.read_bytes())
    data[14] &= ~2
    data[16:20] = (32).to_bytes(4, "little")
    path.write_bytes(bytes(data[:32] + data[44:]))


def test_up_direction_determines_axes_of_spz_without_stated_axes_or_cameras(tmp_path: Path) -> None:
    path, standing = tmp_path / "scene.spz", joined(ground(), figure())
    source = SceneRequest(scene=path, orbit=3)
    for scene, expected in ((standing, "rdf"), (rotated(standing), "rub"), (ball(), "auto")):
        write_scene(path, scene, by_name("spz"), "rdf")
        remove_axes(path)
        axes, about = choose_axes(source)
        assert axes == expected
        assert [line.item for line in about] == ["axes"] * (expected != "auto")
        assert len(read_scene_and_capture(source)[0].notes) == (expected == "auto")
        assert choose_axes(source.model_copy(update={"up": "y"})) == ("auto", [])
        write_scene(path, scene, by_name("spz"), "rdf")
        assert choose_axes(source) == ("auto", [])


@pytest.mark.parametrize(
    ("stated", "requested", "decisions", "reason"),
    [
        (CLASSIC, None, [], ""),
        (CLASSIC, ("antialiased", 0.1), ["antialiased, eps2d 0.1"], "as requested; the file states nothing"),
        (
            Rendering("antialiased"),
            None,
            ["antialiased, eps2d 0.3"],
            "the comment 'SplatRenderMode: mip' says so; see --render-mode and --eps2d",
        ),
        (
            Rendering("antialiased"),
            ("classic", None),
            ["classic, eps2d 0.3"],
            "as requested; the file states antialiased, eps2d 0.3",
        ),
        (Rendering("2dgs"), None, ["2dgs, eps2d 0.3", "warning: drawn as Gaussians without thickness"], None),
    ],
)
def test_plan_names_render_mode_and_warnings(
    tmp_path: Path, stated: Rendering, requested: Any, decisions: list[str], reason: str | None
) -> None:
    write_scene(tmp_path / "scene.ply", replace(ball(), rendering=stated))
    file = read_scene(tmp_path / "scene.ply")
    lines = about_rendering(file.rendered(*requested) if requested else file)
    assert [line.decision for line in lines] == decisions
    assert reason is None or "".join(line.reason for line in lines) == reason
    assert {line.item for line in lines} <= {"rendering"}
