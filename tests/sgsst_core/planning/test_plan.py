"""Tests of plans: their rules, precision, time budget and reasons; what they leave out does not change results."""

import itertools
import random
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import torch
from safetensors import safe_open

from benchmarks.left_out import EVERYTHING, with_components
from sgsst_core.devices import seconds_left
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import Rectangle
from sgsst_core.parallel import ALONE, Size, Tiling
from sgsst_core.planning.plan import (
    Device,
    Facts,
    Machine,
    Plan,
    choose_precision,
    describe_machine,
    make_plan,
    with_groups,
)
from sgsst_core.planning.survey import Survey
from sgsst_core.planning.time_budget import Pace, TimeChoice, choosable, choose, evaluated_pixels
from sgsst_core.report.document import repeating_options
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import PlannedPrecision, Precision, PresetName, Settings, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.checkpoint import save_plan
from sgsst_core.stylizing.job import JobInputs, plan_job
from sgsst_core.stylizing.loop import Callbacks, run
from sgsst_core.stylizing.styles import neighbors_change
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.synthetic_images import relative_error, synthetic_image
from tests.small_scenes import ball, cameras, style, wall

CPU, GPU = Machine("cpu", 1 << 33), Machine("cuda", 1 << 33, graphs=True)


def facts(
    machine: Machine = CPU,
    *,
    size: Size = (545, 980),
    views: int = 4,
    gaussians: int = 1000,
    uncovered: float = 0.0,
    **values: Any,
) -> Facts:
    """Return the facts about views of one size that see all Gaussians of a scene."""
    weights, regions = torch.ones(gaussians, dtype=torch.float64), [Rectangle(0, 0, *size)] * views
    given: dict[str, Any] = {
        "sh_degree": 0,
        "used_degree": 0,
        "harmonics_energy": 0.0,
        "rasterizer": "cpu" if machine.device == "cpu" else "triton",
        "precision": "float32",
        "tiling": Tiling(halo=64, held=1e7, working=0.25, coarsest=256),
        "pixel_bytes": 2000.0,
        **values,
    }
    return Facts(
        gaussians=gaussians,
        sizes=(size,) * views,
        survey=Survey(weights, list(range(views)), regions, uncovered),
        machine=machine,
        **given,
    )


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
        job = plan_job(JobInputs(scene, views, Style.of(style()), settings, weights=tiny_weights, measured=True))
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
        "partition",
    }
    assert (decisions["unseen Gaussians"].bytes or 0) == int((~plan.seen).sum()) * 48
    assert plan.steps_coarse == 0


def test_unseen_gaussians_follow_their_seen_neighbors() -> None:
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.1, 0, 0], [50, 0, 0]])
    change = torch.tensor([[1.0, 0, 0], [0, 1, 0], [9, 9, 9], [9, 9, 9]])
    change_of_all = neighbors_change(means, change, torch.tensor([3e-9, 1e-9, 0, 0], dtype=torch.float64))
    torch.testing.assert_close(change_of_all, torch.tensor([[0.75, 0.25, 0], [0.75, 0.25, 0]]))
    assert neighbors_change(means, change, torch.ones(4, dtype=torch.float64)).shape == (0, 3)


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


pytestmark = pytest.mark.usefixtures("one_thread")
ON_CPU: tuple[PlannedPrecision, ...] = ("winograd",)
AMX: tuple[PlannedPrecision, ...] = ("bfloat16", "winograd")
AMPERE: tuple[PlannedPrecision, ...] = ("float16", "bfloat16", "tf32")


@pytest.mark.parametrize(
    ("device", "precisions", "requested", "chosen"),
    [
        ("cpu", ON_CPU, "auto", "winograd"),
        ("cpu", AMX, "auto", "bfloat16"),
        ("cpu", (), "auto", "float32"),
        ("cuda", AMPERE, "auto", "float16"),
        ("cuda", ("bfloat16",), "auto", "bfloat16"),  # an AMD GPU
        ("cuda", (), "auto", "float32"),  # an NVIDIA GPU of compute capability 7.5
        *(("cpu", AMX, name, name) for name in ("float32", "winograd", "bfloat16")),
        *(("cuda", AMPERE, name, name) for name in ("float32", "tf32", "bfloat16", "float16")),
    ],
)
def test_precision_is_the_requested_or_the_fastest(
    device: Device, precisions: tuple[PlannedPrecision, ...], requested: Precision, chosen: str
) -> None:
    machine = Machine(device, 1 << 33, precisions=precisions)
    assert choose_precision(make_settings(precision=requested), machine) == chosen
    assert choose_precision(make_settings("paper"), machine) == "float32"


