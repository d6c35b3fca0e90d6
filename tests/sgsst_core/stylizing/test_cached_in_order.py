"""Tests of jobs whose blend weights do not all fit in memory: the choice of cached views is deterministic."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from sgsst_core.budget import memory_for
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.sgsst_core.splat_scenes import is_cached
from tests.small_scenes import cameras, style, wall

VIEWS = cameras(6)
STEPS = 7
#: Enough visits of each view for cached weights on the coarsest scale.
PHASES = {"steps_coarse": 30, "steps_sos": 6, "coarsest_side": 16}
pytestmark = pytest.mark.usefixtures("one_thread")


def job(weights: BackboneWeights, form: Any, **settings: Any) -> Stylizer:
    """Make a job with enough memory for the blend weights of about half the views."""
    scene = wall()
    cached = CachedRasterizer(scene, precision="float32" if form == "float32" else "half")
    size = sum(cached.count_weights(camera).nbytes(cached.precision) for camera in VIEWS) // 2
    settings = {"steps_coarse": 0, "steps_sos": STEPS, "position_weights": "on", "seed": 3, **settings}
    limit = size * 1024 // memory_for("rasterizer", 1024)
    chosen = make_settings("preview", cached_weights=form, memory_limit=limit, **settings)
    return Stylizer.planned(scene, VIEWS, style(), chosen, weights=weights)


def cached_views(stylizer: Stylizer) -> list[bool]:
    rasterizer: Any = stylizer.job.views.rasterizer
    return [is_cached(rasterizer, camera) for camera in stylizer.job.views.cameras]


def steps(stylizer: Stylizer, count: int) -> Stylizer:
    for _ in range(count):
        stylizer.run_step()
    return stylizer


@pytest.mark.parametrize(("form", "views_per_step"), [("float32", 1), ("half", 2)])
def test_evaluations_between_steps_do_not_change_results(
    form: str, views_per_step: int, tiny_weights: BackboneWeights
) -> None:
    alone, watched = (job(tiny_weights, form, views_per_step=views_per_step) for _ in range(2))
    everything = list(range(len(VIEWS)))
    watched.evaluate(everything)
    watched.gradient(4, watched.job.scales(4))
    steps(alone, STEPS)
    for _ in range(STEPS):
        watched.run_step()
        watched.evaluate(everything[::-1])
    assert 0 < sum(cached_views(alone)) < len(VIEWS)
    assert cached_views(watched) == cached_views(alone)
    assert torch.equal(watched.sh_dc, alone.sh_dc)


@pytest.mark.parametrize(("form", "views_per_step"), [("float32", 2), ("half", 1)])
def test_resumed_job_caches_the_same_views(form: str, views_per_step: int, tiny_weights: BackboneWeights) -> None:
    whole, early, late = (job(tiny_weights, form, views_per_step=views_per_step) for _ in range(3))
    state = steps(whole, 2).state()
    losses = whole.evaluate([5, 0])
    steps(whole, STEPS - 2)
    early.load_state(state)
    assert early.evaluate([5, 0]) == losses
    assert torch.equal(steps(early, STEPS - 2).sh_dc, whole.sh_dc)
    late.load_state(whole.state())
    assert late.evaluate([5, 0]) == whole.evaluate([5, 0])
    assert torch.equal(late.sh_dc, whole.sh_dc)
    assert cached_views(early) == cached_views(late) == cached_views(whole)


@pytest.mark.slow
@pytest.mark.parametrize("before", [3, 33])
def test_job_resumed_in_either_phase_caches_the_same_views(before: int, tiny_weights: BackboneWeights) -> None:
    whole, rest = (job(tiny_weights, "auto", **PHASES) for _ in range(2))
    rest.load_state(steps(whole, before).state())
    steps(whole, 2)
    assert torch.equal(steps(rest, 2).sh_dc, whole.sh_dc)
    assert cached_views(rest) == cached_views(whole)


def test_caller_decides_which_views_are_cached() -> None:
    scene, view = wall(), VIEWS[0]
    cached, cpu = CachedRasterizer(scene, at_first_use=False), CpuRasterizer(scene)
    pixels = torch.ones(view.height, view.width, 3)
    assert torch.equal(cached.color_gradient(pixels, view), cpu.color_gradient(pixels, view))
    assert (is_cached(cached, view), cached.cached_bytes) == (False, 0)
    assert cached.cache_weights(view)
    assert is_cached(cached, view)
    assert not is_cached(cached, VIEWS[1])
    assert not CachedRasterizer(scene, at_first_use=False, max_bytes=10).cache_weights(view)


def test_temporary_weights_match_cached_weights() -> None:
    scene, view = wall(), VIEWS[0]
    lender, keeper = (CachedRasterizer(scene, at_first_use=False, precision="half") for _ in range(2))
    pixels = torch.ones(view.height, view.width, 3)
    keeper.cache_weights(view)
    with lender.temporary_weights(view):
        assert torch.equal(lender.color_gradient(pixels, view), keeper.color_gradient(pixels, view))
    uncached = CpuRasterizer(scene).color_gradient(pixels, view)
    assert torch.equal(lender.color_gradient(pixels, view), uncached)
    assert lender.cached_bytes == 0
    small = CachedRasterizer(scene, at_first_use=False, precision="half", max_bytes=10)
    with small.temporary_weights(view):
        assert torch.equal(small.color_gradient(pixels, view), uncached)
    with keeper.temporary_weights(view):
        pass
    assert is_cached(keeper, view)
