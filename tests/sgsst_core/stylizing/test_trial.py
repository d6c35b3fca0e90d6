"""Tests of the trial of a job, and of what the plan predicts and chooses from it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core.decision import Decision
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.partition import Rectangle
from sgsst_core.planning.choices import OPTIMIZER_BYTES, considers_groups, draft_plan, with_groups, worth
from sgsst_core.planning.context import Facts, Hardware, NetworkPixels, Saving, WeightCost
from sgsst_core.planning.measurement_choice import allowed_seconds
from sgsst_core.planning.plan import Plan, Prediction, Shape
from sgsst_core.planning.survey import Survey
from sgsst_core.settings import make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import prepare_job
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.planner import plan_job
from sgsst_core.stylizing.prediction import completed_plan
from sgsst_core.stylizing.schedule import drawn_views
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.stylizing.trial import StepCost, Trial, run_trial
from tests.sgsst_core.splat_scenes import is_cached
from tests.small_scenes import ball, cameras, style, wall

GIGABYTE = 10**9
VIEWS, HEIGHT, WIDTH = 4, 600, 800
PARTS = {"prepare": 0.0, "render": 0.1, "vgg_forward": 0.4, "vgg_backward": 1.0, "raster_backward": 0.1}
TRIAL = Trial(
    coarse=StepCost(0.4, 2.0, {}),
    sos=StepCost(2.0, 1.0, PARTS),
    views=1,
    style=0.5,
    render=0.3,
    prepare=0.2,
    process=2 * GIGABYTE,
    device=None,
    passing=GIGABYTE,
    growth=GIGABYTE,
    novel=0,
    free=0,
    spare=0,
)


# --- the trial -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("values", [{}, {"memory_limit": 600_000}, {"training_background": "random"}])
@pytest.mark.parametrize("scene", [wall(sh_degree=1), ball()], ids=["wall", "ball"])
def test_steps_after_a_trial_are_bit_identical(tiny_weights: BackboneWeights, scene: Any, values: Any) -> None:
    """With little memory, the first views fill the cache of blend weights, so their order matters."""
    inputs = scene, cameras(3), Style.of(style())
    settings = make_settings(steps_coarse=2, steps_sos=14, coarsest_side=24, early_stop=False, **values)
    job = plan_job(*inputs, settings, weights=tiny_weights)
    tried, fresh = Stylizer(job), Stylizer(prepare_job(job.plan, *inputs, settings, weights=tiny_weights))
    for stylizer in (tried, fresh):
        run(stylizer)
    assert job.plan.cached_weights != "none"
    assert [record.loss for record in tried.history] == [record.loss for record in fresh.history]
    assert torch.equal(tried.stylized(), fresh.stylized())


def test_trial_measures_steps_and_memory(tiny_weights: BackboneWeights) -> None:
    settings = make_settings(steps_coarse=3, steps_sos=14, coarsest_side=24)
    job = plan_job(wall(sh_degree=1), cameras(3), Style.of(style()), settings, weights=tiny_weights)
    first = next(drawn_views(job.views.covered, settings.seed))
    assert all(cache.costs for name, cache in job.caches.items() if name in ("weights", "content", "colors"))
    assert is_cached(job.views.rasterizer, job.views.cameras[first])
    again = run_trial(job)
    assert again.views == 2
    assert 0 < again.coarse.seconds < again.sos.seconds
    assert again.sos.first >= 0 < again.render
    assert again.process > 10**7
    assert again.device is None
    assert {"render", "vgg_forward", "vgg_backward", "raster_backward", "optimizer"} <= again.sos.parts.keys()
    sizes = {name: cache.used for name, cache in job.caches.items()}
    assert again.growth == pytest.approx(sum(sizes[name] for name in ("weights", "content", "colors")) / 2, rel=0.6)


@pytest.mark.parametrize(("coarsest_side", "phases"), [(24, 2), (511, 1)])
def test_phases_that_evaluate_the_same_scale_are_tried_once(
    tiny_weights: BackboneWeights, coarsest_side: int, phases: int
) -> None:
    settings = make_settings("paper", steps_coarse=3, steps_sos=14, coarsest_side=coarsest_side)
    job = plan_job(wall(), cameras(3), Style.of(style()), settings, weights=tiny_weights)
    shown: list[tuple[int, int]] = []
    trial = run_trial(job, lambda done, total: shown.append((done, total)))
    assert shown[0] == (0, 2 * phases)
    assert (trial.coarse.seconds == trial.sos.seconds) == (phases == 1)


# --- the plan ------------------------------------------------------------------------------------------------------


def facts(**changes: Any) -> Facts:
    """Return facts about a CPU with 10 GB, and about four views that six Gaussians fill; `changes` replace fields."""
    weights = torch.tensor([0.0, 0.5, 1.0, 2.0, 4.0, 8.0], dtype=torch.float64)
    survey = Survey(
        weights, list(range(VIEWS)), [Rectangle(0, 0, HEIGHT, WIDTH)] * VIEWS, changes.pop("uncovered", 0.0)
    )
    known = Facts(6, 3, 3, 0.0, ((HEIGHT, WIDTH),) * VIEWS, survey, Hardware("cpu", 10 * GIGABYTE), "cpu", WeightCost())
    return replace(known, **changes)


def plan_of(known: Facts, trials: dict[Shape, Trial] | None = None, cost: Saving | None = None, **values: Any) -> Plan:
    settings = make_settings(
        **{"steps_coarse": 40, "steps_sos": 40, "coarsest_side": 300, "scale_sampling": 1, **values}
    )
    draft = draft_plan(known, settings, measured=True)
    return completed_plan(draft, known, settings, NetworkPixels(1e6, 0.0, 1e6, 1), trials or {(1, 1): TRIAL}, cost)


def line(plan: Plan, item: str) -> Decision | None:
    return next((decision for decision in plan.decisions if decision.item == item), None)


def text_of(plan: Plan, item: str) -> str:
    planned = line(plan, item)
    assert planned is not None, [decision.item for decision in plan.decisions]
    return f"{planned.decision}: {planned.reason}"


def expected(plan: Plan) -> Prediction:
    assert plan.prediction is not None
    return plan.prediction


def test_unseen_gaussians_are_left_out() -> None:
    plan = plan_of(facts())
    assert plan.seen.tolist() == plan.optimized.tolist() == [False, True, True, True, True, True]
    assert text_of(plan, "unseen Gaussians").startswith("1 of 6 are neither rendered nor optimized; they follow")
    assert line(plan, "unseen Gaussians").bytes == OPTIMIZER_BYTES  # type: ignore[union-attr]
    assert "they keep their colors" in text_of(plan_of(facts(), unseen="freeze"), "unseen Gaussians")


def test_unused_spherical_harmonics_are_skipped() -> None:
    assert line(plan_of(facts()), "spherical harmonics") is None
    assert "evaluated up to degree 1" in text_of(plan_of(facts(used_degree=1)), "spherical harmonics")
    assert "the scene has degree 0" in text_of(plan_of(facts(sh_degree=0, used_degree=0)), "spherical harmonics")


def test_attenuation_is_recommended_where_much_color_depends_on_the_view() -> None:
    assert "25% of the color variance" in text_of(plan_of(facts(harmonics_energy=0.25)), "view-dependent color")
    assert line(plan_of(facts(harmonics_energy=0.01)), "view-dependent color") is None


@pytest.mark.parametrize(("uncovered", "weighted", "background"), [(0.0, False, "background"), (0.5, True, "palette")])
def test_scans_get_position_weights_and_another_background(uncovered: float, weighted: bool, background: str) -> None:
    plan = plan_of(facts(uncovered=uncovered), early_stop=True)
    assert (plan.weighted, plan.training_background) == (weighted, background)
    assert (line(plan, "position weights") is not None) == weighted
    assert ("none: all steps are run" in text_of(plan, "early stop")) == weighted


def test_blend_weights_are_cached_as_memory_and_visits_allow() -> None:
    for size, cached in ((GIGABYTE, "float32"), (4 * GIGABYTE, "half")):
        plan = plan_of(facts(weights=WeightCost(size, size // 2)))
        assert plan.cached_weights == cached
        assert line(plan, "blend weights").seconds == pytest.approx(TRIAL.render - 0.2)  # type: ignore[union-attr]
    rare = facts(weights=WeightCost(GIGABYTE, GIGABYTE // 2))
    assert plan_of(rare, steps_coarse=0, steps_sos=19).cached_weights == "none"
    assert "a view is visited 4.8 times" in text_of(plan_of(rare, steps_coarse=0, steps_sos=19), "blend weights")
    assert "requested" in text_of(plan_of(rare, cached_weights="none"), "blend weights")


@pytest.mark.parametrize(
    ("seconds", "chosen"),
    [({1: 2.0, 2: 1.2, 4: 1.0}, 4), ({1: 2.0, 2: 1.02, 4: 1.0}, 2), ({1: 1.0, 2: 1.1, 4: 3.0}, 1), ({4: 3.0}, 4)],
)
def test_smallest_number_of_ranks_near_the_fastest_is_used(seconds: dict[int, float], chosen: int) -> None:
    trials = {(ranks, 1): replace(TRIAL, sos=replace(TRIAL.sos, seconds=own)) for ranks, own in seconds.items()}
    plan = plan_of(facts(machine=Hardware("cpu", GIGABYTE, 4, 4)), trials, steps_coarse=0)
    assert plan.ranks == chosen
    assert expected(plan).seconds == seconds[chosen]
    assert expected(plan).seconds_one_rank == seconds.get(1)
    text = text_of(plan, "ranks")
    assert ("requested" in text) == (1 not in seconds)
    assert f"on {chosen}" in text


def test_each_rank_gets_a_view_of_its_own_if_that_saves_much_time() -> None:
    two = facts(machine=Hardware("cpu", GIGABYTE, 2, 2))

    def plan_with(together: float) -> Plan:
        seconds: dict[Shape, float] = {(1, 1): 2.0, (2, 1): 1.8, (2, 2): together}
        trials = {shape: replace(TRIAL, sos=replace(TRIAL.sos, seconds=own)) for shape, own in seconds.items()}
        return plan_of(two, trials, steps_coarse=0, steps_sos=190, measure=0)

    assert worth(2) == 1.9
    divided, grouped = plan_with(3.2), plan_with(3.0)
    assert (divided.ranks, divided.groups, grouped.ranks, grouped.groups) == (2, 1, 2, 2)
    assert "with 2 views, worth 1.9 steps" in text_of(divided, "ranks")
    assert text_of(grouped, "ranks").startswith(
        "all 2 take part, each with a view of its own in fewer steps, 1.27 times as fast as one"
    )
    settings = make_settings(steps_sos=190)
    assert with_groups(settings, 1) is settings
    assert with_groups(settings, 2).steps_sos == 100
    assert expected(grouped).seconds_one_rank == 4.0
    assert expected(divided).job - expected(grouped).job == pytest.approx(190 * 1.8 - 100 * 3.0, abs=1.0)


@pytest.mark.parametrize(
    ("values", "considered"),
    [
        ({}, True),
        ({"views_per_step": 1}, False),
        ({"steps_sos": 240}, False),
        ({"within": 60.0}, False),
        ({"rebalance": False}, False),
        ({"preset": "paper"}, False),
    ],
)
def test_given_views_and_steps_remain(values: dict[str, Any], considered: bool) -> None:
    settings = make_settings(**{"preset": "standard", **values})

    def considers(ranks: int, divided: float) -> bool:
        known = facts(machine=Hardware("cpu", GIGABYTE, ranks, ranks))
        seconds: dict[Shape, float] = {(1, 1): 2.0, (ranks, 1): divided}
        return considers_groups(draft_plan(known, settings, measured=True), known, settings, seconds)

    assert considers(2, 1.9) is considered
    assert not considers(2, 1.0)  # divided views are as fast
    assert not considers(4, 1.9)  # there are four views only


def test_job_without_steps_uses_one_rank() -> None:
    for machine in (Hardware("cpu", GIGABYTE, 4, 4), Hardware("cpu", GIGABYTE)):
        plan = plan_of(facts(machine=machine), {(1, 1): TRIAL, (machine.ranks, 1): TRIAL}, steps_coarse=0, steps_sos=0)
        assert plan.ranks == 1
        assert expected(plan).job == expected(plan).measuring


def test_graphs_are_used_if_they_save_time() -> None:
    gpu = facts(machine=Hardware("cuda", 10 * GIGABYTE))
    for cost, used in ((Saving(1.0, 0.5, 1.0), True), (Saving(1.0, 0.99), False), (None, False)):
        plan = plan_of(gpu, {(1, 1): replace(TRIAL, device=GIGABYTE)}, cost)
        assert plan.graphs is used
        assert text_of(plan, "launches").startswith("kernel by kernel") is not used
        assert expected(plan).seconds == TRIAL.sos.seconds - (0.5 if used else 0.0)
        assert expected(plan).device_bytes == GIGABYTE * (2 + used) + (expected(plan).device_bytes or 0) % GIGABYTE


def test_job_time_adds_steps_first_visits_style_and_measuring() -> None:
    """One of four views was visited by the trial."""
    prediction = expected(plan_of(facts()))
    assert (prediction.first_visit, prediction.first_visit_coarse, prediction.style) == (0.75, 1.5, 0.0)
    steps = 40 * 0.4 + 40 * 2.0 + 4 * (0.75 + 1.5)
    assert prediction.job == pytest.approx(steps + prediction.measuring)
    limited = expected(plan_of(facts(), within=5.0))
    assert limited.job - limited.measuring == pytest.approx(5.0)


def test_steps_that_leave_out_scales_count_as_their_mean() -> None:
    """Views have two scales."""
    sampled = plan_of(facts(), scale_sampling=4)
    assert expected(sampled).seconds == pytest.approx(0.4 + (2.0 - 0.4) / 4)
    assert expected(sampled).first_visit == expected(plan_of(facts(), scale_sampling=1)).first_visit
    assert "finer scales cost 75% less" in text_of(sampled, "scale sampling")
    one_scale = plan_of(facts(), scale_sampling=4, coarsest_side=600)
    assert expected(one_scale).seconds == 2.0
    assert line(one_scale, "scale sampling") is None


def test_planned_measuring_stays_within_the_allowed_time() -> None:
    for steps in (16, 200, 2000):
        plan = plan_of(facts(), steps_sos=steps)
        prediction = expected(plan)
        assert prediction.losses <= prediction.measuring
        assert prediction.measuring <= allowed_seconds(make_settings(), prediction.job - prediction.measuring)
        assert "in addition to" in text_of(plan, "measuring")
    assert "requested" in text_of(plan_of(facts(), measure=0.0), "measuring")


def test_target_loss_fixes_the_loss_views_regardless_of_timings() -> None:
    slow = {(1, 1): replace(TRIAL, sos=StepCost(100.0, 200.0, {"vgg_forward": 50.0}))}
    assert plan_of(facts(), slow, steps_sos=4).loss_views == 1
    assert plan_of(facts(), slow, steps_sos=4, target_loss=0.1).loss_views == 4


def test_peak_memory_includes_the_data_of_other_views() -> None:
    peak = expected(plan_of(facts(), unseen="freeze")).peak_bytes
    assert peak > TRIAL.process + TRIAL.growth
    more = replace(TRIAL, growth=2 * GIGABYTE)
    assert expected(plan_of(facts(), {(1, 1): more}, unseen="freeze")).peak_bytes == peak + GIGABYTE