@pytest.mark.parametrize(
    ("device", "precisions", "requested", "needed"),
    [
        (
            "cpu",
            ON_CPU,
            "bfloat16",
            r"a CPU with matrix units \(AMX\), an AMD GPU, or an NVIDIA GPU .* this CPU is not",
        ),
        ("cpu", AMX, "tf32", "an NVIDIA GPU of compute capability 8.0 or higher, which this CPU is not"),
        ("cpu", AMX, "float16", "an NVIDIA GPU of compute capability 8.0 or higher, which this CPU is not"),
        ("cuda", ("bfloat16",), "float16", "an NVIDIA GPU .* which this GPU is not"),
        ("cuda", (), "bfloat16", ".* an NVIDIA GPU .* which this GPU is not"),
        ("cuda", AMPERE, "winograd", "a CPU, which this GPU is not"),
    ],
)
def test_precision_that_the_processor_lacks_is_refused(
    device: Device, precisions: tuple[PlannedPrecision, ...], requested: Precision, needed: str
) -> None:
    with pytest.raises(SettingsError, match=f"--precision {requested} needs {needed}. Give another one"):
        choose_precision(make_settings(precision=requested), Machine(device, 1 << 33, precisions=precisions))


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [({"amx_bf16": True}, AMX), ({"avx512_bf16": True}, ON_CPU), ({}, ON_CPU), (None, ON_CPU)],
)
def test_cpu_has_bfloat16_with_matrix_units(
    monkeypatch: pytest.MonkeyPatch, capabilities: dict[str, bool] | None, expected: tuple[PlannedPrecision, ...]
) -> None:
    """Earlier versions of PyTorch have no list of capabilities."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    if capabilities is None:
        monkeypatch.delattr(torch.cpu, "get_capabilities")
    assert set(describe_machine(make_settings(), ALONE).precisions) == set(expected)


def test_every_rank_must_have_the_precision(monkeypatch: pytest.MonkeyPatch) -> None:
    """The memory limit is the least one, too."""

    class Others(type(ALONE)):  # type: ignore[misc]
        def all_gather(self, value: Any) -> list[Any]:
            own = dict.fromkeys(("float16", "bfloat16", "tf32"), False) | {"winograd": True}
            return [value, (1000, own, True)] if isinstance(value, tuple) else [value]

    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": True}, raising=False)
    machine = describe_machine(make_settings(), Others())
    assert (machine.precisions, machine.memory_limit, machine.graphs) == (("winograd",), 1000, False)


@pytest.mark.parametrize(("preset", "amx", "chosen"), [("standard", True, "bfloat16"), ("preview", False, "winograd")])
def test_chosen_precision_is_used_said_and_repeatable(
    tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch, preset: PresetName, amx: bool, chosen: Precision
) -> None:
    """A job with a chosen precision has the bits of one in which it was requested."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": amx}, raising=False)
    auto, asked = (
        Stylizer.planned(ball(60), cameras(1), style(), make_settings(preset, precision=each), weights=tiny_weights)
        for each in ("auto", chosen)
    )
    lines = [decision for each in (auto, asked) for decision in each.job.plan.decisions if decision.item == "precision"]
    done = "convolutions by Winograd's algorithm" if chosen == "winograd" else f"features in {chosen}"
    assert [line.decision for line in lines] == [done] * 2
    assert [line.reason for line in lines] == ["the fastest that the processor computes", "requested"]
    assert "relative error of the pixel gradient" in lines[0].error
    assert auto.job.plan.precision == auto.job.network.precision == chosen
    assert auto.job.plan.is_approximated == (chosen == "bfloat16")
    assert auto.run_step().loss == asked.run_step().loss
    assert torch.equal(auto.sh_dc, asked.sh_dc)


#: Steps enough for anything that pays off after several visits.
LONG: dict[str, Any] = {"steps_coarse": 0, "steps_sos": 400}


def decision(plan: Plan, item: str) -> tuple[str, str]:
    """Return a decision of a plan with its reason."""
    return next((each.decision, each.reason) for each in plan.decisions if each.item == item)


