"""Tests of the optimization loop on tiny scenes, of the rates that it leaves behind, and of the time that it shows."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import pytest
import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.files.images import Color
from sgsst_core.progress import Progress
from sgsst_core.scales import smoothed
from sgsst_core.scene.colors import downscale
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import PlannedPrecision, PresetName, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.checkpoint import Checkpoint, load_checkpoint, save_checkpoint, versions
from sgsst_core.stylizing.job import JobInputs, Rates, estimate, plan_job, prepare_job
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.stylizer import Stylizer, mean_loss
from sgsst_core.stylizing.views import drawn_color, replace_background
from tests.sgsst_core.rasterizer.splat_reference import ReferenceRasterizer
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import HEIGHT, WIDTH, ball, cameras, style, wall

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
    save_checkpoint(tmp_path / "c.safetensors", checkpoint, "job")
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
    colors = stylizer.stylized()[left_out.job.plan.seen]
    assert left_out.evaluate([0], colors)[0].total < 0.6 * start


@pytest.mark.parametrize(("style_loss", "precision"), [("nnfm", "bfloat16"), ("mixed", "float32")])
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


def test_first_and_last_step_are_reported_and_others_at_intervals(tiny_weights: BackboneWeights, scene: Scene) -> None:
    """The last report has the same mean loss as if every step had been reported."""
    every, few = list[Progress](), list[Progress]()
    run(make(tiny_weights, scene), Callbacks(progress=every.append, progress_seconds=0))
    run(make(tiny_weights, scene), Callbacks(progress=few.append, progress_seconds=math.inf))
    assert [(report.step, report.total, report.stage) for report in every] == [(step, 5, "sos") for step in range(1, 6)]
    assert [report.step for report in few] == [1, 5]
    assert (few[-1].mean_loss, few[-1].mean_scales) == (every[-1].mean_loss, every[-1].mean_scales)
    ended, stopped = list[Progress](), make(tiny_weights, scene)
    callbacks = Callbacks(progress=ended.append, progress_seconds=math.inf, stop=lambda: stopped.step == 3)
    assert run(stopped, callbacks) == "interrupted"
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
    assert (stylizer.job.plan.steps_coarse, stylizer.job.total_steps) == (phase_1, phase_1 + 5)


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


COLOR: Color = (0.2, 0.9, 0.4)


# --- colors -------------------------------------------------------------------------------------------------------


def test_color_depends_only_on_seed_step_and_view() -> None:
    """One color is hard-coded, because it must be the same on every machine and with every version."""
    image = Style.of(style())
    assert drawn_color("random", 5, 7, 11, image) == (0.659657205637411, 0.3164479498593752, 0.6750821160034983)
    colors = {
        numbers: drawn_color("random", *numbers, image)
        for numbers in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (2**63 - 1, 10**6, 300), (0, 11, 1), (0, 1, 11))
    }
    assert len(set(colors.values())) == len(colors)
    assert all(drawn_color("random", *numbers, image) == color for numbers, color in colors.items())
    assert drawn_color("background", 0, 0, 0, image) is None


def test_palette_colors_are_those_of_style_pixels() -> None:
    image = Style.of(torch.tensor([[[0.1, 0.2, 0.3], [0.9, 0.5, 0.0], [0.9, 0.5, 0.0]], [[1.0, 1.0, 1.0]] * 3]))
    drawn = [drawn_color("palette", 0, step, 0, image) for step in range(3000)]
    shares = {color: drawn.count(color) / len(drawn) for color in set(drawn)}
    expected = {tuple(pixel.tolist()): 1 / 6 for pixel in image.images[0].reshape(-1, 3)}
    expected |= {tuple(image.images[0][0, 1].tolist()): 2 / 6, (1.0, 1.0, 1.0): 3 / 6}
    assert shares == pytest.approx(expected, abs=0.03)


# --- images on the background --------------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [0, 2])
def test_replaced_background_matches_a_render_with_it(scale: int) -> None:
    scene, camera, present = ball(), cameras(1)[0], (0.7, 0.0, 0.3)
    colors = torch.rand(len(scene), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    over, expected = (ReferenceRasterizer(scene, background=color).render(colors, camera) for color in (present, COLOR))
    coverage = ReferenceRasterizer(scene).coverage(camera)
    actual = replace_background(downscale(over, scale), downscale(coverage, scale), COLOR, present)
    torch.testing.assert_close(actual, downscale(expected, scale), rtol=0, atol=1e-12)
    assert replace_background(over.float(), coverage.float(), COLOR, present).dtype == torch.float32


def drawn_gradient(stylizer: Stylizer, index: int, scales: list[int], behind: Color | None) -> tuple[Any, Any]:
    target, targets = (
        stylizer.job.view_targets.target(index, scales, behind),
        stylizer.job.style_targets(stylizer.job.views.cameras[0]),
    )
    return stylizer.job.gradient(index, stylizer.sh_dc.detach(), targets, target, scales, behind)


@pytest.mark.parametrize(("scales", "content"), [([0, 1], "cached"), ([1], "uncached")])
def test_step_gradient_matches_a_job_with_its_background(
    tiny_weights: BackboneWeights, scales: list[int], content: Literal["cached", "uncached"]
) -> None:
    """The content also gets the step's background, whether or not its images are cached."""
    drawn = make(tiny_weights, ball(), coarsest_side=24, training_background="random", background=(0.1, 0.1, 0.5))
    fixed = make(tiny_weights, ball(), coarsest_side=24, training_background="background", background=COLOR)
    if content == "uncached":
        drawn.job.view_targets._images = Cache(0, lambda _: 1)
    with torch.no_grad():
        drawn.sh_dc += 0.3
        fixed.sh_dc.copy_(drawn.sh_dc)
    for _ in range(2):
        actual, loss = drawn_gradient(drawn, 1, scales, COLOR)
        expected, exact = drawn_gradient(fixed, 1, scales, None)
        assert loss.loss == pytest.approx(exact.loss, rel=1e-5)
        assert loss.terms[scales[-1]]["content"] == pytest.approx(exact.terms[scales[-1]]["content"], rel=1e-3)
        assert exact.terms[scales[-1]]["content"] > 0
        assert relative_error(actual, expected) < 1e-4


