"""What is left out changes nothing, and the plan says what and why."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core.camera import Camera, resized
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene import Scene
from sgsst_core.settings import make_settings
from sgsst_core.stylizer import Stylizer, run
from sgsst_core.survey import survey
from sgsst_core.unseen import neighbours_change
from sgsst_core.weights import BackboneWeights
from tests.sgsst_core.pictures import picture, relative_error
from tests.small_scenes import ball, cameras, wall


def behind(scene: Scene, count: int = 10) -> Scene:
    """The scene with its last Gaussians put behind the cameras, where no view sees them."""
    moved = scene.means.clone()
    moved[-count:, 2] *= -1
    return replace(scene, means=moved)


def higher_bands_of_zeros(scene: Scene) -> Scene:
    return replace(scene, sh_rest=torch.zeros((len(scene), 15, 3)))


def make(scene: Scene, views: list[Camera], weights: BackboneWeights, **values: Any) -> Stylizer:
    settings = make_settings(**{"steps_coarse": 0, "steps_sos": 4, "learning_rate": 0.05, **values})
    return Stylizer(scene, views, picture(60, 70, seed=9).float(), settings, weights=weights)


SCENES = {
    "wall of degree 3, some behind the cameras": behind(wall(sh_degree=3)),
    "wall with bands of zeros": higher_bands_of_zeros(wall()),
    "ball, some behind the cameras": behind(ball()),
}


@pytest.mark.parametrize("name", SCENES)
def test_what_is_left_out_changes_nothing(vgg16_weights: BackboneWeights, name: str) -> None:
    scene, views = SCENES[name], [resized(camera, 120) for camera in cameras(2)]
    lean, full = (make(scene, views, vgg16_weights, keep_everything=keep) for keep in (False, True))
    first = [stylizer.run_step() for stylizer in (lean, full)]
    # The first step's loss comes from equal colours: nothing but rounding may differ.
    assert first[0].loss == pytest.approx(first[1].loss, rel=1e-5)
    for stylizer in (lean, full):
        run(stylizer)
    # Later steps differ by what Adam makes of rounding: gradients that are 0 but for it move by the learning rate too.
    assert lean.history[-1].loss == pytest.approx(full.history[-1].loss, rel=1e-3)
    assert relative_error(lean.stylized() - scene.sh_dc, full.stylized() - scene.sh_dc) < 0.02


def test_rendering_without_unseen_gaussians_is_bitwise_the_same(vgg16_weights: BackboneWeights) -> None:
    scene, views = behind(wall(sh_degree=2), 100), cameras(3)
    lean, full = (make(scene, views, vgg16_weights, keep_everything=keep) for keep in (False, True))
    assert len(lean.sh_dc) < len(full.sh_dc) == len(scene)
    for index in range(3):
        images = [s.views.render(index, s.views.colours(index, s.sh_dc.detach())) for s in (lean, full)]
        assert torch.equal(*images)


def test_decisions_name_what_is_left_out(vgg16_weights: BackboneWeights) -> None:
    near = ball()
    scene = higher_bands_of_zeros(behind(replace(near, means=near.means + torch.tensor([0.0, 0, 4]))))
    views = [resized(camera, 320) for camera in cameras(2)]
    plan = make(scene, views, vgg16_weights, content_weight=0, steps_coarse=3).plan
    decisions = {decision.item: decision for decision in plan.decisions}
    assert set(decisions) >= {
        "unseen Gaussians",
        "spherical harmonics",
        "uncovered pixels",
        "position weights",
        "phase 1",
        "content",
        "partition",
    }
    assert decisions["uncovered pixels"].seconds is not None
    assert decisions["uncovered pixels"].seconds > 0
    assert (decisions["unseen Gaussians"].bytes or 0) == int((~plan.seen).sum()) * 48
    assert plan.steps_coarse == 0
    assert plan.prediction is not None
    assert plan.prediction.seconds > 0


def test_survey_finds_weights_regions_and_blind_views() -> None:
    scene = behind(ball(), 10)
    views = cameras(2)
    away = replace(views[0], world_to_camera=torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64)))
    rasterizer = make_rasterizer("cpu", replace(scene, means=scene.means.clamp_min(0)))
    found = survey(rasterizer.scene, [*views, away], rasterizer)  # type: ignore[attr-defined]
    assert found.covered == [0, 1]
    expected = sum(rasterizer.coverage(camera).double().sum() for camera in views)
    assert float(found.total_weights.sum()) == pytest.approx(float(expected), rel=1e-5)
    coverage = rasterizer.coverage(views[0])
    outside = coverage.clone()
    outside[found.regions[0].slices] = 0
    assert outside.max() == 0
    assert 0 < found.regions[0].pixels < coverage.numel()


def test_unseen_gaussians_follow_their_seen_neighbours() -> None:
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.1, 0, 0], [50, 0, 0]])
    change = torch.tensor([[1.0, 0, 0], [0, 1, 0], [9, 9, 9], [9, 9, 9]])
    found = neighbours_change(means, change, torch.tensor([3e-9, 1e-9, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(found, torch.tensor([[0.75, 0.25, 0], [0.75, 0.25, 0]]))
    assert neighbours_change(means, change, torch.ones(4, dtype=torch.float64)).shape == (0, 3)


def test_unseen_gaussians_keep_their_colour_in_paper(vgg16_weights: BackboneWeights) -> None:
    scene = behind(wall())
    for preset, moved in (("paper", False), ("standard", True)):
        settings = make_settings(preset, steps_coarse=0, steps_sos=2)
        stylizer = Stylizer(scene, cameras(2), picture(60, 70, seed=9).float(), settings, weights=vgg16_weights)
        run(stylizer)
        assert bool((stylizer.stylized()[-10:] != scene.sh_dc[-10:]).any()) == moved
