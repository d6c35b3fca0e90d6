"""Tests of the whole method on real scenes: the loss decreases at each scale, and on novel views."""

import pytest

from sgsst_core import Stylizer, make_settings, run
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit import orbit
from sgsst_core.scene.camera import resized, spread
from tests.real_scenes import scene_path

SIDE = 200


def cameras_of(folder, scene, count):
    if (folder / "cameras.json").exists():
        return [resized(camera, SIDE) for camera in spread(read_cameras(folder / "cameras.json"), count)]
    return orbit(scene, count, width=SIDE, height=150)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["broche", "snowmiku_plush"])
def test_sos_loss_halves_at_every_scale_and_falls_on_novel_views(shared_data, vgg16_weights, name):
    path = scene_path(shared_data, name)
    scene = read_scene(path).scene
    cameras = cameras_of(path.parent, scene, 12)
    style = load_image(shared_data / "styles" / "starry_night.jpg")
    # Starts from the scene's own colors, with the background that losses are measured on.
    settings = make_settings(
        steps_coarse=10,
        steps_sos=50,
        learning_rate=0.2,
        learning_rate_end=0.05,
        coarsest_side=100,
        warm_start=False,
        training_background="background",
    )
    chosen = [camera for index, camera in enumerate(cameras) if index % 3 != 1]
    training = Stylizer.planned(scene, chosen, style, settings, weights=vgg16_weights)
    novel_views = Stylizer.planned(scene, cameras[1::3], style, settings, weights=vgg16_weights)

    before = [stylizer.evaluate(stylizer.job.views.covered) for stylizer in (training, novel_views)]
    assert run(training) == "finished"
    novel_views.set_colors(training.stylized())
    after = [stylizer.evaluate(stylizer.job.views.covered) for stylizer in (training, novel_views)]
    for first, last, bound in zip(before, after, (0.5, 0.75), strict=True):
        assert set(first) == {0, 1}
        for scale, terms in first.items():
            print(f"{name}, scale {scale}: {last[scale].total / terms.total:.3f} of the loss at the start")
            assert last[scale].total < bound * terms.total
