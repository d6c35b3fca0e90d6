"""Tests of camera files in all formats, and of the same capture as written by many tools."""

import contextlib
import json
import math
import os
import random
import shutil
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from PIL import Image

from sgsst_core.errors import CameraError
from sgsst_core.files import camera_folder as colmap_model
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.camera_folder import cameras_beside
from sgsst_core.files.images import check_photos, find_masks, image_size
from sgsst_core.scene.camera import FACES, Camera, cube_faces, look_at, undistorted
from tests.small_scenes import LFS_POINTER

WIDTH, HEIGHT = 640, 480


def views(count: int = 3) -> list[Camera]:
    """Return cameras with arbitrary poses, focal length 500 and a centered principal point."""
    generator = torch.Generator().manual_seed(3)
    positions = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 4
    up = torch.tensor([0.1, -1.0, 0.2], dtype=torch.float64)
    return [
        look_at(f"img_{i}.png", position, torch.zeros(3), up, width=WIDTH, height=HEIGHT, focal=500.0)
        for i, position in enumerate(positions)
    ]


def camera_to_world(view: Camera) -> np.ndarray:
    return torch.linalg.inv(view.world_to_camera).numpy()


def inria(cameras: list[Camera]) -> list[dict[str, Any]]:
    return [
        {
            "id": i,
            "img_name": view.name,
            "width": view.width,
            "height": view.height,
            "position": camera_to_world(view)[:3, 3].tolist(),
            "rotation": camera_to_world(view)[:3, :3].tolist(),
            "fx": view.fx,
            "fy": view.fy,
        }
        for i, view in enumerate(cameras)
    ]


def nerfstudio(cameras: list[Camera]) -> dict[str, Any]:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": "./images/" + view.name, "transform_matrix": (camera_to_world(view) @ flip).tolist()}
        for view in cameras
    ]
    lens = {"fl_x": 500.0, "fl_y": 500.0, "cx": WIDTH / 2, "cy": HEIGHT / 2, "w": WIDTH, "h": HEIGHT}
    return {"camera_model": "OPENCV", "k1": 0.0, "p2": 0, **lens, "frames": frames}


def colmap(folder: Path, cameras: list[Camera], *, text: bool, model: str = "PINHOLE") -> Path:
    """Write a sparse COLMAP model without pycolmap, following the page "Output Format" of COLMAP's documentation."""
    folder.mkdir(parents=True)
    number, values = {
        "SIMPLE_PINHOLE": (0, [500.0, WIDTH / 2, HEIGHT / 2]),
        "PINHOLE": (1, [500.0, 500.0, WIDTH / 2, HEIGHT / 2]),
        "SIMPLE_RADIAL": (2, [500.0, WIDTH / 2, HEIGHT / 2, 0.0]),
        "OPENCV": (4, [500.0, 500.0, WIDTH / 2, HEIGHT / 2, 0.0, 0.0, 0.0, 0.0]),
    }[model]
    poses = []
    for view in cameras:
        x, y, z, w = pycolmap.Rotation3d(view.world_to_camera[:3, :3].numpy()).quat
        poses.append([w, x, y, z, *view.world_to_camera[:3, 3].tolist()])
    order = list(reversed(range(len(cameras))))  # ids are not in the order of the names
    if text:
        (folder / "cameras.txt").write_text(f"# cameras\n1 {model} {WIDTH} {HEIGHT} {' '.join(map(repr, values))}\n")
        lines = [f"{i + 1} {' '.join(repr(float(p)) for p in poses[i])} 1 {cameras[i].name}\n\n" for i in order]
        (folder / "images.txt").write_text("# images\n" + "".join(lines))
        (folder / "points3D.txt").write_text("# points\n")
        return folder
    lens = struct.pack(f"<QIiQQ{len(values)}d", 1, 1, number, WIDTH, HEIGHT, *values)
    (folder / "cameras.bin").write_bytes(lens)
    data = struct.pack("<Q", len(cameras))
    for rank, i in enumerate(order):
        points = struct.pack("<Q", rank) + struct.pack("<ddq", 1.5, 2.5, -1) * rank
        data += struct.pack("<I7dI", rank + 1, *poses[i], 1) + cameras[i].name.encode() + b"\0" + points
    (folder / "images.bin").write_bytes(data)
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", 0))
    return folder


