"""Tests of the survey, and of the checks whether scene, cameras and photos belong together."""

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from sgsst_core.errors import CameraError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import Photo, check_photos, save_png
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit import OrbitRequest, make_orbit
from sgsst_core.planning.survey import compare_photos, fitted_psnr, frame_warnings, implausible, shown_by
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import JobInputs, plan_job
from tests.real_scenes import scene_path
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.small_scenes import ball, blind_camera, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


def test_plan_requires_cameras_that_see_the_scene(tiny_weights: BackboneWeights) -> None:
    for views, message in (([], "There are no cameras"), ([blind_camera()], "None of the 1 cameras sees")):
        with pytest.raises(CameraError, match=message):
            plan_job(JobInputs(wall(), views, Style.of(style()), make_settings(), weights=tiny_weights))


NEAR = 0.2


def moved(camera: Camera, axis: str = "x", degrees: float = 0.0, scale: float = 1.0) -> Camera:
    """Return a camera in a world that is rotated about an axis through the origin, and then scaled."""
    rotation = torch.from_numpy(Rotation.from_euler(axis, degrees, degrees=True).as_matrix())
    pose = camera.world_to_camera.clone()
    pose[:3, :3] = pose[:3, :3] @ rotation.T
    pose[:3, 3] *= scale
    return replace(camera, world_to_camera=pose)


def opengl(camera: Camera) -> Camera:
    """Return a camera whose axes y and z have the wrong signs."""
    return replace(
        camera, world_to_camera=camera.world_to_camera.new_tensor([1, -1, -1, 1]).diag() @ camera.world_to_camera
    )


def verdict(scene: Scene, views: list[Camera]) -> str:
    try:
        warnings = frame_warnings(scene, views, NEAR)
    except CameraError:
        return "refused"
    return "warned" if warnings else "fine"


@pytest.mark.parametrize(
    ("change", "reported"),
    [
        (lambda camera: camera, []),
        (lambda camera: replace(camera, fx=100 * camera.fx, fy=100 * camera.fy), ["focal length"]),
        (lambda camera: replace(camera, fx=camera.fx / 100, fy=camera.fy / 100), ["focal length"]),
        (lambda camera: replace(camera, fy=3 * camera.fy), ["ratio of both focal lengths"]),
        (lambda camera: replace(camera, fx=100 * camera.fx), ["focal length", "ratio"]),
        (lambda camera: replace(camera, cx=-1.0), ["the image's width"]),
        (lambda camera: replace(camera, cy=camera.height + 1.0), ["the image's height"]),
        (lambda camera: replace(camera, cx=2.0 * camera.width, cy=2.0 * camera.height), ["width", "height"]),
        (lambda camera: moved(camera, scale=1e5), ["distance from the scene"]),
    ],
)
def test_cameras_of_no_real_capture_are_reported(change: Callable[[Camera], Camera], reported: list[str]) -> None:
    views = cameras()
    lines = list(implausible(wall().means, [change(views[0]), *views[1:]]))
    assert len(lines) == len(reported)
    for line, text in zip(lines, reported, strict=True):
        assert text in line.decision
        assert line.decision.startswith(f"warning: 1 of {len(views)} have a")
        assert line.reason.startswith(f"{views[0].name} has ")


@pytest.mark.parametrize("units", [1e-3, 0.02])
def test_near_plane_beyond_the_scene_is_named(units: float) -> None:
    """The error suggests a near plane that shows nearly everything."""
    scene = wall()
    small, views = replace(scene, means=scene.means * units), [moved(view, scale=units) for view in cameras()]
    with pytest.raises(
        CameraError, match=r"sees a Gaussian: 224 of 616 Gaussians are in .*, but nearer .* at 0\.2\. "
    ) as error:
        frame_warnings(small, views, NEAR)
    suggested = re.search(r"Add --near (\S+),", str(error.value))
    assert suggested
    assert frame_warnings(small, views, float(suggested[1])) == []
    assert shown_by(small.means, views, float(suggested[1])) == shown_by(scene.means, cameras(), NEAR)


def test_near_plane_amid_the_scene_is_reported() -> None:
    scene = ball()
    depth = float((scene.means - cameras()[1].center).norm(dim=1).median())
    (line,) = frame_warnings(scene, cameras(), depth)
    assert re.fullmatch(r"warning: \d+ of 300 Gaussians are in their frames, but nearer .* plane at .*", line.decision)
    suggested = re.search(r"add --near (\S+) ", line.reason)
    assert suggested
    assert frame_warnings(scene, cameras(), float(suggested[1])) == []


