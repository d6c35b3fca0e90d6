"""The whole method on real scans: the loss falls in every scale, and on views that were held out."""

import pytest

from sgsst_core import Stylizer, make_settings, pyramid, run
from sgsst_core.camera import orbit, resized, spread
from sgsst_core.camera_files import read_cameras
from sgsst_core.images import load_image
from sgsst_core.ply import read_scene

SIDE = 200


def cameras_of(folder, scene, count):
    if (folder / "cameras.json").exists():
        return [resized(camera, SIDE) for camera in spread(read_cameras(folder / "cameras.json"), count)]
    return orbit(scene, count, width=150, height=SIDE)


@pytest.mark.parametrize("name", ["biker", "snowmiku_plush"])
def test_sos_loss_halves_in_every_scale_and_on_held_out_views(shared_data, vgg16_weights, monkeypatch, name):
    monkeypatch.setattr(pyramid, "COARSEST_SHORTER_SIDE", 100)  # two scales of small views
    folder = shared_data / "scenes" / name
    scene = read_scene(folder / "point_cloud.ply").scene
    cameras = cameras_of(folder, scene, 12)
    style = load_image(shared_data / "styles" / "starry_night.jpg")
    settings = make_settings(steps_coarse=10, steps_sos=50, learning_rate=0.1, learning_rate_end=0.03)
    training = Stylizer(scene, cameras[::2], style, settings, weights=vgg16_weights)
    held_out = Stylizer(scene, cameras[1::2], style, settings, weights=vgg16_weights)
    assert training.views.weighted == (name == "biker")  # a scan without background

    before = [stylizer.evaluate(stylizer.views.covered) for stylizer in (training, held_out)]
    assert run(training) == "finished"
    held_out.set_colours(training.stylized())
    after = [stylizer.evaluate(stylizer.views.covered) for stylizer in (training, held_out)]
    for first, last in zip(before, after, strict=True):
        assert set(first) == {0, 1}
        for scale, terms in first.items():
            assert last[scale].total < 0.5 * terms.total
