"""Tests that plans depend on no clock, that what they leave out does not change results, and of their reasons."""

from __future__ import annotations

import itertools
import random
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import psutil
import pytest
import torch
from safetensors import safe_open

from benchmarks.left_out import EVERYTHING, with_components
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.planning.survey import survey_views
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import PresetName, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.checkpoint import save_plan
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.planner import plan_job
from sgsst_core.stylizing.stylizer import Stylizer, neighbors_change
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import ball, cameras, style, wall


def behind(scene: Scene, count: int = 10) -> Scene:
    """Return the scene with its last `count` Gaussians moved behind the cameras, where no view sees them."""
    moved = scene.means.clone()
    moved[-count:, 2] *= -1
    return replace(scene, means=moved)


def higher_bands_of_zeros(scene: Scene) -> Scene:
    return replace(scene, sh_rest=torch.zeros((len(scene), 15, 3)))


def make(scene: Scene, views: list[Camera], weights: BackboneWeights, **values: Any) -> Stylizer:
    settings = make_settings(**{"steps_coarse": 0, "steps_sos": 4, "learning_rate": 0.05, **values})
    return Stylizer.planned(scene, views, synthetic_image(60, 70, seed=9).float(), settings, weights=weights)


@pytest.mark.parametrize("added", [*((item,) for item in EVERYTHING), EVERYTHING])
def test_left_out_components_do_not_change_results(tiny_weights: BackboneWeights, added: tuple[str, ...]) -> None:
    """Every component has something to leave out."""
    scene, views, style = higher_bands_of_zeros(behind(ball())), cameras(1), Style.of(synthetic_image(60, 70, seed=9))
    settings = make_settings(steps_coarse=0, steps_sos=5, learning_rate=0.05, precision="float32")
    lean, full = (with_components(each, scene, views, style, settings, tiny_weights) for each in ((), added))
    losses = [stylizer.run_step().loss for stylizer in (lean, full)]
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)
    gradients = [stylizer.gradient(0, [0])[0] for stylizer in (lean, full)]
    if "unseen" in added:
        gradients[1] = gradients[1][lean.job.plan.seen]
    assert relative_error(*gradients) < 1e-4


def test_plan_does_not_depend_on_a_clock(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Every clock shows a random time; the digest of a plan's file covers all its fields and decisions."""
    scene, views, plans, draw = behind(wall(10, 8), 3), cameras(2, 32, 24), set[str](), random.Random(1)
    settings = make_settings(memory_limit=1 << 32)  # the default depends on the free memory, if there is little
    for name in ("perf_counter", "monotonic", "time", "process_time", "thread_time"):
        clock = itertools.accumulate(draw.expovariate(1.0) * 10.0 ** draw.randint(-6, 3) for _ in itertools.count())
        monkeypatch.setattr(time, name, clock.__next__)
    for _ in range(20):
        job = plan_job(scene, views, Style.of(style()), settings, weights=tiny_weights, measured=True)
        (tmp_path / "plan").touch()
        save_plan(tmp_path / "plan", job.plan, "job", "conditions")
        with safe_open(tmp_path / "plan", "pt") as file:
            plans.add(file.metadata()["digest"])
    assert len(plans) == 1
    assert len(job.plan.decisions) > 5


def test_bound_on_memory_holds(tiny_weights: BackboneWeights) -> None:
    stylizer = make(wall(), cameras(3, 128, 96), tiny_weights, steps_sos=3)
    before = psutil.Process().memory_info().rss
    run(stylizer)
    assert max(record.memory for record in stylizer.history) - before < stylizer.job.plan.peak_bytes


def test_rendering_without_unseen_gaussians_is_bit_identical(tiny_weights: BackboneWeights) -> None:
    scene, views = behind(wall(sh_degree=2), 100), cameras(3)
    lean, whole = make(scene, views, tiny_weights), make_rasterizer("cpu", scene)
    assert len(lean.sh_dc) < len(scene)
    warm = replace(scene, sh_dc=scene.sh_dc.clone())
    warm.sh_dc[lean.job.plan.seen] = lean.sh_dc.detach()
    for index in range(3):
        image = lean.job.views.render(index, lean.job.views.colors(index, lean.sh_dc.detach()))
        assert torch.equal(image, whole.render(scene_colors(warm, views[index]), views[index]))


def test_decisions_name_skipped_work(tiny_weights: BackboneWeights) -> None:
    near = ball()
    scene = higher_bands_of_zeros(behind(replace(near, means=near.means + torch.tensor([0.0, 0, 4]))))
    views = [resized(camera, 320) for camera in cameras(2)]
    plan = make(scene, views, tiny_weights, content_weight=0, steps_coarse=3).job.plan
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
    assert (decisions["unseen Gaussians"].bytes or 0) == int((~plan.seen).sum()) * 48
    assert plan.steps_coarse == 0


def test_survey_finds_weights_regions_and_blind_views() -> None:
    scene = behind(ball(), 10)
    views = cameras(2)
    away = replace(views[0], world_to_camera=torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64)))
    rasterizer = make_rasterizer("cpu", replace(scene, means=scene.means.clamp_min(0)))
    survey = survey_views(rasterizer.scene, [*views, away], rasterizer)  # type: ignore[attr-defined]
    assert survey.covered == [0, 1]
    expected = sum(rasterizer.coverage(camera).double().sum() for camera in views)
    assert float(survey.total_blend_weights.sum()) == pytest.approx(float(expected), rel=1e-5)
    coverage = rasterizer.coverage(views[0])
    outside = coverage.clone()
    outside[survey.regions[0].slices] = 0
    assert outside.max() == 0
    assert 0 < survey.regions[0].pixels < coverage.numel()


