"""Tests of the predicted cost of visiting views: cached data cost time once, other data at every visit."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from sgsst_core.planning.cost import CostModel
from sgsst_core.planning.decide import decide
from sgsst_core.planning.facts import RasterCost
from sgsst_core.planning.plan import Plan, Prediction
from sgsst_core.planning.view_costs import RankPart, ViewData
from sgsst_core.settings import make_settings
from tests.sgsst_core.planning.test_decide import GIGABYTE, probe

#: Intersections take 5 s and fit the cache; colors take 0.5 s.
LARGE = RasterCost(2.0, first_seconds=5.0, intersection_bytes=10**8, colors_seconds=0.5)
#: Sizes with which a quarter of 10 GB has space for the intersections of one of four views.
HUGE = replace(LARGE, intersection_bytes=10 * GIGABYTE // 4)


def plan_of(raster: RasterCost, *, measured: bool = False, **values: Any) -> Plan:
    settings = make_settings(**{"steps_coarse": 0, "steps_sos": 40, "position_weights": "off", **values})
    return decide(probe(raster=raster), settings, measured=measured)


def expected(*arguments: Any, **values: Any) -> Prediction:
    prediction = plan_of(*arguments, **values).prediction
    assert prediction is not None
    return prediction


def test_data_that_fit_cost_time_once_and_others_at_every_visit() -> None:
    data = ViewData(6.0, 400, 100)
    assert (data.cached, data.once, data.always, data.cached_bytes()) == (0.25, 1.5, 4.5, 100)
    assert ViewData(6.0, 400, 500) == replace(data, budget=500)
    fits = ViewData(6.0, 400, 500)
    assert (fits.once, fits.always, fits.cached_bytes()) == (6.0, 0.0, 400)
    assert (ViewData(6.0).once, ViewData(6.0, 400, 0).always) == (6.0, 6.0)


def test_views_that_are_cached_completely_leave_some_budget_unused() -> None:
    data = ViewData(6.0, 400, 250, views=4)
    assert (data.cached, data.once, data.always, data.cached_bytes()) == (0.5, 3.0, 3.0, 200)
    alone = ViewData(6.0, 400, 250, views=1)
    assert (alone.cached, alone.always, alone.cached_bytes()) == (0.0, 6.0, 0)
    half = RankPart(2, 0.5).data(alone, 0.5)
    assert (half.cached, half.once, half.cached_bytes()) == (1.0, 3.0, 200)


def test_blend_weights_take_no_memory_if_no_view_fits() -> None:
    """Tile intersections are cached in the memory that is not used for weights, and used to render each view."""
    plans = {size: plan_of(replace(LARGE, bytes=8 * size, half_bytes=4 * size)) for size in (GIGABYTE, 3 * GIGABYTE)}
    predictions = [plan.prediction for plan in plans.values()]
    assert all(plan.cached_weights == "half" for plan in plans.values())
    assert predictions[0] is not None
    assert predictions[1] is not None
    assert predictions[0].peak_bytes - predictions[1].peak_bytes == pytest.approx(2 * GIGABYTE, rel=0.2)
    assert predictions[1].first_visit < predictions[0].first_visit, "nothing is computed to be cached"
    lines = [next(each for each in plan.decisions if each.item == "blend weights").decision for plan in plans.values()]
    assert lines[0].startswith("50% of the views'")
    assert lines[1].startswith("0% of the views'")


def test_cached_tile_intersections_and_colors_add_to_the_first_visit() -> None:
    """Reducing the survey's intersections to the rendered Gaussians takes a quarter of their cost."""
    small, large = expected(replace(LARGE, first_seconds=0.0, colors_seconds=0.0)), expected(LARGE)
    assert large.first_visit - small.first_visit == pytest.approx(0.25 * 5 + 0.5)
    assert large.seconds == small.seconds


def test_tile_intersections_that_do_not_fit_add_to_every_visit() -> None:
    large, huge = expected(LARGE), expected(HUGE)
    assert huge.seconds - large.seconds == pytest.approx(5.0 * 3 / 4)
    assert large.first_visit - huge.first_visit == pytest.approx(0.25 * 5.0 * 3 / 4)
    assert huge.job > large.job


