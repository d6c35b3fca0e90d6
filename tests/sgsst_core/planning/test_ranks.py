"""Tests of the planner's performance model of several ranks."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from sgsst_core.features.partition import Rectangle
from sgsst_core.parallel.division import Piece
from sgsst_core.planning.facts import Link
from sgsst_core.planning.ranks import IterationWork, choose_ranks
from sgsst_core.planning.view_costs import proportional

FREE = Link(math.inf, 0.0)
SLOW = Link(1e6, 1e-3)


def work(height: int = 720, width: int = 1280, scales: int = 2) -> IterationWork:
    pieces = tuple(Piece(s, (height >> s, width >> s), Rectangle(0, 0, height >> s, width >> s)) for s in range(scales))
    return IterationWork(pieces, halo=64, pixel=1e-6, raster=proportional(0.1), fixed=0.01, gaussians=50_000)


def test_one_rank_has_no_communication() -> None:
    assert work().communication(1, SLOW) == 0
    assert work().seconds(1, SLOW) == pytest.approx(1e-6 * 1.25 * 720 * 1280 + 0.11)


def test_link_times_follow_from_ring_algorithms() -> None:
    link = Link(bandwidth=1e9, latency=1e-4)
    assert link.all_gather(4_000_000, 4) == pytest.approx(3 * (1e-4 + 1e-3))
    assert link.all_reduce(4_000_000, 4) == pytest.approx(2 * link.all_gather(4_000_000, 4))


def test_gradients_of_gaussians_that_the_view_shows_are_communicated() -> None:
    def sent(shown: float | None) -> float:
        return replace(work(), shown=shown).communication(4, SLOW)

    assert sent(None) == sent(60_000) == sent(40_000) == work().communication(4, SLOW)
    saved = SLOW.all_reduce(12 * 50_000, 4) - SLOW.all_reduce(12 * 20_000, 4)
    assert sent(None) - sent(20_000) == pytest.approx(saved)


def test_ranks_wait_for_the_sent_bytes() -> None:
    link = Link(1e6, 0.0)
    for ranks in (2, 3, 4):
        sent, more = (replace(work(scales=scales), shown=20_000).sent(ranks) for scales in (1, 3))
        waiting = replace(work(scales=3), shown=20_000).waiting(ranks, link)
        assert more["statistics"] == pytest.approx(3 * sent["statistics"])
        assert more["gradient"] == sent["gradient"]
        for kind in ("statistics", "gradient"):
            assert waiting[kind] == pytest.approx(more[kind] / 1e6, rel=1e-5)
        assert more["image"] / 1e6 <= waiting["image"] <= 2 * more["image"] / 1e6, "of the busier direction"
    assert set(work().sent(1).values()) == {0}


def test_launches_take_time_only_if_the_gpu_has_less_work() -> None:
    """Launching the tiles of both scales takes 0.2 s, and their pixels 1.15 s."""
    plain = replace(work(), raster=proportional(0.0))
    assert replace(plain, launch=0.1).computing(1) == plain.computing(1)
    idle = replace(plain, launch=2.0)
    assert idle.computing(1) == pytest.approx(2 * 2.0 + plain.fixed)
    assert replace(idle, graphs=True).computing(1) == plain.computing(1), "a graph is launched at once"
    tiles = max(map(len, idle.shards(4)))
    assert replace(idle, graphs=True).computing(4) == pytest.approx(tiles * 2.0 + plain.fixed)


def test_groups_sum_complete_gradients() -> None:
    """The model cannot know which Gaussians the views of a step show together."""
    phases = [(0, [work()]), (10, [replace(work(), shown=1)])]
    groups = choose_ranks(phases, 2, 2, SLOW)
    assert groups.seconds[2] - groups.seconds[1] / 2 == pytest.approx(10 * SLOW.all_reduce(12 * 50_000, 2))


def test_free_link_uses_all_ranks_and_slow_link_one() -> None:
    phases = [(10, [work()]), (20, [work()])]
    free = choose_ranks(phases, 1, 4, FREE)
    assert free.ranks == 4
    assert free.speed_up == pytest.approx(free.seconds[1] / free.seconds[4])
    assert 2.5 < free.speed_up < 4
    slow = choose_ranks(phases, 1, 4, SLOW)
    assert slow.ranks == 1
    assert slow.speed_up == 1


def test_additional_ranks_must_save_time() -> None:
    """For a view that is all halo, more ranks only speed up the rasterizer."""
    small = replace(work(40, 40, 1), raster=proportional(1e-6))
    assert choose_ranks([(0, [small]), (10, [small])], 1, 8, FREE).ranks == 1


def test_groups_process_views_in_parallel() -> None:
    """Two views per step on two ranks need no halos, so they are twice as fast apart from the sum of colors."""
    phases = [(0, [work()]), (10, [work()])]
    groups = choose_ranks(phases, 2, 2, FREE)
    assert groups.speed_up == pytest.approx(2.0)


def test_large_numbers_of_ranks_are_tried_in_increasing_steps() -> None:
    groups = choose_ranks([(0, [work()]), (1, [work()])], 1, 64, FREE)
    assert {1, 2, 3, 4, 8, 64} <= set(groups.seconds)
    assert len(groups.seconds) < 25


def test_pixels_beyond_memory_are_recomputed() -> None:
    """Two ranks on one machine have half of its memory each, and cache the activations of all scales."""
    pixels = 1.25 * 720 * 1280
    roomy = replace(work(), forward=1e-6, held=2 * pixels, working=0.1, sharing=2)
    tight = replace(roomy, held=pixels)
    assert tight.computing(1) == roomy.computing(1) == replace(roomy, held=math.inf).computing(1)
    assert tight.computing(2) > 1.1 * roomy.computing(2)
    assert replace(tight, sharing=1).computing(2) == roomy.computing(2)
    assert tight.computing(1, groups=2) > tight.computing(1), "groups share memory as well"
    assert roomy.computing(2) == pytest.approx(work().computing(2))