def test_real_cameras_are_reported_only_in_other_frames(shared_data: Path) -> None:
    folder = shared_data / "scenes" / "snowmiku_plush"
    scene, own = read_scene(folder / "point_cloud.ply").scene, read_cameras(folder / "cameras.json")
    for count in (1, 2, 3, 8, 97):
        assert verdict(scene, spread(own, count)) == "fine"
    assert verdict(scene, [moved(view, "x", 90) for view in own]) == "warned"  # nerfstudio's frame
    assert verdict(scene, [moved(view, "y", -90) for view in own]) == "warned"
    assert verdict(scene, [moved(view, "x", 180) for view in own]) == "refused"  # the other axes of SPZ
    assert verdict(scene, [opengl(view) for view in own]) == "refused"
    with pytest.raises(CameraError, match=r"different coordinate frames: .*dataparser_transforms"):
        frame_warnings(scene, [moved(view, "y", 180) for view in own], NEAR)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "away"),
    [
        ("broche", ["x90", "x180", "z90", "z180"]),
        ("playbot_synthetic_sh2", []),  # around the origin, every rotation shows it
    ],
)
def test_orbits_of_scans_give_no_warning(shared_data: Path, name: str, away: list[str]) -> None:
    scene = read_scene(scene_path(shared_data, name), drop_invalid=True).scene
    views = make_orbit(scene, OrbitRequest(24, None, None, None, NEAR)).cameras
    for count in (1, 3, 24):
        assert verdict(scene, spread(views, count)) == "fine"
    assert verdict(scene, [moved(view, scale=2) for view in views]) == "fine"
    for turn in away:
        assert verdict(scene, [moved(view, turn[0], float(turn[1:])) for view in views]) != "fine"
    assert verdict(scene, [opengl(view) for view in views]) == "refused"


def rendered(folder: Path, scene: Scene, views: list[Camera]) -> list[Photo]:
    """Save renders of views as photos."""
    rasterizer = make_rasterizer("cpu", scene, near=NEAR)
    colors = (0.5 + 0.28 * scene.sh_dc).clamp(0, 1)
    for view in views:
        save_png(folder / f"{view.name}.png", rasterizer.render(colors, view))
    return [photo for photo in check_photos(folder, views) if photo]


@pytest.mark.parametrize("applied", [False, True])
def test_orientation_that_resembles_the_scene_is_used(tmp_path: Path, applied: bool) -> None:
    scene, views = wall(), cameras()
    for photo in rendered(tmp_path, scene, views):
        exif = Image.Exif()
        exif[0x0112] = 3
        image = Image.open(photo.path)
        (image.rotate(180) if applied else image).save(photo.path, exif=exif)
    photos = [photo for photo in check_photos(tmp_path, views) if photo]
    oriented, (line,) = compare_photos(scene, views, photos, NEAR)
    assert {photo.oriented for photo in oriented} == {applied}
    assert line.decision == f"the EXIF orientation of 3 photos is {'applied' if applied else 'ignored'}"


def test_real_photos_are_reported_only_if_cropped(shared_data: Path, tmp_path: Path) -> None:
    scenes, folder = shared_data / "scenes" / "snowmiku_plush", shared_data / "photos" / "snowmiku_plush"
    scene, views = read_scene(scenes / "point_cloud.ply").scene, spread(read_cameras(folder / "cameras.json"), 4)
    photos = [photo for photo in check_photos(folder / "images", views) if photo]
    assert compare_photos(scene, views, photos, NEAR) == (photos, [])
    cropped = []
    for photo in photos:
        image = Image.open(photo.path)
        image.crop((50, 37, 940, 705)).resize(image.size).save(tmp_path / photo.path.name)
        cropped.append(replace(photo, path=tmp_path / photo.path.name))
    assert compare_photos(scene, views, cropped, NEAR)[1]
    others = [*photos[1:], photos[0]]
    assert compare_photos(scene, views, others, NEAR)[1]


def reference_psnr(photo: Tensor, render: Tensor, weight: Tensor) -> float:
    """Fit each channel by weighted least squares with a general solver."""
    root, error = weight.double().sqrt().flatten(), 0.0
    for channel in range(3):
        x, y = photo[..., channel].double().flatten(), render[..., channel].double().flatten()
        matrix = root[:, None] * torch.stack([x, torch.ones_like(x)], dim=1)
        fit = torch.linalg.lstsq(matrix, (root * y)[:, None]).solution
        error += float(((matrix @ fit)[:, 0] - root * y).square().sum())
    return -10 * math.log10(error / (3 * float(weight.double().sum())))


def test_psnr_ignores_exposure_and_uncovered_pixels() -> None:
    render, noise = (synthetic_image(20, 30, seed=seed, dtype=torch.float32) for seed in (1, 2))
    photo, weight = 0.9 * render + 0.1 * noise, noise[..., 0]
    assert fitted_psnr(photo, render, weight) == pytest.approx(reference_psnr(photo, render, weight), abs=1e-6)
    darker = 0.3 * photo * torch.tensor([1.0, 0.8, 0.6]) + 0.1
    assert fitted_psnr(darker, render, weight) == pytest.approx(fitted_psnr(photo, render, weight), abs=1e-3)
    covered = torch.ones(20, 30)
    covered[:, 15:] = 0
    elsewhere = torch.cat([render[:, :15], noise[:, 15:]], dim=1)
    assert fitted_psnr(elsewhere, render, covered) > 100
    flat = torch.full((20, 30, 3), 0.5)
    assert fitted_psnr(1 - render, render, covered) == pytest.approx(fitted_psnr(flat, render, covered))
    assert math.isfinite(fitted_psnr(torch.zeros(20, 30, 3), torch.zeros(20, 30, 3), 0 * covered))
