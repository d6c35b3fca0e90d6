"""Tests of the optimization loop, on tiny scenes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.progress import Progress
from sgsst_core.scales import smoothed
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import PresetName, make_settings
from sgsst_core.stylizing.checkpoint import Checkpoint, Checkpoints, load_checkpoint, versions
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.steps import mean_loss
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.synthetic_images import synthetic_image
from tests.small_scenes import HEIGHT, WIDTH, ball, blind_camera, cameras, style, wall

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def scene() -> Scene:
    return wall(sh_degree=1)


def make(
    weights: BackboneWeights, scene: Scene, views: int = 3, preset: PresetName = "standard", **values: Any
) -> Stylizer:
    settings = make_settings(preset, **{"steps_coarse": 5, "steps_sos": 5, **values})
    return Stylizer.planned(scene, cameras(views), style(), settings, weights=weights)


def test_runs_with_the_same_seed_are_bit_identical(tiny_weights: BackboneWeights, scene: Scene) -> None:
    runs = [make(tiny_weights, scene, views=4, seed=seed) for seed in (3, 3, 4)]
    for stylizer in runs:
        assert run(stylizer) == "finished"
    first, second, other = runs
    assert torch.equal(first.sh_dc, second.sh_dc)
    assert [record.loss for record in first.history] == [record.loss for record in second.history]
    assert not torch.equal(first.sh_dc, other.sh_dc)


def test_resumed_run_is_bit_identical(tiny_weights: BackboneWeights, scene: Scene, tmp_path: Path) -> None:
    """It stops in the middle of a round, so queue, random generator and Adam's moments must be restored."""
    whole = make(tiny_weights, scene, steps_sos=8)
    run(whole)
    stopped = make(tiny_weights, scene, steps_sos=8)
    for _ in range(4):
        stopped.run_step()
    assert stopped.state().queue
    checkpoint = Checkpoint(stopped.state(), stopped.job.plan, 1, "run", versions())
    Checkpoints(tmp_path / "c.safetensors").save(checkpoint, "job")
    resumed = make(tiny_weights, scene, steps_sos=8)
    resumed.load_state(load_checkpoint(tmp_path / "c.safetensors", "job").state)
    assert run(resumed) == "finished"
    expected, actual = whole.state(), resumed.state()
    for name in ("sh_dc", "first_moment", "second_moment", "generator"):
        assert torch.equal(getattr(expected, name), getattr(actual, name)), name
    assert expected.queue == actual.queue
    assert [replace(r, seconds=0, parts={}, memory=0) for r in expected.history] == [
        replace(r, seconds=0, parts={}, memory=0) for r in actual.history
    ]
    assert actual.seconds > stopped.seconds
    assert actual.seconds_by_part["vgg_forward"] > stopped.seconds_by_part["vgg_forward"]


def test_every_view_is_visited_once_per_round(tiny_weights: BackboneWeights, scene: Scene) -> None:
    stylizer = make(tiny_weights, scene, views=4, steps_sos=12)
    run(stylizer)
    rounds = [[record.view for record in stylizer.history[i : i + 4]] for i in (0, 4, 8)]
    assert [sorted(views) for views in rounds] == [[0, 1, 2, 3]] * 3
    assert len({tuple(views) for views in rounds}) > 1


def test_first_step_changes_seen_values_by_the_learning_rate(tiny_weights: BackboneWeights, scene: Scene) -> None:
    """Adam's first update is lr * sign(gradient), whatever the gradient's size."""
    hidden = replace(scene, means=torch.cat([scene.means[:-10], scene.means[-10:] * torch.tensor([1.0, 1.0, -1.0])]))
    stylizer = make(tiny_weights, hidden, views=1, learning_rate=0.05, bounded=False, warm_start=False)
    stylizer.run_step()
    assert not stylizer.job.plan.seen[-10:].any()
    moved = (stylizer.sh_dc.detach() - hidden.sh_dc[stylizer.job.plan.seen]).abs()
    moved = moved[moved > 0]
    assert len(moved) > 0.3 * hidden.sh_dc.numel()
    torch.testing.assert_close(moved, torch.full_like(moved, 0.05), rtol=1e-3, atol=0)