def test_unseen_gaussians_follow_their_seen_neighbors() -> None:
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.1, 0, 0], [50, 0, 0]])
    change = torch.tensor([[1.0, 0, 0], [0, 1, 0], [9, 9, 9], [9, 9, 9]])
    change_of_all = neighbors_change(means, change, torch.tensor([3e-9, 1e-9, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(change_of_all, torch.tensor([[0.75, 0.25, 0], [0.75, 0.25, 0]]))
    assert neighbors_change(means, change, torch.ones(4, dtype=torch.float64)).shape == (0, 3)


def test_neighbors_of_unseen_gaussians_do_not_depend_on_the_chunk_size(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(3)
    means, change = torch.randn(400, 3, generator=generator), torch.randn(400, 3, generator=generator)
    weights = torch.rand(400, generator=generator).double() * (torch.arange(400) % 4 > 0)
    seen = weights > 0
    actual = neighbors_change(means, change, weights)
    distances, nearest = torch.cdist(means[~seen].double(), means[seen].double()).sort(dim=1)
    assert bool((distances[:, :9].diff(dim=1) > 0).all())  # without ties, the neighbors are unique
    own = weights[seen][nearest[:, :8]]
    expected = (change[seen].double()[nearest[:, :8]] * own[..., None]).sum(1) / own.sum(1, keepdim=True)
    torch.testing.assert_close(actual.double(), expected, rtol=1e-6, atol=1e-6)
    for part in (1, 7, 100):
        monkeypatch.setattr("sgsst_core.stylizing.stylizer._CHUNK", part)
        assert torch.equal(neighbors_change(means, change, weights), actual)


def test_unseen_gaussians_keep_their_color_in_paper(tiny_weights: BackboneWeights) -> None:
    scene = behind(wall())
    cases: list[tuple[PresetName, bool]] = [("paper", False), ("standard", True)]
    for preset, moved in cases:
        settings = make_settings(preset, steps_coarse=0, steps_sos=2)
        stylizer = Stylizer.planned(
            scene, cameras(2), synthetic_image(60, 70, seed=9).float(), settings, weights=tiny_weights
        )
        run(stylizer)
        assert bool((stylizer.stylized()[-10:] != scene.sh_dc[-10:]).any()) == moved