@pytest.mark.parametrize(
    ("machine", "ranks", "views", "size", "values", "groups"),
    [
        (CPU, 1, 24, (545, 980), {}, 1),
        (CPU, 2, 24, (545, 980), {}, 2),
        (CPU, 8, 24, (545, 980), {}, 8),
        (CPU, 8, 15, (545, 980), {}, 1),  # fewer than two rounds of views
        (CPU, 2, 24, (2160, 3840), {}, 1),
        (GPU, 2, 24, (1080, 1920), {}, 2),
        (GPU, 8, 24, (3361, 5187), {}, 1),
        (CPU, 2, 24, (545, 980), {"preset": "paper"}, 1),
        (CPU, 2, 24, (545, 980), {"steps_sos": 240}, 1),
        (CPU, 2, 24, (545, 980), {"steps_coarse": 0}, 1),
        (CPU, 2, 24, (545, 980), {"views_per_step": 1}, 1),
        (CPU, 2, 24, (545, 980), {"within": 60}, 1),
    ],
)
def test_ranks_get_a_view_each_if_views_are_too_small_to_divide(
    machine: Machine, ranks: int, views: int, size: Size, values: dict[str, Any], groups: int
) -> None:
    settings = make_settings(**values)
    plan = make_plan(facts(replace(machine, ranks=ranks, sharing=ranks), size=size, views=views), settings)
    assert (plan.ranks, plan.groups) == (ranks, groups)
    used = with_groups(settings, groups)
    assert used.views_per_step == groups
    assert used.steps_sos == settings.steps_sos if groups == 1 else 60 < used.steps_sos < 240 * 2 / groups**0.5
    assert {each.item for each in plan.decisions} >= ({"ranks"} if ranks > 1 else set())


@pytest.mark.parametrize(
    ("values", "known", "cached", "reason"),
    [
        ({}, {"weight_bytes": None}, "none", "does not cache them"),
        ({"cached_weights": "float32"}, {"weight_bytes": None}, "none", "does not cache them"),
        ({}, {}, "float32", "they take 1.00 GB for all views; 2.1 GB are available"),
        ({"steps_sos": 28}, {}, "none", "a view is visited only 7.0 times"),
        ({"steps_sos": 32}, {}, "float32", "they take"),
        ({"steps_sos": 28, "cached_weights": "half"}, {}, "half", "they take 0.50 GB"),
        ({"cached_weights": "none"}, {}, "none", "requested"),
        ({}, {"weight_bytes": (4 * 10**9, 2 * 10**9)}, "half", "they take 2.00 GB"),
        ({"preset": "paper"}, {"weight_bytes": (4 * 10**9, 2 * 10**9)}, "float32", "they take 4.00 GB"),
        ({}, {"weight_bytes": (20 * 10**9, 10**10)}, "none", "the weights of one view do not fit"),
    ],
)
def test_blend_weights_are_cached_on_a_gpu_as_memory_and_visits_allow(
    values: dict[str, Any], known: dict[str, Any], cached: str, reason: str
) -> None:
    given = facts(GPU, **{"weight_bytes": (10**9, 5 * 10**8), **known})
    plan = make_plan(given, make_settings(**{**LONG, **values}))
    assert (plan.cached_weights, plan.rasterizer) == (cached, "triton" if cached == "none" else "cached")
    line, why = decision(plan, "blend weights")
    assert reason in why
    assert ("half precision" in line, plan.is_approximated) == (cached == "half", cached == "half")


@pytest.mark.parametrize(
    ("machine", "known", "values", "used"),
    [
        (GPU, {}, {}, True),
        (replace(GPU, graphs=False), {}, {}, False),
        (replace(GPU, ranks=2), {"size": (3361, 5187)}, {}, False),
        (GPU, {}, {"steps_sos": 19}, False),
        (GPU, {}, {"steps_sos": 20}, True),
        (GPU, {"uncovered": 0.5}, {"steps_sos": 76}, False),  # each view has its own region
        (GPU, {"size": (2160, 3840)}, {}, False),
    ],
)
def test_graphs_are_used_for_small_views_that_are_visited_often(
    machine: Machine, known: dict[str, Any], values: dict[str, Any], used: bool
) -> None:
    plan = make_plan(facts(machine, **known), make_settings(**{**LONG, **values}))
    assert plan.graphs == used == ("CUDA graph" in decision(plan, "launches")[0])