def test_learning_rate_falls_exponentially_to_its_end(
    tiny_weights: BackboneWeights, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    stylizer = make(tiny_weights, scene, steps_sos=5, learning_rate=0.1, learning_rate_end=0.001)
    rates = []
    update = stylizer._optimizer.update

    def noted(gradient: Tensor, learning_rate: float) -> Tensor:
        rates.append(learning_rate)
        return update(gradient, learning_rate)

    monkeypatch.setattr(stylizer._optimizer, "update", noted)
    while stylizer.step < stylizer.job.total_steps:
        stylizer.run_step()
    assert rates == pytest.approx([0.1, 0.1**1.5, 0.01, 0.1**2.5, 0.001])


def test_loss_halves_and_falls_on_unused_views(tiny_weights: BackboneWeights, scene: Scene) -> None:
    left_out = Stylizer.planned(scene, [cameras(4)[1]], style(), make_settings(), weights=tiny_weights)
    start = left_out.evaluate([0])[0].total
    stylizer = make(tiny_weights, scene, steps_sos=20, learning_rate=0.1)
    before = stylizer.evaluate([0, 1, 2])[0].total
    run(stylizer)
    assert stylizer.evaluate([0, 1, 2])[0].total < 0.5 * before
    left_out.set_colors(stylizer.stylized())
    assert left_out.evaluate([0])[0].total < 0.6 * start


@pytest.mark.parametrize("style_loss", ["nnfm", "mixed"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_features_approach_the_style(
    tiny_weights: BackboneWeights, scene: Scene, monkeypatch: pytest.MonkeyPatch, style_loss: str, precision: str
) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": True}, raising=False)
    values: dict[str, Any] = {"style_loss": style_loss, "precision": precision, "content_weight": 0.0}
    stylizer = make(tiny_weights, scene, steps_sos=20, learning_rate=0.1, **values)
    before = stylizer.evaluate([0, 1, 2])[0]
    run(stylizer)
    after = stylizer.evaluate([0, 1, 2])[0]
    assert after["nearest"] < 0.9 * before["nearest"]
    assert after.total < 0.9 * before.total
    assert stylizer.seconds_by_part["matching"] > 0


def test_time_budget_stops_the_run_with_a_checkpoint(tiny_weights: BackboneWeights, scene: Scene) -> None:
    """The clock advances by a second before each step but the first; the next step and the end need less than one."""
    stylizer = make(tiny_weights, scene)
    saved: list[int] = []
    left = iter(range(2, -1, -1))
    callbacks = Callbacks(checkpoint=lambda s: saved.append(s.step), left=lambda: next(left))
    assert run(stylizer, callbacks) == "within"
    assert saved == [stylizer.step]
    assert 0 < stylizer.step <= 3


def test_run_without_time_makes_a_step_so_that_resuming_gets_further(
    tiny_weights: BackboneWeights, scene: Scene
) -> None:
    stylizer = make(tiny_weights, scene)
    for step in (1, 2):
        assert run(stylizer, Callbacks(left=lambda: 0.0)) == "within"
        assert stylizer.step == step


def test_stop_request_ends_the_run_between_steps(tiny_weights: BackboneWeights, scene: Scene) -> None:
    stylizer = make(tiny_weights, scene)
    saved: list[int] = []
    seen: list[Progress] = []
    callbacks = Callbacks(
        progress=seen.append,
        progress_seconds=0,
        stop=lambda: stylizer.step == 3,
        checkpoint=lambda s: saved.append(s.step),
    )
    assert run(stylizer, callbacks) == "interrupted"
    assert saved == [3]
    assert [(p.step, p.total, p.stage) for p in seen] == [(1, 5, "sos"), (2, 5, "sos"), (3, 5, "sos")]
    assert all((p.eta_s or 0) > 0 for p in seen)


def test_first_and_last_step_are_reported_and_others_at_intervals(tiny_weights: BackboneWeights, scene: Scene) -> None:
    """The last report has the same mean loss as if every step had been reported."""
    every, few = list[Progress](), list[Progress]()
    run(make(tiny_weights, scene), Callbacks(progress=every.append, progress_seconds=0))
    run(make(tiny_weights, scene), Callbacks(progress=few.append, progress_seconds=math.inf))
    assert [report.step for report in every] == [1, 2, 3, 4, 5]
    assert [report.step for report in few] == [1, 5]
    assert (few[-1].mean_loss, few[-1].mean_scales) == (every[-1].mean_loss, every[-1].mean_scales)
    ended, stopped = list[Progress](), make(tiny_weights, scene)
    run(stopped, Callbacks(progress=ended.append, progress_seconds=math.inf, stop=lambda: stopped.step == 3))
    assert [report.step for report in ended] == [1, 3], "a job that ends early reports its last step too"


def test_target_is_a_fraction_of_the_initial_loss(tiny_weights: BackboneWeights, scene: Scene) -> None:
    """The initial loss is known once every view has been visited; jobs without a target measure it on request."""
    stylizer = make(tiny_weights, scene, steps_sos=40, target_loss=0.8, early_stop=False)
    assert stylizer.start() == make(tiny_weights, scene, steps_sos=40, measure=0.5).start()
    stylizer = make(tiny_weights, scene, steps_sos=40, target_loss=0.8, early_stop=False)
    assert run(stylizer) == "target-loss"
    start = mean_loss(stylizer.start())
    rounds = [smoothed([r.loss for r in stylizer.history[: end + 1]], 3) for end in range(2, stylizer.step)]
    assert rounds[-1] <= 0.8 * start < min(rounds[:-1], default=math.inf)


def test_previews_and_checkpoints_follow_their_intervals(tiny_weights: BackboneWeights, scene: Scene) -> None:
    saved: list[int] = []
    shown: list[int] = []
    callbacks = Callbacks(
        checkpoint=lambda s: saved.append(s.step),
        checkpoint_seconds=0,
        preview=lambda s: shown.append(s.step),
        preview_seconds=1e6,
    )
    stylizer = make(tiny_weights, scene, steps_sos=3)
    run(stylizer, callbacks)
    assert saved == [1, 2, 3]
    assert stylizer.seconds_by_part["checkpoint"] > 0
    assert shown == [0], "before the first step alone"


@pytest.mark.parametrize(("preset", "phase_1"), [("standard", 0), ("paper", 5)])
def test_phase_1_is_skipped_with_one_scale(
    tiny_weights: BackboneWeights, scene: Scene, preset: PresetName, phase_1: int
) -> None:
    stylizer = make(tiny_weights, scene, preset=preset)
    assert stylizer.job.plan.steps_coarse == phase_1
    assert stylizer.job.total_steps == phase_1 + 5


def test_phase_1_works_on_the_coarsest_scale_and_phase_2_on_all(tiny_weights: BackboneWeights) -> None:
    settings = make_settings(steps_coarse=1, steps_sos=1)
    stylizer = Stylizer.planned(wall(), cameras(1, width=512, height=512), style(), settings, weights=tiny_weights)
    run(stylizer)
    first, second = stylizer.history
    assert (first.stage, list(first.terms)) == ("coarse", [1])
    assert (second.stage, sorted(second.terms)) == ("sos", [0, 1])
    assert first.loss == first.terms[1].total
    assert second.loss == pytest.approx((second.terms[0].total + second.terms[1].total) / 2)
    assert second.terms[1].total < first.terms[1].total


@pytest.mark.parametrize(
    ("make_scene", "preset", "values", "weighted"),
    [
        (ball, "standard", {}, True),
        (wall, "standard", {}, False),
        (ball, "paper", {}, False),
        (ball, "standard", {"position_weights": "off"}, False),
        (wall, "standard", {"position_weights": "on"}, True),
    ],
)
def test_position_weights_are_for_views_with_an_empty_background(
    tiny_weights: BackboneWeights, make_scene: Any, preset: PresetName, values: dict[str, Any], weighted: bool
) -> None:
    stylizer = make(tiny_weights, make_scene(), preset=preset, **values)
    assert stylizer.job.view_targets.weighted is weighted
    uncovered = stylizer.job.plan.survey.uncovered_fraction
    assert uncovered > 0.3 if make_scene is ball else uncovered < 0.01
    assert (stylizer.job.view_targets.target(0, [0]).coverage is not None) is weighted


def test_blind_views_are_skipped(tiny_weights: BackboneWeights, scene: Scene) -> None:
    settings = make_settings(steps_sos=3)
    stylizer = Stylizer.planned(scene, [blind_camera(), *cameras(2)], style(), settings, weights=tiny_weights)
    run(stylizer)
    assert stylizer.job.views.covered == [1, 2]
    assert {record.view for record in stylizer.history} == {1, 2}


def test_given_photos_are_the_content(tiny_weights: BackboneWeights, scene: Scene) -> None:
    photo = synthetic_image(HEIGHT, WIDTH, seed=9, dtype=torch.float32)
    settings = make_settings(warm_start=False)
    own = Stylizer.planned(scene, cameras(1), style(), settings, weights=tiny_weights)
    given = Stylizer.planned(scene, cameras(1), style(), settings, weights=tiny_weights, photos=lambda index: photo)
    assert own.evaluate([0])[0]["content"] == 0
    assert given.evaluate([0])[0]["content"] > 0
