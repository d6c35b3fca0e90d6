"""Tests that camera files of many tools give the same three cameras, and that others name the way out.

The files in `captures` have the form in which each tool writes them; those of `colmap4_rig` are written by COLMAP.
"""

from __future__ import annotations

import contextlib
import json
import random
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from PIL import Image

from sgsst_core.errors import CameraError
from sgsst_core.files.advice import advice_for_name
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.camera_folder import cameras_beside
from sgsst_core.files.photos import check_photos
from sgsst_core.scene.camera import Camera, undistorted
from tests.sgsst_core.files.test_camera_files import HEIGHT, WIDTH, colmap, inria, nerfstudio, views
from tests.small_scenes import LFS_POINTER

CAPTURES = Path(__file__).parent / "captures"
#: nerfstudio's axes: x, z, -y of COLMAP's world.
NERFSTUDIO = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)


def assert_close(actual: list[Camera], expected: list[Camera], world: torch.Tensor | None = None) -> None:
    """Compare cameras, in a world that is rotated by a matrix [3, 3]."""
    assert len(actual) == len(expected)
    for a, b in zip(actual, expected, strict=True):
        assert (a.width, a.height, a.fx, a.fy, a.cx, a.cy) == pytest.approx((b.width, b.height, b.fx, b.fy, b.cx, b.cy))
        pose = b.world_to_camera.clone()
        if world is not None:
            pose[:3, :3] = pose[:3, :3] @ world.T
        assert torch.allclose(a.world_to_camera, pose, atol=1e-5)


@pytest.mark.parametrize(
    ("tool", "scene", "cameras"),
    [
        ("inria", "scene.ply", "cameras.json"),
        ("nerfstudio", "scene.ply", "transforms.json"),
        ("metashape", "scene.ply", "sparse/0"),
        ("inria", "point_cloud/iteration_30000/point_cloud.ply", "cameras.json"),
        ("inria", "exports/1/scene.ply", None),
    ],
)
def test_cameras_beside_a_scene_are_found(tmp_path: Path, tool: str, scene: str, cameras: str | None) -> None:
    shutil.copytree(CAPTURES / tool, tmp_path, dirs_exist_ok=True)
    assert cameras_beside(tmp_path / scene) == (None if cameras is None else tmp_path / cameras)


def test_only_file_with_cameras_beside_a_scene_is_found(tmp_path: Path) -> None:
    (tmp_path / "plan.json").write_text("{}")
    assert cameras_beside(tmp_path / "scene.ply") is None
    shutil.copy(CAPTURES / "inria" / "cameras.json", tmp_path / "views.json")
    assert cameras_beside(tmp_path / "scene.ply") == tmp_path / "views.json"
    shutil.copy(CAPTURES / "inria" / "cameras.json", tmp_path / "others.json")
    with pytest.raises(CameraError, match="several files"):
        cameras_beside(tmp_path / "scene.ply")


@pytest.mark.parametrize(
    ("tool", "models"),
    [
        ("inria", [None, None, None]),
        ("opensplat", [None, None, None]),
        ("lichtfeld", [None, None, None]),
        ("polycam", [None, None, None]),
        ("record3d", [None, None, None]),
        ("metashape", [None, None, None]),
        ("colmap4_rig", ["SIMPLE_RADIAL"] * 3),
        ("realityscan", ["FULL_OPENCV"] * 3),
        ("frames", ["OPENCV_FISHEYE", None, "OPENCV"]),
    ],
)
def test_folders_of_many_tools_give_the_same_cameras(tool: str, models: list[str | None]) -> None:
    cameras = read_cameras(CAPTURES / tool)
    assert_close(cameras, views())
    assert [view.lens and view.lens.model for view in cameras] == models


def test_nerfstudio_cameras_have_nerfstudio_axes() -> None:
    cameras = read_cameras(CAPTURES / "nerfstudio")
    assert_close(cameras, views(), NERFSTUDIO)
    assert {view.lens and view.lens.coefficients[:4] for view in cameras} == {(0.05, -0.01, 0.001, -0.0005)}


def test_nerfstudio_training_cameras_match_the_trained_scene() -> None:
    """The training frame is scale * (T0 x), where `transform` is T0 times `applied_transform`."""
    stored = json.loads((CAPTURES / "nerfstudio_trained" / "dataparser_transforms.json").read_text())
    transform = torch.tensor(stored["transform"], dtype=torch.float64)
    points = torch.randn(20, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    trained = stored["scale"] * (points @ transform[:, :3].T + transform[:, 3])
    for view, expected in zip(read_cameras(CAPTURES / "nerfstudio_trained"), views(), strict=True):
        local = trained @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]
        original = points @ expected.world_to_camera[:3, :3].T + expected.world_to_camera[:3, 3]
        assert torch.allclose(local, stored["scale"] * original, atol=1e-9)