def test_photos_get_the_color_in_uncovered_pixels(tiny_weights: BackboneWeights) -> None:
    photo = synthetic_image(HEIGHT, WIDTH, seed=9, dtype=torch.float32)
    settings = make_settings(training_background="random", steps_sos=2)
    stylizer = Stylizer.planned(ball(), cameras(1), style(), settings, weights=tiny_weights, photos=lambda _: photo)
    coverage = stylizer.job.view_targets.coverage(0)[0][..., None]
    content = coverage * photo + (1 - coverage) * torch.tensor(COLOR)
    expected = stylizer.job.loss.targets.of_view(content, coverage[..., 0]).content[0]
    actual = stylizer.job.view_targets.target(0, [0], COLOR).content[0]
    for tile, features in expected.items():
        torch.testing.assert_close(actual[tile], features, rtol=1e-4, atol=1e-2)


def test_losses_are_measured_on_the_fixed_background(tiny_weights: BackboneWeights) -> None:
    """Losses before and after are measured on the background of the settings, whatever the steps used."""
    values: dict[str, Any] = {"coarsest_side": 24, "background": (0.3, 0.2, 0.1), "warm_start": False}
    drawn, fixed = (
        make(tiny_weights, ball(), training_background=kind, **values) for kind in ("palette", "background")
    )
    assert drawn.start() == fixed.start()
    run(drawn)
    assert mean_loss(drawn.evaluate([0, 1])) == mean_loss(fixed.evaluate([0, 1], drawn.sh_dc.detach()))


# --- whole runs ----------------------------------------------------------------------------------------------------


def make_in_float16(weights: BackboneWeights, precision: PlannedPrecision, **values: Any) -> Stylizer:
    """Make a job with a fixed plan, so that the precision does not depend on the processor."""
    inputs = wall(40, 30), cameras(), Style.of(style())
    settings = make_settings(**{"steps_coarse": 2, "steps_sos": 4, "coarsest_side": 24, "early_stop": False, **values})
    plan = plan_job(JobInputs(*inputs, settings, weights=weights)).plan
    return Stylizer(prepare_job(replace(plan, precision=precision), JobInputs(*inputs, settings, weights=weights)))


def test_overflowing_step_is_repeated_in_bfloat16(tiny_weights: BackboneWeights) -> None:
    """A content weight of 1e12 makes gradients too large for float16."""
    half, expected = (make_in_float16(tiny_weights, name, content_weight=1e12) for name in ("float16", "bfloat16"))
    for _ in range(3):
        assert half.run_step().terms == expected.run_step().terms
    assert half.job.plan.precision == half.job.network.precision == "bfloat16"
    assert torch.equal(half.sh_dc, expected.sh_dc)
    line = half.job.plan.decisions[-1]
    assert (line.item, line.decision) == ("precision", "features in bfloat16 from step 1 on")