def save(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def assert_close(
    actual: list[Camera], expected: list[Camera], world: torch.Tensor | None = None, *, atol: float = 1e-5
) -> None:
    """Compare cameras, in a world that is rotated by a matrix [3, 3]."""
    assert len(actual) == len(expected)
    for a, b in zip(actual, expected, strict=True):
        assert (a.width, a.height, a.fx, a.fy, a.cx, a.cy) == pytest.approx((b.width, b.height, b.fx, b.fy, b.cx, b.cy))
        pose = b.world_to_camera.clone()
        if world is not None:
            pose[:3, :3] = pose[:3, :3] @ world.T
        assert torch.allclose(a.world_to_camera, pose, atol=atol)


def assert_same(actual: list[Camera], expected: list[Camera], names: Callable[[str], str] = lambda name: name) -> None:
    assert [view.name for view in actual] == [names(view.name) for view in expected]
    assert {view.world_to_camera.dtype for view in actual} == {torch.float64}
    assert_close(actual, expected, atol=1e-12)


def test_inria_cameras_are_read(tmp_path: Path) -> None:
    cameras = list(reversed(views()))
    assert_same(read_cameras(save(tmp_path / "any_name.json", inria(cameras))), cameras)
    save(tmp_path / "cameras.json", inria(cameras))
    assert_same(read_cameras(tmp_path), cameras)


def test_nerfstudio_cameras_are_read(tmp_path: Path) -> None:
    cameras = list(reversed(views()))
    path = save(tmp_path / "transforms.json", nerfstudio(cameras))
    assert_same(read_cameras(path), cameras, lambda name: f"images/{name}")
    assert_same(read_cameras(tmp_path), cameras, lambda name: f"images/{name}")


def test_nerfstudio_frames_may_have_own_intrinsics(tmp_path: Path) -> None:
    content = nerfstudio(views(2))
    content["frames"][1] |= {"fl_x": 300.0, "fl_y": 310.0, "cx": 99.0, "cy": 101.0, "w": 200, "h": 200.0}
    content["frames"][1]["transform_matrix"] = content["frames"][1]["transform_matrix"][:3]
    first, second = read_cameras(save(tmp_path / "t.json", content))
    assert (first.fx, first.fy, first.cx, first.cy, first.width, first.height) == (500, 500, 320, 240, 640, 480)
    assert (second.fx, second.fy, second.cx, second.cy, second.width, second.height) == (300, 310, 99, 101, 200, 200)
    assert torch.allclose(second.world_to_camera, views(2)[1].world_to_camera)


def test_nerfstudio_frame_lenses_override_the_files(tmp_path: Path) -> None:
    content = nerfstudio(views(4)) | {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": None, "k3": 0.01}
    content["frames"][1] |= {"camera_model": "OPENCV_FISHEYE", "k4": 0.002}
    content["frames"][2] |= {"camera_model": "PINHOLE", "k1": 0, "k2": 0, "k3": 0, "p1": 0}
    content["frames"][3] |= {"camera_model": "FISHEYE624"}
    cameras = read_cameras(save(tmp_path / "t.json", content))
    assert_same(cameras, views(4), lambda name: f"images/{name}")
    assert [view.lens and view.lens.kind for view in cameras] == ["radial", "fisheye", None, None]
    assert [view.lens and view.lens.model for view in cameras[2:]] == [None, "FISHEYE624"]
    coefficients = [view.lens.coefficients for view in cameras[:2] if view.lens]
    assert coefficients == [(0.1, -0.02, 0.003, 0, 0.01, 0, 0, 0), (0.1, -0.02, 0.01, 0.002)]


def test_instant_ngp_fisheyes_are_read(tmp_path: Path) -> None:
    content = nerfstudio(views(1)) | {"is_fisheye": True}
    del content["camera_model"]
    (view,) = read_cameras(save(tmp_path / "t.json", content))
    assert view.lens
    assert view.lens.kind == "fisheye"


@pytest.mark.parametrize("suffix", ["", ".png", ".jpg"])
def test_blender_size_comes_from_its_images(tmp_path: Path, suffix: str) -> None:
    cameras = views(2)
    content = {"camera_angle_x": 2 * math.atan(WIDTH / 2 / 500), "frames": nerfstudio(cameras)["frames"]}
    (tmp_path / "images").mkdir()
    for view, frame in zip(cameras, content["frames"], strict=True):
        if suffix:
            frame["file_path"] = frame["file_path"].removesuffix(".png")
        Image.new("RGB", (WIDTH, HEIGHT)).save(
            tmp_path / "images" / (view.name.removesuffix(".png") + (suffix or ".png"))
        )
    names = (lambda name: f"images/{name.removesuffix('.png')}") if suffix else (lambda name: f"images/{name}")
    assert_same(read_cameras(save(tmp_path / "transforms_train.json", content)), cameras, names)
    shutil.rmtree(tmp_path / "images")
    with pytest.raises(
        CameraError, match=r"camera 0 \('images/img_0.*gives no size, and there is no image .*'w' and 'h'"
    ):
        read_cameras(tmp_path / "transforms_train.json")


def test_blender_with_a_broken_image_is_refused(tmp_path: Path) -> None:
    content = {"camera_angle_x": 0.7, "frames": nerfstudio(views(1))["frames"]}
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "img_0.png").write_bytes(b"nothing")
    with pytest.raises(CameraError, match=r"gives no size, and its image does not either: .*is not an image"):
        read_cameras(save(tmp_path / "t.json", content))


def test_principal_points_are_read_and_null_counts_as_not_stated(tmp_path: Path) -> None:
    content, entries = nerfstudio(views(1)), [inria(views(1))[0] | {"cx": 300.0, "cy": 250.5}]
    expected = [replace(view, cx=300.0, cy=250.5) for view in views(1)]
    assert_same(read_cameras(save(tmp_path / "t.json", entries)), expected)
    content |= {"cx": None, "fl_y": None}
    entries[0] |= {"cx": None, "cy": None}
    content["frames"][0]["w"] = None
    for values in (content, entries):
        (view,) = read_cameras(save(tmp_path / "t.json", values))
        assert (view.width, view.fy, view.cx, view.cy) == (WIDTH, 500, WIDTH / 2, HEIGHT / 2)


def test_size_of_a_resized_image_is_refused(tmp_path: Path) -> None:
    content = nerfstudio(views(1))
    del content["w"], content["h"]
    path, image = save(tmp_path / "t.json", content), tmp_path / "images" / "img_0.png"
    image.parent.mkdir()
    Image.new("RGB", (WIDTH, HEIGHT)).save(image)
    assert (read_cameras(path)[0].width, read_cameras(path)[0].fx) == (WIDTH, 500)
    Image.new("RGB", (WIDTH // 2, HEIGHT // 2)).save(image)
    with pytest.raises(CameraError, match=r"camera 0 .* gives no size, .*seems to be resized; add .* 'w' and 'h'"):
        read_cameras(path)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("place", [".", "sparse/0", "sparse/1", "sparse", "colmap/sparse/0"])
@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE"])
def test_colmap_cameras_are_read(tmp_path: Path, text: bool, place: str, model: str) -> None:
    colmap(tmp_path / "data" / place, views(), text=text, model=model)
    assert_same(read_cameras(tmp_path / "data"), views())
    file = tmp_path / "data" / place / ("images.txt" if text else "cameras.bin")
    assert_same(read_cameras(file), views())


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("number", [number for number in colmap_model._MODELS if number != 17])
def test_distorted_colmap_cameras_are_pinholes_with_a_lens(tmp_path: Path, text: bool, number: int) -> None:
    """All coefficients after the intrinsics are 0.01, as pycolmap writes them."""
    reference = pycolmap.Camera.create_from_model_id(1, pycolmap.CameraModelId(number), 500.0, WIDTH, HEIGHT)
    extra = list(reference.extra_params_idxs())
    reference.params = [0.01 if index in extra else value for index, value in enumerate(reference.params)]
    name, folder = colmap_model._MODELS[number][0], colmap(tmp_path / "model", views(), text=text)
    values = reference.params.tolist()
    if text:
        (folder / "cameras.txt").write_text(f"1 {name} {WIDTH} {HEIGHT} {' '.join(map(repr, values))}\n")
    else:
        packed = struct.pack(f"<QIiQQ{len(values)}d", 1, 1, number, WIDTH, HEIGHT, *values)
        (folder / "cameras.bin").write_bytes(packed)
    cameras = read_cameras(folder)
    assert_same(cameras, views())
    lenses = {view.lens for view in cameras}
    if name in ("SIMPLE_PINHOLE", "PINHOLE"):
        assert lenses == {None}
        return
    (lens,) = lenses
    assert lens is not None
    assert (lens.model, lens.width, lens.height) == (name, WIDTH, HEIGHT)
    if lens.kind:
        u, v = lens.positions(torch.tensor(0.3, dtype=torch.float64), torch.tensor(-0.2, dtype=torch.float64))
        expected = reference.img_from_cam(np.array([0.3, -0.2, 1.0]))
        assert (float(u) * WIDTH, float(v) * HEIGHT) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV"])
def test_colmap_cameras_with_coefficients_of_0_are_pinholes(tmp_path: Path, text: bool, model: str) -> None:
    folder = colmap(tmp_path / "model", views(), text=text, model=model)
    assert_same(read_cameras(folder), views())
    assert {view.lens for view in read_cameras(folder)} == {None}


@pytest.mark.parametrize("model", ["EQUIRECTANGULAR", "SPHERICAL"])
def test_panoramas_of_text_models_become_cube_faces(tmp_path: Path, model: str) -> None:
    folder = colmap(tmp_path / "model", views(2), text=True)
    (folder / "cameras.txt").write_text(f"1 {model} 640 320 640 320\n")
    cameras = read_cameras(folder)
    names = [f"img_{index}.png.{face}" for face in FACES for index in range(2)]
    assert [view.name for view in cameras] == names  # so that the evenly spread views of a few do not all look one way
    for view, expected in zip(cameras[:2], views(2), strict=True):
        assert torch.allclose(view.world_to_camera, expected.world_to_camera, atol=1e-12)
    for size in ("640 300", "320 640"):
        (folder / "cameras.txt").write_text(f"1 {model} 640 320 {size}\n")
        with pytest.raises(CameraError, match=r"'img_0\.png': is a panorama of 640 x 320, but .* state another size"):
            read_cameras(folder)


def test_panoramas_match_the_projection_of_colmap() -> None:
    """The model is written by pycolmap 4.2.1: two panoramas of 1024 x 512, and a pinhole between them by name."""
    folder = CAPTURES / "colmap4_panorama" / "sparse" / "0"
    cameras = read_cameras(folder.parents[1])
    assert [view.name for view in cameras[:4]] == ["a.jpg.front", "b.jpg", "c.jpg.front", "a.jpg.right"]
    assert len(cameras) == 13
    points = torch.randn(400, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) * 5
    faces_of_points = 0
    for image in pycolmap.Reconstruction(folder).images.values():
        for view in (view for view in cameras if image.name in (view.panorama, view.name)):
            x, y, z = (points @ view.world_to_camera[:3, :3].T + view.world_to_camera[:3, 3]).unbind(1)
            inside = (z > 0) & (x.abs() <= z) & (y.abs() <= z)
            if view.lens is None:
                u, v = view.fx * x / z + view.cx, view.fy * y / z + view.cy
            else:
                u, v = (part * side for part, side in zip(view.lens.positions(x / z, y / z), (1024, 512), strict=True))
            for index in inside.nonzero()[:, 0].tolist():
                expected = image.project_point(points[index].numpy())
                assert (float(u[index]), float(v[index])) == pytest.approx(expected, abs=1e-6)
                faces_of_points += view.lens is not None
    assert faces_of_points == 800  # each point in one face of each panorama


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_every_truncation_of_a_binary_model_is_detected(tmp_path: Path, name: str) -> None:
    folder = colmap(tmp_path / "model", views(), text=False)
    data = (folder / name).read_bytes()
    for stop in range(0, len(data), 3):
        (folder / name).write_bytes(data[:stop])
        with pytest.raises(CameraError, match=f"{name}: is truncated"):
            read_cameras(folder)


def test_unreadable_colmap_models_are_refused(tmp_path: Path) -> None:
    folder = colmap(tmp_path / "model", views(), text=True)
    (folder / "images.txt").unlink()
    with pytest.raises(CameraError, match=r"images\.txt: cannot be read: No such file"):
        read_cameras(folder)
    with pytest.raises(CameraError, match="no registered image"):
        read_cameras(colmap(tmp_path / "empty", [], text=False))


@pytest.mark.parametrize("text", [False, True])
def test_rig_poses_come_from_the_images(tmp_path: Path, text: bool) -> None:
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 3, 4
    options.camera_model_id, options.camera_params = pycolmap.CameraModelId.PINHOLE, [500.0, 510.0, 320.0, 240.0]
    options.sensor_from_rig_translation_stddev, options.sensor_from_rig_rotation_stddev = 0.3, 10.0
    dataset = pycolmap.synthesize_dataset(options)
    (dataset.write_text if text else dataset.write_binary)(tmp_path)
    assert {path.stem for path in tmp_path.iterdir()} == {"cameras", "images", "points3D", "rigs", "frames"}
    expected = {image.name: image.cam_from_world().matrix() for image in dataset.images.values()}
    cameras = read_cameras(tmp_path)
    assert len(cameras) == len(expected) == 24
    for view in cameras:
        assert np.allclose(view.world_to_camera.numpy()[:3], expected[view.name], rtol=0, atol=1e-14)


@pytest.mark.parametrize("text", [False, True])
def test_unneeded_model_files_are_never_opened(tmp_path: Path, text: bool) -> None:
    """Eight bytes of any of them could declare 2^64 entries."""
    folder = colmap(tmp_path / "model", views(), text=text)
    for name in ("points3D", "rigs", "frames"):
        path = folder / f"{name}{'.txt' if text else '.bin'}"
        path.unlink(missing_ok=True)
        os.mkfifo(path)  # whoever opens it waits for ever
    assert_same(read_cameras(folder), views())


@pytest.mark.parametrize(
    ("name", "at", "value", "message"),
    [
        *(
            (f"{name}.bin", 0, struct.pack("<Q", count), f"{name}.bin: is truncated")
            for name in ("cameras", "images")
            for count in (4, 2**28, 2**64 - 1)
        ),
        ("cameras.bin", 12, struct.pack("<i", 99), r"unknown COLMAP camera model, number 99.*image_undistorter"),
    ],
)
def test_false_counts_of_binary_models_are_refused(
    tmp_path: Path, name: str, at: int, value: bytes, message: str
) -> None:
    """An unknown number of a camera model is refused, too."""
    folder = colmap(tmp_path / "model", views(), text=False)
    data = (folder / name).read_bytes()
    (folder / name).write_bytes(data[:at] + value + data[at + len(value) :])
    with pytest.raises(CameraError, match=message):
        read_cameras(folder)


@pytest.mark.parametrize(
    ("name", "old", "new", "message"),
    [
        ("cameras.txt", "500.0", "5_00.0", "line 2: '5_00.0' is not a number"),
        ("cameras.txt", "500.0", "nan", "line 2: 'nan' is not a number"),
        ("cameras.txt", "500.0", "٥", "line 2: '٥' is not a number"),
        # hours in quadratic time
        pytest.param("cameras.txt", "500.0", "5" * 1_000_000 + "x", "is not a number", id="long word"),
        ("cameras.txt", "640", "6_40", "line 2: '6_40' is not a whole number"),
        ("cameras.txt", "640", "6" * 5000, "is not a whole number"),
        ("cameras.txt", "PINHOLE", "PINHOL", "line 2: expected id, COLMAP camera model"),
        ("cameras.txt", "500.0", "", "line 2: expected id, COLMAP camera model"),
        ("cameras.txt", "1 P", "2 P", "has camera 1, which the model lacks"),
        ("images.txt", "# images", "3 1 0 0 0 0 0 0 1 twice.png", "has id 3 twice"),
        (
            "images.txt",
            "# images",
            "9 0 0 0 0 0 0 0 1 still.png",
            "image 'still.png': its quaternion has length 0, not 1",
        ),
        ("images.txt", "# images", "9 1e-9 0 0 0 0 0 0 1 still.png", "its quaternion has length 1e-09, not 1"),
        ("images.txt", "# images", "9 1_0 0 0 0 0 0 0 1 still.png", "line 1: '1_0' is not a number"),
        ("images.txt", "# images", "9 1 0 0 0 0 0 0 1", "line 1: expected id, 7 numbers"),
    ],
)
def test_wrong_lines_of_colmap_text_are_named(tmp_path: Path, name: str, old: str, new: str, message: str) -> None:
    folder = colmap(tmp_path / "model", views(), text=True)
    content = (folder / name).read_text()
    assert old in content
    (folder / name).write_text(content.replace(old, new + "\n" * (name == "images.txt"), 1))
    with pytest.raises(CameraError, match=message):
        read_cameras(folder)


POINTS = ["", "1.5 2.5 -1 30 40 7", "1e-05 nan 18446744073709551615"]


@pytest.mark.parametrize("comment", ["", "# a comment\n"])
@pytest.mark.parametrize("name", ["{0}.png", "my image {0}.png", "{0}"])
@pytest.mark.parametrize("missing", [(), (0,), (1, 3), (0, 1, 2, 3)])
def test_images_without_lines_of_points_are_all_read(
    tmp_path: Path, missing: tuple[int, ...], name: str, comment: str
) -> None:
    folder, lines = colmap(tmp_path / "model", views(1), text=True), "\n"
    for index in range(4):
        lines += f"{comment}{index + 1} 1 0 0 0 {index} 0 0 1 {name.format(index)}\n"
        lines += "" if index in missing else f"{POINTS[index % 3]}\n"
    (folder / "images.txt").write_text(f"{lines}\n\n")
    cameras = read_cameras(folder)
    assert [view.name for view in cameras] == [name.format(index) for index in range(4)]
    assert [float(view.world_to_camera[0, 3]) for view in cameras] == [0, 1, 2, 3]


@pytest.mark.parametrize("line", ["1.5 2.5", "1.5 2.5 -1 3", "1.5 2.5 x", "1 0 0 0 0 0 0 0 1 a b"])
def test_lines_that_are_neither_images_nor_points_are_named(tmp_path: Path, line: str) -> None:
    folder = colmap(tmp_path / "model", views(1), text=True)
    (folder / "images.txt").write_text(f"1 1 0 0 0 0 0 0 1 a.png\n{line}\n2 1 0 0 0 0 0 0 1 b.png\n\n")
    with pytest.raises(CameraError, match=r"images\.txt: line 2|has id 1 twice"):
        read_cameras(folder)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("encoding", ["cp949", "gbk", "cp932", "utf-8"])
def test_names_in_any_encoding_are_read_and_match_photos(tmp_path: Path, encoding: str, text: bool) -> None:
    """Half of the names are UTF-8. The trail byte of the last kanji is a backslash in CP932, its lead byte a blank."""
    words = ["\u898b", "\u672c", "\u8868" if encoding == "cp932" else "\u5730"]
    names = [word.encode(encoding if index else "utf-8") + b" 1.png" for index, word in enumerate(words)]
    marked = [replace(view, name=f"NAME{index}") for index, view in enumerate(views())]
    folder = colmap(tmp_path / "model", marked, text=text)
    file, photos = folder / ("images.txt" if text else "images.bin"), tmp_path / "photos"
    data = file.read_bytes()
    photos.mkdir()
    for index, name in enumerate(names):
        data = data.replace(f"NAME{index}".encode(), name)
        Image.new("RGB", (WIDTH, HEIGHT)).save(photos / os.fsdecode(name), "PNG")
    file.write_bytes(data)
    cameras = read_cameras(folder)
    assert len({view.name for view in cameras}) == 3
    assert "\u898b 1.png" in {view.name for view in cameras}
    "".join(view.name for view in cameras).encode()  # can be printed and stored
    for matches in (check_photos(photos, cameras), find_masks(photos, cameras)):
        assert {os.fsencode(photo.path.name) for photo in matches if photo} == set(names)


def test_names_with_spaces_and_windows_line_ends_are_read(tmp_path: Path) -> None:
    folder = colmap(tmp_path / "model", views(), text=True)
    for file in ("cameras.txt", "images.txt"):
        content = (folder / file).read_text().replace("img_1", "my img_1")
        (folder / file).write_text("\ufeff" + content.replace("\n", "\r\n"), newline="", encoding="utf-8")
    assert_same(
        sorted(read_cameras(folder), key=lambda view: view.name[-5]),
        views(),
        {"img_0.png": "img_0.png", "img_1.png": "my img_1.png", "img_2.png": "img_2.png"}.__getitem__,
    )


def change(content: Any, key: str, value: Any) -> Any:
    """Replace or remove a value of the second camera in the content of an INRIA or nerfstudio camera file."""
    entry = (content if isinstance(content, list) else content["frames"])[1]
    if value is None:
        del entry[key]
    else:
        entry[key] = value
    return content


NAN = float("nan")
MIRROR = np.diag([1.0, 1.0, -1.0])


#: Keys of the second camera, values (None to remove the key), and messages.
WRONG_INRIA: list[tuple[str, Any, str]] = [
    ("rotation", None, "has no 'rotation'"),
    ("rotation", [[1, 0], [0, 1]], r"'rotation' has shape \(2, 2\), not \(3, 3\)"),
    ("rotation", "right", "'rotation' is \"right\", not a list of numbers. Export"),
    (
        "rotation",
        [["1_0", "0", "0"], ["0", "1", "0"], ["0", "0", "1"]],
        "'rotation' holds \"1_0\", not a number",
    ),
    ("rotation", [[True, 0, 0], [0, 1, 0], [0, 0, 1]], "'rotation' holds true, not a number. Export"),
    ("rotation", [[None, 0, 0], [0, 1, 0], [0, 0, 1]], "'rotation' holds null, not a number"),
    ("position", {"x": 0}, "'position' is .*, not a list of numbers"),
    ("position", [0, 0, "1_0"], "'position' holds \"1_0\", not a number"),
    ("position", [[0], [0, 0], 0], "'position' holds .0., not a number"),
    ("rotation", [[1, 0, 0], [0, 10**400, 0], [0, 0, 1]], "'rotation' holds 1000.*, not a finite number"),
    ("rotation", (2 * np.eye(3)).tolist(), "is 3 off a rotation"),
    ("rotation", [[1, 0.01, 0], [0, 1, 0], [0, 0, 1]], "is 0.01 off a rotation"),
    ("rotation", MIRROR.tolist(), "mirrors"),
    ("rotation", np.full((3, 3), NAN).tolist(), "'rotation' holds nan, not a finite number"),
    ("position", [0, math.inf, 0], "'position' holds inf, not a finite number"),
    ("position", [0, 1], r"shape \(2,\)"),
    ("width", 0, "width is 0"),
    ("height", -4, "height is -4"),
    ("height", 99.5, "whole pixels"),
    ("height", None, "has no 'height'"),
    ("fx", 0, "focal length x is 0"),
    ("fy", -1.0, "focal length y is -1"),
    ("fx", NAN, "'fx' is nan, not a finite number"),
    ("fx", 10**400, "not a finite number"),
    ("fx", True, "'fx' is true, not a number. Export"),
    ("fx", "500", "'fx' is \"500\", not a number. Export"),
    ("width", "640", "'width' is \"640\", not a number"),
    ("cx", [320], "'cx' is .320., not a number"),
]
WRONG_NERFSTUDIO: list[tuple[str, Any, str]] = [
    ("transform_matrix", None, "has no 'transform_matrix'"),
    ("transform_matrix", np.eye(3).tolist(), r"shape \(3, 3\), not \(4, 4\) or \(3, 4\)"),
    ("transform_matrix", (3 * np.eye(4)).tolist(), "is 8 off a rotation"),
    ("k1", NAN, "'k1' is nan, not a finite number"),
    ("p2", "0.1", "'p2' is \"0.1\", not a number"),
    ("h", "480", "'h' is \"480\", not a number"),
    ("fl_y", {}, "'fl_y' is {}, not a number"),
    ("camera_model", 3, "'camera_model' is 3, not a name"),
    ("is_fisheye", "false", "'is_fisheye' is \"false\", not true or false"),
    ("camera_model", "ORTHOPHOTO", "ORTHOPHOTO, which is neither a pinhole .*EQUIRECTANGULAR"),
    ("camera_model", "VR180_L", "VR180_L, which is neither a pinhole"),
    ("w", -1, "width is -1"),
    ("cx", NAN, "'cx' is nan"),
]


@pytest.mark.parametrize(
    ("make", "name", "key", "value", "message"),
    [
        *((inria, "img_1", *wrong) for wrong in WRONG_INRIA),
        *((nerfstudio, "images/img_1", *wrong) for wrong in WRONG_NERFSTUDIO),
    ],
)
def test_wrong_values_of_cameras_are_named(
    tmp_path: Path, make: Callable[[list[Camera]], Any], name: str, key: str, value: Any, message: str
) -> None:
    path = save(tmp_path / "cameras.json", change(make(views()), key, value))
    with pytest.raises(CameraError, match=rf"cameras\.json: camera 1 \('{name}\.png'\): .*{message}"):
        read_cameras(path)


def test_sizes_of_whole_pixels_up_to_rounding_are_read(tmp_path: Path) -> None:
    content = nerfstudio(views()) | {"w": WIDTH - 1e-5, "h": float(HEIGHT)}
    assert_same(read_cameras(save(tmp_path / "t.json", content)), views(), lambda name: f"images/{name}")
    with pytest.raises(CameraError, match=r"a size of 640\.4 x 480\.0 is not in whole pixels"):
        read_cameras(save(tmp_path / "t.json", content | {"w": 640.4}))


def test_missing_or_impossible_lenses_are_refused(tmp_path: Path) -> None:
    content = nerfstudio(views())
    del content["fl_x"]
    for values, message in (({}, "neither fl_x nor camera_angle_x"), ({"camera_angle_x": 4.0}, r"_angle_x is 4\.0")):
        with pytest.raises(CameraError, match=message):
            read_cameras(save(tmp_path / "t.json", content | values))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ([], "needs a JSON object with `transform` and `scale`"),
        ({"scale": 1.0}, "has no 'transform'"),
        ({"transform": np.eye(4)[:3].tolist(), "scale": 0}, "scale is 0"),
        ({"transform": (2 * np.eye(4))[:3].tolist(), "scale": 1}, "off a rotation"),
    ],
)
def test_wrong_training_frames_are_named(tmp_path: Path, values: Any, message: str) -> None:
    save(tmp_path / "dataparser_transforms.json", values)
    with pytest.raises(CameraError, match=message):
        read_cameras(save(tmp_path / "transforms.json", nerfstudio(views())))


def test_rounded_rotations_are_orthonormalized(tmp_path: Path) -> None:
    content = inria(views())
    for entry in content:
        entry["rotation"] = np.round(entry["rotation"], 4).tolist()
    for view, exact in zip(read_cameras(save(tmp_path / "c.json", content)), views(), strict=True):
        rotation = view.world_to_camera[:3, :3]
        assert torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-14)
        assert torch.allclose(rotation, exact.world_to_camera[:3, :3], atol=2e-4)
        assert torch.allclose(view.center, exact.center, atol=1e-12)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"[]", "holds no cameras"),
        (b'{"frames": []}', "holds no cameras"),
        (b"{}", "in no known camera format. Give an INRIA cameras.json, a COLMAP"),
        (b"3", "in no known camera format"),
        (b'{"frames": 3}', "in no known camera format"),
        (b"[3]", "camera 0: is not an object"),
        (b"[{}]", "camera 0: has no name"),
        (b"[[1, 2]]", "camera 0: is not an object"),
        (b"{", "neither JSON nor a COLMAP model"),
        (b"\xff\xd8\xff", "neither JSON nor a COLMAP model"),
        (b"[" * 100_000, "neither JSON nor a COLMAP model"),
        (b"", "neither JSON nor a COLMAP model"),
    ],
)
def test_unknown_formats_are_refused(tmp_path: Path, data: bytes, message: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_bytes(data)
    with pytest.raises(CameraError, match=rf"cameras\.json: .*{message}"):
        read_cameras(path)


def test_missing_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CameraError, match="No such file"):
        read_cameras(tmp_path / "none.json")


