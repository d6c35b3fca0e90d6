"""Tests of each decision of the planner on synthetic probes, without rendering or timing anything."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import FrozenInstanceError, replace
from typing import Any

import pytest
import torch

from sgsst_core.decision import Decision
from sgsst_core.features.partition import Rectangle
from sgsst_core.loss.gradient_error import Difference
from sgsst_core.planning.decide import decide
from sgsst_core.planning.facts import LaunchCost, Link, Machine, NetworkFacts, Probe, RasterCost, Rate, SceneFacts
from sgsst_core.planning.memory import (
    CUDNN_BYTES,
    MEASURING_BYTES,
    NCCL_BYTES,
    OPTIMIZER_BYTES,
    SHAPE_BYTES,
    gaussian_bytes,
)
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import rasterizer_for
from sgsst_core.settings import make_settings

VIEWS = 4
HEIGHT, WIDTH = 600, 800
WHOLE = Rectangle(0, 0, HEIGHT, WIDTH)
GIGABYTE = 10**9


def probe(**changes: Any) -> Probe:
    """Return a probe of a CPU with 10 GB, and of four views that six Gaussians fill; `changes` replace fields."""
    weights = torch.tensor([0.0, 0.5, 1.0, 2.0, 4.0, 8.0], dtype=torch.float64)
    parts: dict[str, Any] = {
        "scene": SceneFacts(6, 3, 3, 3),
        "survey": Survey(weights, list(range(VIEWS)), [WHOLE] * VIEWS, 0.0),
        "network": NetworkFacts(64, 3000.0, 500.0, 2048, Rate(0.5e-6, 1e-6, 3e-6), Rate(0.0, 0.0, 0.01)),
        "machine": Machine("cpu", 10 * GIGABYTE),
    }
    for name, part in parts.items():
        own = {field.name for field in dataclasses.fields(part)} & changes.keys()
        parts[name] = replace(part, **{key: changes.pop(key) for key in own})
    return Probe(
        **{
            **parts,
            "sizes": ((HEIGHT, WIDTH),) * VIEWS,
            "rasterizer": "cpu",
            "raster": RasterCost(0.3, 0.1, GIGABYTE, GIGABYTE // 2),
            "link": Link(math.inf, 0.0),
            "process_bytes": GIGABYTE,
            **changes,
        }
    )


def plan_of(measurements: Probe, **values: Any) -> Plan:
    return decide(measurements, make_settings(**{"steps_coarse": 40, "steps_sos": 40, **values}))


def line(plan: Plan, item: str) -> Decision | None:
    return next((decision for decision in plan.decisions if decision.item == item), None)


def text_of(plan: Plan, item: str) -> str:
    planned = line(plan, item)
    assert planned is not None, [decision.item for decision in plan.decisions]
    return f"{planned.decision}: {planned.reason}"


# --- the scene -----------------------------------------------------------------------------------------------------


def test_unseen_gaussians_are_left_out() -> None:
    plan = plan_of(probe())
    assert plan.seen.tolist() == plan.optimized.tolist() == [False, True, True, True, True, True]
    assert text_of(plan, "unseen Gaussians").startswith(
        "1 of 6 are neither rendered nor optimized; they follow their neigh"
    )
    assert line(plan, "unseen Gaussians").bytes == OPTIMIZER_BYTES  # type: ignore[union-attr]
    assert "they keep their colors" in text_of(plan_of(probe(), unseen="freeze"), "unseen Gaussians")


@pytest.mark.parametrize(
    ("degree", "used", "expected"),
    [
        (3, 3, None),
        (3, 1, "evaluated up to degree 1: all coefficients of degrees 2 to 3 are 0"),
        (0, 0, "no view directions are computed: the scene has degree 0"),
    ],
)
def test_unused_spherical_harmonics_are_skipped(degree: int, used: int, expected: str | None) -> None:
    plan = plan_of(probe(sh_degree=degree, used_degree=used))
    assert (text_of(plan, "spherical harmonics") if expected else line(plan, "spherical harmonics")) == expected


def test_attenuation_is_recommended_where_much_color_depends_on_the_view() -> None:
    strong, item = probe(harmonics_energy=0.25), "view-dependent color"
    assert text_of(plan_of(strong), item) == (
        "unchanged, so highlights keep their tint; --sh-attenuation 1 removes it: "
        "25% of the color variance depends on the view direction"
    )
    assert line(plan_of(probe(harmonics_energy=0.01)), item) is None
    assert line(plan_of(strong, sh_attenuation=0.5), item) is None
    both = probe(harmonics_energy=0.25, used_degree=1)
    assert line(plan_of(both), item) is not None
    assert line(plan_of(both), "spherical harmonics") is not None


# --- views ---------------------------------------------------------------------------------------------------------


def test_blind_views_are_skipped() -> None:
    plan = plan_of(probe(covered=[0, 1, 3]))
    assert plan.covered == (0, 1, 3)
    assert text_of(plan, "views") == "1 of 4 are skipped: they see no Gaussian"
    assert line(plan_of(probe()), "views") is None


@pytest.mark.parametrize(
    ("uncovered", "wanted", "weighted"),
    [(0.3, "auto", True), (0.001, "auto", False), (0.3, "off", False), (0.0, "on", True)],
)
def test_position_weights_are_for_views_with_an_empty_background(uncovered: float, wanted: str, weighted: bool) -> None:
    plan = plan_of(probe(uncovered_fraction=uncovered), position_weights=wanted)
    assert plan.weighted is weighted
    assert (line(plan, "position weights") is not None) is weighted


@pytest.mark.parametrize(
    ("uncovered", "values", "training_background", "warm"),
    [
        (0.0, {}, "background", True),
        (0.05, {}, "background", True),  # room with holes
        (0.05, {"preserve_colors": "luminance"}, "background", False),
        (0.5, {"preserve_colors": "luminance"}, "palette", True),
        (0.5, {}, "palette", True),
        (0.5, {"position_weights": "off"}, "background", True),
        (0.5, {"preset": "paper"}, "background", False),
        (0.5, {"training_background": "background", "warm_start": False}, "background", False),
        (0.5, {"training_background": "random"}, "random", True),
        (0.0, {"training_background": "random", "warm_start": True}, "random", True),
    ],
)
def test_training_background_and_start_follow_coverage_and_settings(
    uncovered: float, values: dict[str, Any], training_background: str, warm: bool
) -> None:
    plan = plan_of(probe(uncovered_fraction=uncovered), **values)
    assert (plan.training_background, plan.warm_start) == (training_background, warm)
    behind, start = line(plan, "training background"), line(plan, "start")
    assert (behind is not None, start is not None) == (training_background != "background", warm)
    for value, setting in ((behind, "training_background"), (start, "warm_start")):
        if value:
            assert ("requested" in value.reason) is (setting in values)
            scan = uncovered == 0.5 and "position_weights" not in values
            assert ("50.0% of the views' pixels are uncovered" in value.reason) is (setting not in values and scan)


# --- the network ---------------------------------------------------------------------------------------------------


def test_memory_is_shared_by_the_ranks_of_a_machine() -> None:
    assert text_of(plan_of(probe(sharing=5)), "partition") == text_of(
        plan_of(probe(memory_limit=2 * GIGABYTE)), "partition"
    )
    assert plan_of(probe(sharing=5)).memory_limit == 10 * GIGABYTE


def test_content_is_left_out_without_weight() -> None:
    assert text_of(plan_of(probe(content_bytes=0), content_weight=0), "content").endswith("its weight is 0")
    assert line(plan_of(probe()), "content") is None


@pytest.mark.parametrize(
    ("asked", "ratio", "precision", "text"),
    [
        ("float32", None, "float32", None),
        ("float32", 1.4, "float32", None),
        (
            "float32",
            1.9,
            "float32",
            "features in float32: exact; with --precision bfloat16 (approximate), convolutions are 1.9 times faster "
            "here",
        ),
        ("bfloat16", 1.7, "bfloat16", "features in bfloat16: requested, 1.7 times faster here"),
        (
            "bfloat16",
            0.04,
            "float32",
            "features in float32: bfloat16 was requested, but takes 25.0 times as long as float32 on this processor",
        ),
        ("tf32", 3.0, "tf32", "convolutions in TF32: requested, 3.0 times faster here"),
        (
            "tf32",
            None,
            "float32",
            "features in float32: tf32 was requested, but needs an NVIDIA GPU of compute capability 8.0 or higher",
        ),
        (
            "bfloat16",
            None,
            "float32",
            "features in float32: bfloat16 was requested, but needs a CPU, an AMD GPU, or an NVIDIA GPU of compute "
            "capability 8.0 or higher",
        ),
    ],
)
def test_lower_precision_is_used_if_requested_and_faster(
    asked: str, ratio: float | None, precision: str, text: str | None
) -> None:
    plan = plan_of(probe(precision_ratio=ratio), precision=asked)
    assert plan.precision == precision
    assert (text_of(plan, "precision") if text else line(plan, "precision")) == text


def test_ranks_that_share_a_gpu_are_reported() -> None:
    values: dict[str, Any] = {"device": "cuda", "ranks": 2, "link": Link(1e9, 1e-6)}
    assert line(plan_of(probe(**values)), "communication") is None
    assert line(plan_of(probe(**{**values, "device": "cpu", "sharing": 2})), "communication") is None
    assert text_of(plan_of(probe(sharing=2, **values)), "communication") == (
        "ranks exchange data over the CPU (gloo): 2 of them share a GPU, which NCCL does not support; give each a GPU "
        "of its own"
    )


#: A graph saves 4 of 10 ms and takes 40 ms to capture, so it pays off from the twelfth visit on.
CAPTURED = LaunchCost(seconds=0.010, replayed=0.006, capture=0.040)


@pytest.mark.parametrize(
    ("changes", "values", "reason"),
    [
        ({}, {"steps_sos": 12}, None),
        (
            {},
            {"steps_sos": 11},
            "visited about 11 times, but one graph per phase pays off from 12.0 visits; measured per view: 6 ms",
        ),
        ({}, {"steps_sos": 12, "steps_coarse": 12}, None),  # each phase has its own graph
        (
            {},
            {"steps_sos": 12, "steps_coarse": 11},
            "visited about 23 times, but one graph per phase pays off from 12.0",
        ),
        (
            {},
            {"steps_sos": 12, "position_weights": "on"},
            "visited about 3 times",
        ),  # views are cropped to different sizes
        ({}, {"steps_sos": 12 * VIEWS, "position_weights": "on"}, None),
        ({"ranks": 2}, {"steps_sos": 400}, "a graph cannot contain communication between workers"),
        ({"ranks": 2}, {"steps_sos": 6, "views_per_step": 2}, None),  # every worker has a view of its own
        ({"launches": None}, {"steps_sos": 400}, "views of one size are visited about 400 times"),
        ({"launches": LaunchCost(problem="no")}, {"steps_sos": 400}, "CUDA graphs are unavailable: no"),
        (
            {"launches": LaunchCost(1.0, 0.98, 0.0)},
            {"steps_sos": 400},
            "a graph saves hardly any time: measured per view: 980 ms",
        ),
    ],
)
def test_loss_is_captured_as_a_graph_if_that_saves_time(
    changes: dict[str, Any], values: dict[str, Any], reason: str | None
) -> None:
    measurements = probe(**{"device": "cuda", "raster": RasterCost(0.01), "launches": CAPTURED, **changes})
    plan = plan_of(measurements, **{"steps_coarse": 0, "position_weights": "off", **values})
    decision = line(plan, "launches")
    assert decision is not None
    assert plan.graphs is (reason is None)
    if reason is None:
        assert decision.decision == "the loss of a view is captured as a CUDA graph"
        assert decision.reason.startswith("measured per view: 6 ms as a graph, 10 ms kernel by kernel, 40 ms to")
        assert decision.seconds == pytest.approx(0.004)
    else:
        assert decision.decision == "kernel by kernel"
        assert reason in decision.reason
        assert decision.seconds is None


def test_no_graph_is_captured_or_mentioned_on_a_cpu() -> None:
    plan = plan_of(probe(launches=CAPTURED), steps_sos=400)
    assert not plan.graphs
    assert line(plan, "launches") is None


def test_precision_line_states_the_measured_error() -> None:
    measured = probe(precision_ratio=2.0, gradient_error=Difference(0.1234, 0.98765))
    error = line(plan_of(measured, precision="bfloat16"), "precision").error  # type: ignore[union-attr]
    assert error.startswith("the first view's pixel gradient has a relative error of 0.12 (cosine 0.98765)")
    slower = probe(precision_ratio=0.5)
    assert line(plan_of(slower, precision="bfloat16"), "precision").error == "none"  # type: ignore[union-attr]


# --- the rasterizer ------------------------------------------------------------------------------------------------


def test_weights_are_cached_on_a_cpu_if_that_pays_off() -> None:
    cached, once = plan_of(probe()), plan_of(probe(), steps_coarse=0, steps_sos=4 * VIEWS)
    assert (cached.rasterizer, cached.cached_weights) == ("cached", "float32")
    assert text_of(cached, "blend weights") == (
        "all cached in float32: they take 1.00 GB for all views; 2.5 GB are available for blend weights"
    )
    assert (once.rasterizer, once.cached_weights) == ("cpu", "none")
    assert text_of(once, "blend weights") == "recomputed in every step: a view is visited 4.0 times"
    assert line(cached, "rasterizer") is line(once, "rasterizer") is None
    assert cached.prediction is not None
    assert plan_of(probe(), cached_weights="none").prediction.seconds == pytest.approx(  # type: ignore[union-attr]
        cached.prediction.seconds + 0.2
    )


@pytest.mark.parametrize(
    ("values", "form"),
    [
        ({}, "half"),
        ({"preset": "paper"}, "float32"),
        ({"cached_weights": "float32"}, "float32"),
        ({"cached_weights": "half"}, "half"),
        ({"cached_weights": "none"}, "none"),
    ],
)
def test_weights_that_do_not_fit_are_cached_in_half_precision(values: dict[str, Any], form: str) -> None:
    plan = plan_of(probe(raster=RasterCost(0.3, None, 6 * GIGABYTE, 3 * GIGABYTE)), **values)
    assert plan.cached_weights == form
    assert plan.rasterizer == ("cpu" if form == "none" else "cached")
    assert ("% of the views' cached" in text_of(plan, "blend weights")) is (form != "none")


def test_half_precision_is_used_if_only_that_fits() -> None:
    plan = plan_of(probe(raster=RasterCost(0.3, None, 3 * GIGABYTE, 2 * GIGABYTE)))
    assert plan.cached_weights == "half"
    assert text_of(plan, "blend weights").startswith("all cached in half precision: they take 2.00 GB")
    assert "1/2048" in line(plan, "blend weights").error  # type: ignore[union-attr]


def test_first_working_rasterizer_is_chosen_on_a_gpu() -> None:
    assert rasterizer_for("cuda", {}) == "triton"
    assert rasterizer_for("cuda", {"triton": "no driver"}) == "cuda"
    assert rasterizer_for("cuda", {"triton": "no driver", "cuda": "no kernels"}) == "cpu"
    assert rasterizer_for("cpu", {}) == "cpu"


def on_a_gpu(raster: RasterCost, **changes: Any) -> Probe:
    return probe(device="cuda", rasterizer="triton", raster=raster, **changes)


#: Cached weights save 6 of 10 ms and take 12 ms to compute, so they pay off after two visits.
FASTER = RasterCost(0.01, 0.004, GIGABYTE, GIGABYTE // 2, 0.012)


def test_weights_are_cached_on_a_gpu_if_measured_to_pay_off() -> None:
    cached, once = plan_of(on_a_gpu(FASTER)), plan_of(on_a_gpu(FASTER), steps_coarse=0, steps_sos=VIEWS)
    assert (cached.rasterizer, cached.uncached, cached.cached_weights) == ("cached", "triton", "float32")
    assert text_of(cached, "rasterizer") == "Triton on the GPU, with cached blend weights: Triton works here"
    assert text_of(cached, "blend weights") == (
        "all cached in float32: they take 1.00 GB for all views; 2.5 GB are available for blend weights; measured per "
        "view: 4 ms cached, 10 ms recomputed"
    )
    assert line(cached, "blend weights").seconds == pytest.approx(0.006)  # type: ignore[union-attr]
    assert cached.prediction is not None
    assert once.prediction is not None
    assert once.prediction.seconds == pytest.approx(cached.prediction.seconds + 0.006)
    assert (once.rasterizer, once.uncached, once.cached_weights) == ("triton", "triton", "none")
    assert text_of(once, "rasterizer") == "Triton on the GPU: Triton works here"
    assert text_of(once, "blend weights") == (
        "recomputed in every step: a view is visited 1.0 times, but caching pays off from 2.0 visits; measured per "
        "view: 4 ms cached, 10 ms recomputed"
    )


@pytest.mark.parametrize(
    ("raster", "reason"),
    [
        (
            replace(FASTER, cached_seconds=0.011),
            "cached weights are not faster here: measured per view: 11 ms cached, 10 ms recomputed",
        ),
        (RasterCost(0.01, None, 40 * GIGABYTE, 20 * GIGABYTE), "the weights of one view do not fit"),
    ],
)
def test_weights_are_not_cached_on_a_gpu_if_that_does_not_pay_off(raster: RasterCost, reason: str) -> None:
    plan, asked_for = plan_of(on_a_gpu(raster)), plan_of(on_a_gpu(raster), cached_weights="half")
    assert (plan.rasterizer, plan.cached_weights) == ("triton", "none")
    assert text_of(plan, "blend weights") == f"recomputed in every step: {reason}"
    assert (asked_for.rasterizer, asked_for.uncached, asked_for.cached_weights) == ("cached", "triton", "half")


def test_half_precision_is_used_on_a_gpu_if_only_that_fits() -> None:
    plan = plan_of(on_a_gpu(replace(FASTER, bytes=4 * GIGABYTE, half_bytes=2 * GIGABYTE)))
    assert plan.cached_weights == "half"
    assert "1/2048" in line(plan, "blend weights").error  # type: ignore[union-attr]
    most = plan_of(on_a_gpu(replace(FASTER, bytes=10 * GIGABYTE, half_bytes=5 * GIGABYTE)))
    assert text_of(most, "blend weights").startswith("50% of the views' cached in half precision")


def test_gsplat_caches_no_weights() -> None:
    second = probe(device="cuda", rasterizer="cuda", raster=RasterCost(0.01), problems={"triton": "no driver"})
    for plan in (plan_of(second), plan_of(second, cached_weights="float32")):
        assert (plan.rasterizer, plan.uncached, plan.cached_weights) == ("cuda", "cuda", "none")
        expected = "gsplat on the GPU: Triton cannot be used: no driver; gsplat works here"
        assert text_of(plan, "rasterizer") == expected
        assert text_of(plan, "blend weights") == "recomputed in every step: gsplat cannot cache them"


def test_weights_are_cached_on_the_cpu_if_no_gpu_rasterizer_works() -> None:
    broken = probe(device="cuda", problems={"triton": "no driver", "cuda": "no kernels"})
    plan, once = plan_of(broken), plan_of(broken, cached_weights="none")
    why = "Triton cannot be used: no driver; gsplat cannot be used: no kernels"
    assert (plan.rasterizer, plan.uncached, plan.cached_weights) == ("cached", "cpu", "float32")
    assert text_of(plan, "rasterizer") == f"on the CPU, with cached blend weights: {why}"
    assert (once.rasterizer, once.cached_weights) == ("cpu", "none")
    assert text_of(once, "rasterizer") == f"on the CPU: {why}"


def test_reason_for_uncached_weights_may_be_the_request() -> None:
    for values in ({"cached_weights": "none"},):
        assert text_of(plan_of(probe(), **values), "blend weights").endswith("in every step: requested")
        assert text_of(plan_of(on_a_gpu(FASTER), **values), "blend weights").endswith("in every step: requested")


# --- the schedule --------------------------------------------------------------------------------------------------


def test_phase_1_is_skipped_if_views_have_one_scale() -> None:
    assert plan_of(probe()).steps_coarse == 40
    assert text_of(plan_of(probe()), "scales") == "2: the shorter side is halved until it is at most 511 pixels"
    small = probe(sizes=((300, 400),) * VIEWS, regions=[Rectangle(0, 0, 300, 400)] * VIEWS)
    assert plan_of(small).steps_coarse == 0
    assert text_of(plan_of(small), "phase 1").startswith("its 40 steps are skipped")
    assert plan_of(small, preset="paper").steps_coarse == 40
    mixed = probe(sizes=((300, 400), *((HEIGHT, WIDTH),) * 3))
    assert text_of(plan_of(mixed), "scales").startswith("1 to 2")


def test_plan_mentions_early_stop_only_if_it_is_on() -> None:
    assert "than 0.5% below" in text_of(plan_of(probe()), "early stop")
    assert line(plan_of(probe(), early_stop=False), "early stop") is None


# --- ranks ---------------------------------------------------------------------------------------------------------


# --- the plan ------------------------------------------------------------------------------------------------------


def test_measuring_takes_memory_but_changes_no_decision() -> None:
    plain, measured = (decide(probe(), make_settings(), measured=flag) for flag in (False, True))
    assert plain.decisions == measured.decisions[:-1]
    assert plain.prediction is not None
    assert measured.prediction is not None
    assert measured.prediction.measuring > 2 * measured.prediction.evaluation > 0 == plain.prediction.measuring
    assert measured.prediction == replace(
        plain.prediction,
        peak_bytes=measured.prediction.peak_bytes,
        evaluation=measured.prediction.evaluation,
        losses=measured.prediction.losses,
        ending=measured.prediction.ending,
        measuring=measured.prediction.measuring,
        job=plain.prediction.job + measured.prediction.measuring,
    )
    assert measured.prediction.peak_bytes > plain.prediction.peak_bytes + MEASURING_BYTES
    assert (plain.measured, measured.measured) == (False, True)


def test_computed_data_count_as_gpu_memory() -> None:
    """The totals of process and GPU equal those of a process without a GPU, plus what only the GPU needs."""
    own = 2 * GIGABYTE
    for ranks in (1, 2):
        values: dict[str, Any] = {"ranks": ranks, "raster": RasterCost(0.01), "link": Link(1e12, 1e-6)}
        on_cpu, on_gpu = (
            plan_of(probe(device=device, device_bytes=held, **values)).prediction
            for device, held in (("cpu", 0), ("cuda", own))
        )
        assert on_cpu is not None
        assert on_gpu is not None
        assert on_cpu.device_bytes is None
        assert on_gpu.peak_bytes == GIGABYTE
        beside = 5 * gaussian_bytes(3) - 6 * SHAPE_BYTES - CUDNN_BYTES
        if ranks == 1:  # activations, less three quarters of what needs 500 bytes per pixel
            beside -= HEIGHT * WIDTH * 375
        else:
            beside -= NCCL_BYTES
        assert on_gpu.device_bytes == own + on_cpu.peak_bytes - GIGABYTE - beside


def test_same_probe_gives_the_same_plan() -> None:
    one, other = (plan_of(probe(uncovered_fraction=0.2, ranks=3, link=Link(1e9, 1e-4))) for _ in range(2))
    for field in dataclasses.fields(Plan):
        values = [getattr(plan, field.name) for plan in (one, other)]
        if field.name == "survey":
            assert torch.equal(*(survey.total_blend_weights for survey in values))
        elif isinstance(values[0], torch.Tensor):
            assert torch.equal(*values)
        else:
            assert values[0] == values[1], field.name


def test_plans_are_immutable() -> None:
    plan = plan_of(probe())
    for field in dataclasses.fields(Plan):
        with pytest.raises(FrozenInstanceError):
            setattr(plan, field.name, None)
    assert isinstance(plan.decisions, tuple)
    assert isinstance(plan.covered, tuple)
    hash((plan.decisions, plan.covered, plan.prediction))  # hashable, so nothing in them can change


def test_decisions_have_a_fixed_order() -> None:
    measurements = probe(
        covered=[0, 1, 2],
        used_degree=0,
        uncovered_fraction=0.5,
        regions=[Rectangle(160, 160, 320, 320)] * VIEWS,
        ranks=2,
        link=Link(1e9, 1e-4),
        precision_ratio=2.0,
        content_bytes=0,
        device="cuda",
    )
    plan = plan_of(measurements, content_weight=0, coarsest_side=4000, precision="bfloat16")
    assert [decision.item for decision in plan.decisions] == [
        "unseen Gaussians",
        "spherical harmonics",
        "views",
        "uncovered pixels",
        "position weights",
        "training background",
        "start",
        "network layers",
        "content",
        "partition",
        "second forward",
        "rasterizer",
        "launches",
        "blend weights",
        "scales",
        "phase 1",
        "early stop",
        "ranks",
        "precision",
    ]