def test_steps_follow_those_of_float32(tiny_weights: BackboneWeights) -> None:
    half, exact = (make_in_float16(tiny_weights, name) for name in ("float16", "float32"))
    for _ in range(half.job.total_steps):
        assert half.run_step().loss == pytest.approx(exact.run_step().loss, rel=0.1)
    assert half.job.network.dtype == torch.float16
    assert torch.isfinite(half.sh_dc).all()


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Use an empty cache folder, and return the file of the rates."""
    monkeypatch.setenv("SGSST_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "rates.json"


@pytest.fixture
def network(tiny_weights: BackboneWeights) -> FeatureNetwork:
    return FeatureNetwork(tiny_weights)


def rates(network: FeatureNetwork, precision: PlannedPrecision = "float32") -> Rates:
    return Rates(network, precision, make_settings())


def test_rates_are_remembered_merged_and_interpolated(cache: Path, network: FeatureNetwork) -> None:
    known = rates(network)
    known.remember(1000, 4.0)
    known.remember(1_000_000, 100.0)
    actual = [known.rate(pixels) for pixels in (1, 1000, 2**15, 2**20, 1e9)]
    assert actual == pytest.approx([4.0, 4.0, 52.0, 100.0, 100.0])
    known.remember(1000, 16.0)
    assert rates(network).rate(1000) == pytest.approx(8.0), "the geometric mean"
    rates(network, "winograd").remember(1000, 1.0)
    assert known.rate(1000) == pytest.approx(8.0)
    assert len(json.loads(cache.read_text())) == 2


@pytest.mark.parametrize("content", [None, "", "[1]", '{"a": 1}', '{"a": {"b": "c"}}', '{"a": {"b": 1}}', "\x00\xff"])
def test_unknown_rate_is_tried_on_a_small_image(cache: Path, network: FeatureNetwork, content: str | None) -> None:
    if content is not None:
        cache.parent.mkdir()
        cache.write_text(content, "latin-1")
    state = torch.random.get_rng_state()
    assert 0 < rates(network).rate(1000) < math.inf
    assert torch.equal(torch.random.get_rng_state(), state)
    rates(network).remember(1000, 3.0)
    assert rates(network).rate(1000) == pytest.approx(3.0)


def test_remaining_time_follows_the_estimate_then_the_own_pace(cache: Path, tiny_weights: BackboneWeights) -> None:
    """An earlier job has left behind a rate of a pixel per second, as if steps took hours."""
    stylizer = Stylizer.planned(
        wall(10, 8), cameras(2, 32, 24), style(), make_settings("preview", steps_sos=13), weights=tiny_weights
    )
    job, seen = stylizer.job, list[Progress]()
    Rates(job.network, job.plan.precision, job.settings).remember(job.plan.work.sos, 1.0)
    expected = estimate(job)
    assert expected.seconds == pytest.approx(job.plan.work.sos + 2 * job.survey_seconds)
    assert expected.job == pytest.approx(13 * expected.seconds + expected.measuring)
    run(stylizer, Callbacks(progress=seen.append, progress_seconds=0))
    left = [progress.eta_s or 0.0 for progress in seen]
    steps = [13 - progress.step for progress in seen]
    assert left[:10] == pytest.approx([each * expected.seconds + expected.ending for each in steps[:10]], rel=0.02)
    assert all(0 < each < 0.1 * expected.seconds for each in left[10:])
    (remembered,) = json.loads(cache.read_text()).values()
    assert all(rate > 1 for rate in remembered.values()), "this job's rate is merged"


def test_budget_limits_the_shown_time_and_its_end_leaves_a_rate_behind(
    cache: Path, tiny_weights: BackboneWeights
) -> None:
    stylizer = Stylizer.planned(
        wall(10, 8), cameras(2, 32, 24), style(), make_settings("preview", steps_sos=3), weights=tiny_weights
    )
    job, seen = stylizer.job, list[Progress]()
    Rates(job.network, job.plan.precision, job.settings).remember(job.plan.work.sos, 1.0)
    callbacks = Callbacks(progress=seen.append, progress_seconds=0, left=lambda: 100.0 if stylizer.step < 2 else 0.0)
    assert run(stylizer, callbacks) == "within"
    assert [progress.eta_s for progress in seen] == [100.0, 0.0]
    (remembered,) = json.loads(cache.read_text()).values()
    assert all(rate > 2 for rate in remembered.values())


def test_slow_first_step_does_not_end_a_time_budget(
    cache: Path, tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch
) -> None:
    stylizer = Stylizer.planned(
        wall(10, 8), cameras(2, 32, 24), style(), make_settings("preview", steps_sos=5), weights=tiny_weights
    )
    queue_step = stylizer.queue_step

    def queue_with_slow_first_step() -> None:
        stylizer.seconds += 0 if stylizer.step else 100.0
        queue_step()

    monkeypatch.setattr(stylizer, "queue_step", queue_with_slow_first_step)
    assert run(stylizer, Callbacks(left=lambda: 50.0)) == "finished"


@pytest.mark.parametrize("stored", ["0", "-1", "NaN", "Infinity"])
def test_stored_rate_that_no_machine_has_is_ignored(cache: Path, network: FeatureNetwork, stored: str) -> None:
    rates(network).remember(1000, 3.0)
    cache.write_text(cache.read_text().replace("3.0", stored))
    assert 0 < rates(network).rate(1000) < math.inf
    rates(network).remember(1000, 4.0)
    assert rates(network).rate(1000) == pytest.approx(4.0)