def photos_of_blender(folder: Path) -> Path:
    for view in views():
        path = folder / "train" / view.name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGBA", (WIDTH, HEIGHT)).save(path)
    return folder


def test_blender_sizes_come_from_photos(tmp_path: Path) -> None:
    elsewhere = photos_of_blender(tmp_path)
    assert_close(read_cameras(CAPTURES / "blender", elsewhere), views())
    assert_close(read_cameras(CAPTURES / "blender", elsewhere / "train"), views())
    with pytest.raises(CameraError, match="gives no size, and there is no image of its name among the photos"):
        read_cameras(CAPTURES / "blender", tmp_path_without_photos(tmp_path))
    beside = tmp_path / "beside"
    shutil.copytree(CAPTURES / "blender", beside)
    photos_of_blender(beside)
    assert_close(read_cameras(beside), views())
    assert [photo and photo.path.parent.name for photo in check_photos(beside, read_cameras(beside))] == ["train"] * 3


def tmp_path_without_photos(folder: Path) -> Path:
    (folder / "empty").mkdir()
    return folder / "empty"


def test_sizes_are_never_read_outside_the_photo_folder(tmp_path: Path) -> None:
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "secret.png")
    (tmp_path / "photos").mkdir()
    content = json.loads((CAPTURES / "blender" / "transforms_train.json").read_text())
    for name in ("../secret.png", str(tmp_path / "secret.png")):
        content["frames"] = [content["frames"][0] | {"file_path": name}]
        file = tmp_path / "photos" / "transforms.json"
        file.write_text(json.dumps(content))
        assert read_cameras(file)[0].width == WIDTH
        with pytest.raises(CameraError, match="no image of its name among the photos"):
            read_cameras(file, tmp_path / "photos")


