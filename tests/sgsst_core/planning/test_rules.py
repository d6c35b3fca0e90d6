"""Tests of a plan's rules, by facts about scenes and machines that need not exist."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from sgsst_core.parallel.division import Size
from sgsst_core.planning.facts import Machine
from sgsst_core.planning.plan import Plan, make_plan, with_groups
from sgsst_core.settings import make_settings
from tests.sgsst_core.planning.sample_facts import CPU, GPU, facts

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
    ("machine", "known", "values", "reason"),
    [
        (GPU, {}, {}, None),
        (replace(GPU, graphs=False), {}, {}, "PyTorch 2.13 or later"),
        (replace(GPU, ranks=2), {"size": (3361, 5187)}, {}, "communication between workers"),
        (GPU, {}, {"steps_sos": 19}, "visited only 19 times"),
        (GPU, {"uncovered": 0.5}, {"steps_sos": 76}, "visited only 19 times"),  # each view has its own region
        (GPU, {"size": (2160, 3840)}, {}, "so large that the GPU does not wait"),
    ],
)
def test_graphs_are_used_for_small_views_that_are_visited_often(
    machine: Machine, known: dict[str, Any], values: dict[str, Any], reason: str | None
) -> None:
    plan = make_plan(facts(machine, **known), make_settings(**{**LONG, **values}))
    line, why = decision(plan, "launches")
    assert plan.graphs == (reason is None) == ("CUDA graph" in line)
    assert (reason or "visited 400 times") in why


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
    assert bound(views=9, size=(9000, 9000), intersection_bytes=10**12) < 1.1 * machine.memory_limit + 10**9