@pytest.mark.parametrize(
    ("steps", "values", "views", "loss_views", "novel_views"),
    [
        (400, {}, 24, 4, 4),  # 20 passes: 4 for the loss, 2 for each novel view
        (400, {}, 3, 3, 4),
        (160, {}, 24, 4, 2),
        (40, {}, 24, 4, 0),
        (400, {"measure": 0.0}, 24, 4, 0),
        (6, {"measure": 1.0}, 24, 4, 1),
        (80, {"views_per_step": 2}, 24, 4, 2),
    ],
)
def test_measurements_take_at_most_a_fraction_of_the_passes(
    steps: int, values: dict[str, Any], views: int, loss_views: int, novel_views: int
) -> None:
    settings = make_settings(steps_coarse=0, steps_sos=steps, **values)
    plan = make_plan(facts(views=views), settings, measured=True)
    assert (plan.loss_views, plan.novel_views) == (loss_views, novel_views)
    assert f"on {loss_views} view{'s' * (loss_views > 1)}" in decision(plan, "measuring")[0]
    assert (plan.work.measuring > 0) == (loss_views + novel_views > 0)
    unmeasured = make_plan(facts(views=views), settings)
    assert (unmeasured.loss_views, unmeasured.novel_views, unmeasured.work.measuring) == (loss_views, 0, 0.0)


@pytest.mark.parametrize("machine", [CPU, GPU])
def test_memory_bound_grows_with_views_gaussians_and_approximations(machine: Machine) -> None:
    def bound(**known: Any) -> int:
        plan = make_plan(facts(machine, **known), make_settings(**LONG), measured=True)
        bytes_ = plan.peak_bytes if machine.device == "cpu" else plan.device_bytes
        assert bytes_ is not None
        return bytes_

    usual = bound()
    assert (make_plan(facts(machine), make_settings(**LONG)).device_bytes is None) == (machine.device == "cpu")
    assert bound(views=8) > usual
    assert bound(size=(1090, 1960)) > usual
    assert bound(gaussians=10**6) >= usual + 10**6 * 400
    assert bound(intersection_bytes=10**7) == usual + 10**7
    assert bound(precision="bfloat16") > usual
    images = 80 * 9000**2  # of a step, which no budget limits
    assert bound(views=9, size=(9000, 9000), intersection_bytes=10**12) < 1.1 * machine.memory_limit + 10**9 + images


#: 97 views of 1280 pixels, and a pace of 0.1 s per step at 160 pixels.
VIEWS = [resized(cameras(1)[0], 1280)] * 97
RATE = evaluated_pixels([resized(VIEWS[0], 160)], make_settings())[0] / 0.08
PACE = Pace(lambda pixels: RATE, 0.01, 160 * 120)


def chosen(seconds: float, settings: Settings | None = None) -> TimeChoice:
    return choose(VIEWS, settings or make_settings(within=seconds), PACE, seconds, 100)


def test_more_time_never_brings_less() -> None:
    choices = [chosen(2.0**power) for power in range(16)]
    for less, more in pairwise(choices):
        steps, more_steps = (each.steps_coarse + each.steps_sos for each in (less, more))
        assert (less.resolution, steps) <= (more.resolution, more_steps)
        assert more_steps >= steps or more.resolution > less.resolution
    assert (choices[0].resolution, choices[-1].resolution, choices[-1].steps_sos) == (96, 1280, 240)
    assert "; in " not in choices[-1].decision(2.0**15, 240).reason


@pytest.mark.parametrize("seconds", [20, 60, 300])
def test_choice_fits_the_budget_and_nearly_uses_it(seconds: float) -> None:
    choice = chosen(seconds)
    assert 0.8 * seconds < choice.seconds <= seconds


def test_views_are_as_large_as_lets_enough_steps_fit() -> None:
    for seconds in (10, 34, 100):
        choice = chosen(seconds)
        assert 96 < choice.resolution < 1280
        assert 1 <= choice.steps_sos / (60 * min(1, choice.resolution / 480)) < 1.6
        assert not choice.steps_coarse
    assert chosen(1).resolution == 96
    preview = chosen(34, make_settings("preview", within=34))
    assert 60 * preview.resolution / 480 <= preview.steps_sos <= 60
    assert "; in 20 min 00 s: " in chosen(300).decision(300, 81).reason


def test_what_more_time_brings_is_more_than_the_steps() -> None:
    choice = chosen(12)
    more = f"; in 48 s: {choice.longer_resolution} px"
    assert choice.decision(12, choice.longer_steps - 1).reason.endswith(f"{more}, {choice.longer_steps} steps")
    assert choice.decision(12, choice.longer_steps).reason.endswith(more)
    assert "; in " not in choice.decision(None, choice.steps_sos).reason
    preview = chosen(10, make_settings("preview", within=10))
    assert preview.longer_resolution < 511
    assert preview.longer_steps <= 60, "there is one scale, so one phase"