def test_half_size_photos_match_full_size_cameras(tmp_path: Path) -> None:
    (tmp_path / "images_2").mkdir()
    for view in views():
        Image.new("RGB", (WIDTH // 2, HEIGHT // 2)).save(tmp_path / "images_2" / view.name)
    for capture in ("frames", "metashape"):
        cameras = read_cameras(CAPTURES / capture)
        for folder in (tmp_path, tmp_path / "images_2"):
            photos = check_photos(folder, cameras)
            assert [photo and photo.size for photo in photos] == [(WIDTH // 2, HEIGHT // 2)] * 3


@pytest.mark.parametrize("place", ["sparse/0", "sparse/1", "sparse", "colmap/sparse/0", "."])
def test_colmap_project_layouts_are_read(tmp_path: Path, place: str) -> None:
    shutil.copytree(CAPTURES / "metashape" / "sparse" / "0", tmp_path / "project" / place)
    for name in ("points3D.txt", "points3D.bin"):
        (tmp_path / "project" / place / name).unlink(missing_ok=True)
    assert_close(read_cameras(tmp_path / "project"), views())


def test_project_prefers_its_first_model_and_own_transforms(tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(CAPTURES / "metashape" / "sparse" / "0", project / "colmap" / "sparse" / "0")
    shutil.copy(CAPTURES / "nerfstudio" / "transforms.json", project)
    assert_close(read_cameras(project), views(), NERFSTUDIO)
    for model in ("10", "2", "1"):
        shutil.copytree(CAPTURES / "colmap4_rig" / "sparse" / "0", project / "sparse" / model)
    shutil.copytree(CAPTURES / "realityscan" / "sparse" / "1", project / "sparse" / "1", dirs_exist_ok=True)
    assert [view.name for view in read_cameras(project)] == [f"cam{index}/0001.jpg" for index in range(3)]
    shutil.rmtree(project / "sparse" / "1")
    (project / "sparse" / "2" / "cameras.bin").unlink()
    (project / "sparse" / "2" / "images.bin").unlink()
    shutil.copytree(CAPTURES / "metashape" / "sparse" / "0", project / "sparse" / "2", dirs_exist_ok=True)
    assert [view.name for view in read_cameras(project)] == [view.name for view in views()]


@pytest.mark.parametrize("given", ["", "sparse", "sparse/0", "sparse/0/images.bin"])
def test_larger_model_beside_is_named(tmp_path: Path, given: str) -> None:
    for model, count in (("0", 2), ("1", 3), ("2", 5)):
        colmap(tmp_path / "sparse" / model, views(count), text=model != "0")
    notes: list[str] = []
    if given == "sparse":
        with pytest.raises(CameraError, match=rf"but {tmp_path}/sparse/2 has a COLMAP model. Give that folder"):
            read_cameras(tmp_path / given)
        return
    assert len(read_cameras(tmp_path / given, None, notes.append)) == 2
    (note,) = notes
    assert note.startswith(f"{tmp_path}/sparse/0 has 2 images, and the model {tmp_path}/sparse/2 beside it 5. ")
    assert f"Add --cameras {tmp_path}/sparse/2 if" in note
    read_cameras(tmp_path / "sparse" / "2", None, pytest.fail)


@pytest.mark.parametrize("name", ["transform_train.json", "my cameras.json", "transforms_val.json"])
@pytest.mark.parametrize("content", [inria(views()), nerfstudio(views())])
def test_the_only_json_with_cameras_is_read(tmp_path: Path, name: str, content: Any) -> None:
    (tmp_path / name).write_text(json.dumps(content))
    for other, text in (("settings.json", "{}"), ("broken.json", "{"), ("list.json", "[[1]]")):
        (tmp_path / other).write_text(text)
    assert_close(read_cameras(tmp_path), views())
    (tmp_path / "other.json").write_text(json.dumps(content))
    names = ", ".join(sorted([name, "other.json"]))
    with pytest.raises(CameraError, match=f"holds several files with cameras: {names}. Give one"):
        read_cameras(tmp_path)


def test_folders_without_cameras_name_what_was_looked_at(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(CameraError, match=r"a\.json: is neither JSON"):
        read_cameras(tmp_path)
    (tmp_path / "b.json").write_text("{}")
    with pytest.raises(CameraError, match=r"holds no cameras in a known format \(looked at a\.json, b\.json\)"):
        read_cameras(tmp_path)


@pytest.mark.parametrize(
    "name",
    ["cameras.json", "any.json", "transforms.json", "images.bin", "cameras.bin", "images.txt", "cameras.txt", "c.csv"],
)
@pytest.mark.parametrize("folder", [False, True])
def test_pointers_of_git_lfs_are_named(tmp_path: Path, name: str, folder: bool) -> None:
    if name[-3:] in ("bin", "txt"):
        colmap(tmp_path / "model", views(), text=name.endswith("txt"))
    path = tmp_path / "model" / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(LFS_POINTER)
    if folder and name == "c.csv":
        return
    with pytest.raises(CameraError, match=rf"{name}: is a pointer of Git LFS, not the file itself. Run `git lfs pull`"):
        read_cameras(path.parent if folder else path)


def test_rig_capture_has_no_points_file(tmp_path: Path) -> None:
    names = {path.name for path in (CAPTURES / "colmap4_rig" / "sparse" / "0").iterdir()}
    assert names == {"cameras.bin", "images.bin", "rigs.bin", "frames.bin"}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cameras.xml", '<?xml version="1.0"?>\n<document version="2.0.0">\n <chunk label="1">', "Metashape.*--xml"),
        ("cameras.csv", "\ufeff#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2\na.jpg,1,2,3", "RealityCapture.*--csv"),
        ("bundle.out", "# Bundle file v0.3\n3 100\n", "a Bundler file.*automatic_reconstructor"),
        ("database.db", "SQLite format 3\0", "database of COLMAP, which has no poses.*sparse/0"),
        ("scan.r3d", "PK\3\4", "data of Record3D.*ns-process-data record3d"),
        ("metadata.json", '{"w": 1920, "h": 1440, "K": [1], "poses": [[0, 0, 0, 1, 0, 0, 0]]}', "data of Record3D"),
        ("1.json", '{"t_00": 1, "t_01": 0, "t_23": 4, "fx": 500}', "raw data of Polycam"),
        ("reconstruction.json", '[{"cameras": {}, "shots": {}, "points": {}}]', "OpenSfM.*export_colmap"),
        ("sfm_data.json", '{"sfm_data_version": "0.3", "views": []}', "OpenMVG.*openMVG2Colmap"),
        ("transforms_train.json", '[{"file_path": "a.png", "transform": []}]', "`ns-export cameras`.*no focal"),
        ("b.xml", '<?xml version="1.0"?>\n<BlocksExchange version="3.2">', "a BlocksExchange file.*as a COLMAP model"),
        ("scan.rcproj", '<RealityCaptureProject id="1"/>', "RealityCapture.*in COLMAP's format"),
        ("a.xmp", "<x:xmpmeta/>", "RealityCapture.*in COLMAP's format"),
        ("scan.psx", '<?xml version="1.0"?>\n<document version="1.2.0"/>', "a project of Metashape.*as Colmap"),
        ("poses_bounds.npy", "\x93NUMPY", "poses of LLFF.*Give the COLMAP model"),
        ("cameras_sphere.npz", "PK\3\4", "data set for NeuS"),
        ("cameras.sfm", '{"version": [], "views": [], "intrinsics": [], "poses": []}', "Meshroom.*ExportColmap"),
        ("cameras.json", '{"views": [], "intrinsics": [], "poses": []}', "Meshroom"),
        ("p_calibrated_external_camera_parameters.txt", "imageName X Y Z Omega Phi Kappa\n", "parameters of Pix4D"),
        ("model.nvm", "NVM_V3\n\n5", "VisualSFM"),
        ("c.abc", "Ogawa", "an animation file"),
        ("c.fbx", "Kaydara FBX Binary", "an animation file"),
        ("camera_path.json", '{"camera_type": "perspective", "camera_path": []}', "nerfstudio's viewer"),
        ("poses.json", '[{"name": "0", "position": [1], "target": [0]}]', "poses or settings of SuperSplat"),
        ("settings.json", '{"tonemapping": "none", "cameras": []}', "poses or settings of SuperSplat"),
        ("capture.zip", "PK\3\4", "an archive. Unpack it"),
    ],
)  # fmt: skip
def test_unsupported_formats_suggest_a_conversion(tmp_path: Path, name: str, content: str, message: str) -> None:
    path = tmp_path / name
    path.write_text(content, encoding="utf-8")
    with pytest.raises(CameraError, match=rf"{name}: is .*{message}"):
        read_cameras(path)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("keyframes/corrected_cameras/1.json", "raw data of Polycam"),
        ("EXR_RGBD/metadata.json", "data of Record3D"),
        ("opensfm/reconstruction.json", "OpenSfM"),
        ("sfm_data.json", "OpenMVG"),
        ("bundle.out", "Bundler"),
    ],
)
def test_unsupported_folders_suggest_a_conversion(tmp_path: Path, name: str, message: str) -> None:
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("{}")
    with pytest.raises(CameraError, match=message):
        read_cameras(tmp_path)


@pytest.mark.parametrize("name", sorted(str(path.relative_to(CAPTURES)) for path in CAPTURES.rglob("*.*")))
def test_damaged_files_are_read_or_refused_with_a_message(tmp_path: Path, name: str) -> None:
    """Cameras that are read have a usable frame, or their lens is refused."""
    project = tmp_path / "project"
    shutil.copytree(CAPTURES / Path(name).parts[0], project)
    file = project / Path(*Path(name).parts[1:])
    data = file.read_bytes()
    photos = photos_of_blender(tmp_path / "photos") if "blender" in name else None
    generator = random.Random(name)
    for _ in range(60):
        damaged = bytearray(data)
        for _ in range(generator.choice((1, 1, 2, 8))):
            position = generator.randrange(len(damaged))
            match generator.randrange(4):
                case 0:
                    damaged[position] = generator.randrange(256)
                case 1:
                    damaged[position : position + 1] = generator.choice((b"9", b"-", b"e9", b".", b"[", b'"', b"null"))
                case 2:
                    del damaged[position : position + generator.choice((1, 8, 100))]
                case 3:
                    damaged[position:position] = damaged[position : position + generator.choice((1, 8, 100))]
            if not damaged:
                break
        file.write_bytes(damaged)
        with contextlib.suppress(CameraError):
            for view in read_cameras(project, photos):
                reduced = undistorted(view)
                assert 1 <= reduced.width <= view.width
                assert 1 <= reduced.height <= view.height


def test_file_name_suggests_a_format() -> None:
    assert advice_for_name("My Export.CSV").startswith(" It may be cameras of RealityCapture. ")
    assert advice_for_name("data.ZIP").startswith(" It may be an archive. Unpack it")
    assert advice_for_name("cameras.doc") == ""


def test_frame_pinhole_overrides_the_files_lens() -> None:
    pinhole = read_cameras(CAPTURES / "frames")[1]
    assert pinhole == replace(pinhole, lens=None)