def test_real_colmap_model_matches_cameras_json(shared_data: Path) -> None:
    folder = shared_data / "photos" / "snowmiku_plush"
    from_json, from_colmap = read_cameras(folder / "cameras.json"), read_cameras(folder)
    assert len(from_json) == 97
    assert_same(from_colmap, sorted(from_json, key=lambda view: view.name), lambda name: f"{name}.jpg")


CAPTURES = Path(__file__).parent / "captures"
#: nerfstudio's axes: x, z, -y of COLMAP's world.
NERFSTUDIO = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)


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


def test_spherical_cameras_of_metashape_have_its_axes_in_another_order() -> None:
    """The file is as nerfstudio's `metashape_to_json` writes it: one camera model, and sizes in each frame."""
    cameras = read_cameras(CAPTURES / "metashape_spherical")
    order = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]], dtype=torch.float64)
    panoramas = (cube_faces(view.name, 2048, 1024, view.world_to_camera) for view in views())
    assert_close(cameras, [view for faces in zip(*panoramas, strict=True) for view in faces], order)
    assert [view.name for view in cameras[:2]] == ["images/img_0.jpg.front", "images/img_1.jpg.front"]


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
        read_cameras(CAPTURES / "blender", CAPTURES)
    beside = tmp_path / "beside"
    shutil.copytree(CAPTURES / "blender", beside)
    photos_of_blender(beside)
    assert_close(read_cameras(beside), views())
    assert [photo and photo.path.parent.name for photo in check_photos(beside, read_cameras(beside))] == ["train"] * 3


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
            assert [photo and image_size(photo.path) for photo in photos] == [(WIDTH // 2, HEIGHT // 2)] * 3


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


def test_folders_without_cameras_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{")
    with pytest.raises(CameraError, match=r"a\.json: is neither JSON"):
        read_cameras(tmp_path)
    (tmp_path / "b.json").write_text("{}")
    with pytest.raises(CameraError, match=r"holds no cameras in a known format\. Give an INRIA"):
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
        ("./keyframes/corrected_cameras/1.json", "{}", "raw data of Polycam"),
        ("./EXR_RGBD/metadata.json", "{}", "data of Record3D"),
        ("./opensfm/reconstruction.json", "{}", "OpenSfM"),
        ("./sfm_data.json", "{}", "OpenMVG"),
        ("./bundle.out", "{}", "Bundler"),
    ],
)  # fmt: skip
def test_unsupported_formats_suggest_a_conversion(tmp_path: Path, name: str, content: str, message: str) -> None:
    """The folder is given if the name starts with a dot."""
    path, in_folder = tmp_path / name, name.startswith("./")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content, encoding="utf-8")
    with pytest.raises(CameraError, match=message if in_folder else rf"{name}: is .*{message}"):
        read_cameras(tmp_path if in_folder else path)


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