def on_two_ranks(raster: RasterCost, *, sharing: int = 1) -> tuple[Prediction, RankPart]:
    """Return the prediction for two ranks that divide every view, and the larger part."""
    settings = make_settings(steps_coarse=0, steps_sos=40, position_weights="off", rebalance=False)
    measurements = probe(raster=raster, ranks=2, sharing=sharing)
    plan = decide(measurements, settings)
    assert plan.prediction is not None
    assert plan.ranks == 2
    return plan.prediction, CostModel(plan, measurements, settings).on_several_ranks()[3]


def test_ranks_prepare_and_render_parts_of_views() -> None:
    """The survey's tile intersections are of whole views, so ranks compute those of their parts again."""
    free = replace(LARGE, seconds=0.0, first_seconds=0.0, colors_seconds=0.0)
    without, part = on_two_ranks(free)
    assert part.ranks == 2
    assert 0.5 < part.window < 0.75
    large, _ = on_two_ranks(replace(LARGE, fixed=0.4, first_fixed=1.0))
    render = 0.5 * 2.0 * part.window  # of the content image
    assert large.first_visit - without.first_visit == pytest.approx(1.0 + 4.0 * part.window + 0.5 + render)
    assert large.seconds - without.seconds == pytest.approx(0.4 + 1.6 * part.window, rel=0.02)


def test_parts_of_views_fit_where_whole_views_do_not() -> None:
    size = int(1.3 * 10 * GIGABYTE // 16)  # of the tile intersections of each of four views
    (small, part), (tight, _) = (on_two_ranks(replace(LARGE, intersection_bytes=each)) for each in (10**8, size))
    assert tight.seconds == small.seconds
    assert tight.first_visit == small.first_visit
    held = 4 * part.window - 2  # in whole views: those of the job, in place of those that the rank has surveyed
    assert tight.peak_bytes - small.peak_bytes == pytest.approx(held * (size - 10**8))
    shared, _ = on_two_ranks(replace(LARGE, intersection_bytes=size), sharing=2)
    assert shared.seconds > small.seconds, "two ranks on one machine have half of its memory each"


def test_phase_1_prepares_views_for_phase_2() -> None:
    alone, both = expected(LARGE), expected(LARGE, steps_coarse=40)
    assert alone.first_visit - both.first_visit == pytest.approx(0.25 * 5 + 0.5)
    assert both.first_visit_coarse > 0.25 * 5 + 0.5


def test_uncached_weights_save_no_time() -> None:
    """Cached weights get a quarter of 10 GB."""
    fit, quarter = (
        expected(RasterCost(0.3, 0.1, 40 * GIGABYTE, size), cached_weights="half")
        for size in (10 * GIGABYTE // 4, 10 * GIGABYTE)
    )
    assert quarter.seconds - fit.seconds == pytest.approx(0.2 * 3 / 4)


def test_region_maps_add_to_the_first_visit() -> None:
    """Four regions take two renders, plus one for the background.

    Each takes half as long as a render with its gradient.
    """
    settings = make_settings(steps_coarse=0, steps_sos=40, position_weights="off")
    plain = probe(raster=LARGE)
    predictions = [decide(each, settings).prediction for each in (plain, replace(plain, maps=4))]
    assert predictions[0] is not None
    assert predictions[1] is not None
    assert predictions[1].first_visit - predictions[0].first_visit == pytest.approx(3 * 0.5 * 2.0)
    assert predictions[1].seconds == predictions[0].seconds
    pixels = sum(height * width for height, width in plain.sizes)
    assert predictions[1].peak_bytes - predictions[0].peak_bytes == pytest.approx(4 * pixels * 16 / 3, abs=2)


def test_frozen_gaussians_are_rendered_and_not_optimized() -> None:
    plain = probe()
    frozen = torch.zeros(plain.scene.gaussians, dtype=torch.bool)
    frozen[:10] = True
    settings = make_settings(steps_coarse=0, steps_sos=40)
    without, partly_frozen = (decide(each, settings) for each in (plain, replace(plain, frozen=frozen)))
    assert torch.equal(partly_frozen.seen, without.seen)
    assert torch.equal(partly_frozen.optimized, without.optimized & ~frozen)
