"""Tests of the predicted peak memory of a job, term by term."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from sgsst_core.budget import content_fraction, least_intersection_memory, measuring_memory, memory_for
from sgsst_core.planning.decide import decide
from sgsst_core.planning.facts import RasterCost
from sgsst_core.planning.measurement_choice import LEVELS
from sgsst_core.planning.memory import (
    BUILDING_BYTES,
    MEASURING_BYTES,
    SEARCH_BYTES,
    SHAPE_BYTES,
)
from sgsst_core.planning.view_costs import view_memory
from sgsst_core.settings import make_settings
from tests.sgsst_core.planning.test_decide import GIGABYTE, HEIGHT, VIEWS, WIDTH, plan_of, probe
from tests.sgsst_core.planning.test_view_costs import LARGE, expected
from tests.sgsst_core.planning.test_view_costs import plan_of as plan_of_raster

#: Budget in bytes for tile intersections and weights.
BUDGET = 10 * GIGABYTE // 4


def test_intersections_of_novel_views_get_the_remaining_budget() -> None:
    plain = expected(LARGE).peak_bytes
    for steps in (40, 400, 4000):
        for size in (10**8, 10**9):
            plan = plan_of_raster(replace(LARGE, intersection_bytes=size), measured=True, steps_sos=steps)
            views = LEVELS[plan.measuring].views
            isects = min((VIEWS + 4 * views) * size, BUDGET) - min(VIEWS * size, BUDGET)
            gaussians = 6 * (SHAPE_BYTES + 12 * 4 * views) if views else 0
            warps = min(views * HEIGHT * WIDTH * 80, 10 * GIGABYTE // 32)
            built = 5 * SHAPE_BYTES if VIEWS * size > BUDGET else 0
            assert plan.prediction is not None
            assert plan.prediction.peak_bytes - plain == MEASURING_BYTES + isects + gaussians + warps + built


def test_weights_replace_the_tile_intersections_of_the_survey() -> None:
    """Weights and intersections share one budget.

    Intersections of views whose weights do not fit may take another sixteenth of the memory.
    """
    rasters = [RasterCost(0.3, 0.1, size, size, intersection_bytes=10**8) for size in (10**9, BUDGET, 4 * BUDGET)]
    peaks = [plan_of(probe(raster=raster), cached_weights="float32").prediction for raster in rasters]
    base = plan_of(
        probe(raster=replace(rasters[0], bytes=0, intersection_bytes=0)), cached_weights="float32"
    ).prediction
    assert base is not None
    rises = [prediction.peak_bytes - base.peak_bytes for prediction in peaks if prediction is not None]
    isects = VIEWS * 10**8
    assert rises == [10**9 - isects, BUDGET - isects, BUDGET + 300_000_000 - isects]


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
@pytest.mark.parametrize("weights", ["none", "half"])
@pytest.mark.parametrize("measured", [False, True])
def test_budgets_add_up_to_the_memory_limit(device: str, precision: str, weights: str, measured: bool) -> None:
    raster = RasterCost(0.3, 0.1, GIGABYTE, GIGABYTE // 2)
    measurements = probe(
        device=device, raster=raster, precision_ratio=2.0, rasterizer="cpu" if device == "cpu" else "triton"
    )
    settings = make_settings(precision=precision, cached_weights=weights, steps_sos=4000)
    plan, memory = decide(measurements, settings, measured=measured), 10 * GIGABYTE
    approximated = precision == "bfloat16" or weights == "half"
    beside = (least_intersection_memory(memory) if weights == "half" else 0) + measured * (
        (1 + approximated) * measuring_memory(memory)
    )
    activations = memory_for("activations", memory) - plan.spare
    assert activations + memory_for("rasterizer", memory) + view_memory(plan, memory) + beside == memory
    assert view_memory(plan, memory) > 0
    # The steps, and on a GPU also the float32 reference, fit in what remains for activations.
    assert (plan.spare == 0) is (device == "cpu")
    assert activations > HEIGHT * WIDTH * 3000 * (2 if precision == "bfloat16" and measured else 1)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("has_maps", [False, True])
def test_fractions_of_the_memory_for_views_add_up_to_one(device: str, weighted: bool, has_maps: bool) -> None:
    colors, maps = 0.25, 0.25 * has_maps
    coverage = 0.25 if device == "cpu" or weighted else 0.0
    assert content_fraction(device, weighted=weighted, has_maps=has_maps) + colors + coverage + maps == 1


@pytest.mark.parametrize(
    ("device", "weights", "fraction"), [("cuda", "off", 0.75), ("cuda", "on", 0.5), ("cpu", "off", 0.5)]
)
def test_content_on_a_gpu_uses_the_memory_of_unneeded_coverage(device: str, weights: str, fraction: float) -> None:
    rasterizer = "cpu" if device == "cpu" else "triton"
    taken = []
    for cell in (0, GIGABYTE):
        measurements = probe(device=device, rasterizer=rasterizer, content_bytes=cell)
        plan = plan_of(measurements, position_weights=weights, steps_sos=4000)
        assert plan.prediction is not None
        taken.append(plan.prediction.peak_bytes if device == "cpu" else plan.prediction.device_bytes)
    assert taken[1] - taken[0] == int(fraction * view_memory(plan, 10 * GIGABYTE))  # type: ignore[operator]


def test_gpu_memory_includes_rasterizer_and_measurements() -> None:
    def peak(measured: bool = False, **raster: Any) -> int:
        measurements = probe(device="cuda", rasterizer="triton", raster=RasterCost(0.01, **raster))
        prediction = decide(measurements, make_settings(steps_sos=4000), measured=measured).prediction
        assert prediction is not None
        assert prediction.device_bytes is not None
        return prediction.device_bytes

    plain = peak()
    # The survey's tile intersections of all views are already in `device_bytes` of the probe.
    assert peak(intersection_bytes=10**8) == plain
    pairs = 10**9  # more than the activations take
    assert peak(max_pairs=2 * pairs) - peak(max_pairs=pairs) == 36 * pairs
    views = 4
    assert peak(measured=True) - plain == 6 * (SHAPE_BYTES + 12 * 4 * views) + views * HEIGHT * WIDTH * 80


def test_largest_temporary_allocation_counts() -> None:
    """With many Gaussians, the peak is the computation of a view's intersections, or the final neighbor search."""
    few = expected(LARGE)
    many = plan_of(probe(gaussians=10**8, used_degree=0, held_degree=0)).prediction
    assert many is not None
    assert many.peak_bytes - few.peak_bytes > 10**8 * min(BUILDING_BYTES, SEARCH_BYTES) - 10 * GIGABYTE


def test_float32_reference_needs_memory_of_its_own() -> None:
    """If the job is not in float32, its activations and view contents are needed a second time."""
    measurements = probe(precision_ratio=2.0)
    rises = []
    for precision in ("float32", "bfloat16"):
        plain, measured = (
            decide(measurements, make_settings(precision=precision, steps_coarse=0, steps_sos=4000), measured=flag)
            for flag in (False, True)
        )
        assert plain.prediction is not None
        assert measured.prediction is not None
        rises.append(measured.prediction.peak_bytes - plain.prediction.peak_bytes)
    pixels = HEIGHT * WIDTH * (1 + 1 / 4 + 1 / 16)
    assert rises[1] - rises[0] > HEIGHT * WIDTH * 3000 + 4 * 2 * 2000 * pixels / 64