def test_slower_small_steps_lower_the_choice_of_small_budgets() -> None:
    pace = replace(PACE, rate=lambda pixels: RATE * min(1.0, pixels / 4e5))
    choices = [
        [choose(VIEWS, make_settings(within=time), each, time, 100) for each in (PACE, pace)] for time in (20, 600)
    ]
    assert [slow.resolution < usual.resolution for usual, slow in choices] == [True, False]


def test_budget_that_nothing_fits_is_said_to_be_exceeded() -> None:
    assert "more than the 1 s given" in chosen(1).decision(1, 1).reason
    assert "more than" not in chosen(20).decision(20, 1).reason


def test_given_options_stay() -> None:
    settings = make_settings(within=20, steps_sos=150, max_resolution=1280)
    assert settings.fixed == ("max_resolution", "steps_sos")
    assert not choosable(settings)
    choice = chosen(10, make_settings(within=10, steps_sos=150))
    assert (choice.steps_sos, choice.most_steps) == (150, None)
    assert choice.resolution < 256
    assert chosen(60, make_settings(within=60, max_resolution=1280)).resolution == 1280
    every = make_settings(within=5).model_copy(update={"fixed": ("views",)})
    assert len(chosen(5, every).views) == 97
    assert len(chosen(5).views) == chosen(5).steps_sos < 97


@pytest.mark.parametrize(
    ("values", "most"),
    [({}, 240), ({"learning_rate": 0.1}, 240), ({"learning_rate_end": 0.01}, None), ({"steps_sos": 240}, None)],
)
def test_pace_decides_the_steps_unless_they_or_a_falling_learning_rate_are_given(
    values: dict[str, Any], most: int | None
) -> None:
    assert chosen(20, make_settings(within=20, **values)).most_steps == most


@pytest.mark.parametrize("preset", ["preview", "standard", "paper"])
@pytest.mark.parametrize("total", [3, 109, 240, 777])
def test_learning_rate_of_a_step_does_not_depend_on_the_number_of_steps(preset: PresetName, total: int) -> None:
    whole = make_settings(preset)
    before = whole.steps_coarse + whole.steps_sos
    twice = whole.with_steps(1, total).with_steps(0, total)
    for settings in (whole.with_steps(0, total), twice):
        for step in range(0, min(total, before), 7):
            rates = whole.learning_rate_at(step / (before - 1)), settings.learning_rate_at(step / (total - 1))
            assert np.float32(rates[0]) == np.float32(rates[1])
    given = make_settings(preset, learning_rate_end=0.01)
    assert given.with_steps(0, total).learning_rate_end == 0.01


def test_budget_counts_from_the_given_start(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [1000.0]
    monkeypatch.setattr("time.time", lambda: 5e9 + now[0])
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    assert seconds_left(None) is None
    left = seconds_left(60.0, 5e9 + 980.0)
    assert left is not None
    assert left() == 40.0
    now[0] += 50
    assert left() == -10.0


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize(("preset", "enough"), [("preview", 3), ("preview", 4), ("preview", 8), ("standard", 9)])
def test_printed_options_repeat_a_steered_job_bit_for_bit(
    tiny_weights: BackboneWeights, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, preset: PresetName, enough: int
) -> None:
    """There is time for more steps than the five that were chosen, until there have been enough of them."""
    monkeypatch.setenv("SGSST_CACHE", str(tmp_path))
    scene, views, settings = wall(10, 8), cameras(4, 32, 24), make_settings(preset, within=1e6)
    steered = Stylizer.planned(scene, views, style(), settings, weights=tiny_weights, left=lambda: 1e6)
    steered.job = replace(steered.job, settings=steered.job.settings.with_steps(0, 5))
    assert run(steered, Callbacks(left=lambda: 1e6 if steered.step < enough else 0.0)) == "within"
    assert steered.step == enough
    assert (steered.job.total_steps == enough) == (enough in (4, 9)), "steered to what has been done"
    options = repeating_options(steered)
    assert options is not None
    words, flag = options.removesuffix(" --no-early-stop").split(), options.endswith(" --no-early-stop")
    given = {name[2:].replace("-", "_"): value for name, value in zip(words[::2], words[1::2], strict=True)}
    some = spread(views, int(given.pop("views")))
    own: dict[str, Any] = {"early_stop": False if flag else None, **{name: int(given[name]) for name in given}}
    again = Stylizer.planned(scene, some, style(), make_settings(preset, **own), weights=tiny_weights)
    assert repeating_options(again) is None
    assert (run(again), again.step) == ("finished", enough)
    assert torch.equal(again.stylized(), steered.stylized())
