"""Tests of the coordination of ranks, without a scene: participation, agreement of colors, and speeds."""

from __future__ import annotations

import pytest
import torch

from sgsst_core.errors import RanksDriftedError
from sgsst_core.parallel.collectives import Collectives, RankLeftOut
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.survey import Survey
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.team import BALANCE_STEPS, DRIFT_STEPS, Team
from tests.worker.ranks.spawn import on_ranks


def plan(ranks: int) -> Plan:
    seen = torch.ones(3, dtype=torch.bool)
    survey = Survey(torch.ones(3, dtype=torch.float64), [0], [], 0.0)
    return Plan(survey, seen, seen, (0,), weighted=False, steps_coarse=0, memory_limit=1 << 30, ranks=ranks)


def drift(collectives: Collectives) -> list[str]:
    """Run the drift check on equal colors, then on different ones, and return its error message in a list."""
    team = Team(plan(2), make_settings(), collectives)
    colors, other = torch.zeros(3, 3), torch.full((3, 3), 1e-6 * collectives.rank)
    team.check_drift(DRIFT_STEPS, colors)
    team.check_drift(DRIFT_STEPS + 1, other)  # not checked at this step
    with pytest.raises(RanksDriftedError) as raised:
        team.check_drift(2 * DRIFT_STEPS, other)
    return [str(raised.value)]


def test_drift_is_detected_on_every_rank() -> None:
    for said in on_ranks(2, drift):
        assert said[0].startswith(f"Step {2 * DRIFT_STEPS}: the ranks' colors are no longer the same.")


def speeds(collectives: Collectives, slower: float, rebalance: bool) -> list[tuple[float, ...] | None]:
    """Return the reported speeds after each step. Rank 1 is slower by the factor `slower`."""
    team = Team(plan(2), make_settings(rebalance=rebalance), collectives)
    seconds = {"vgg_forward": 1.0, "vgg_backward": 1.0, "render": 9.0}
    if collectives.rank == 1:
        seconds = {name: slower * value for name, value in seconds.items()}
    return [team.compare_speeds(1000, seconds) for _ in range(BALANCE_STEPS + 2)]


@pytest.mark.parametrize(
    ("slower", "rebalance", "expected"), [(2.0, True, (500.0, 250.0)), (1.1, True, None), (2.0, False, None)]
)
def test_differing_speeds_are_reported_once(slower: float, rebalance: bool, expected: tuple[float, ...] | None) -> None:
    for reported in on_ranks(2, speeds, slower, rebalance):
        assert reported[BALANCE_STEPS - 1] == expected
        assert all(value is None for step, value in enumerate(reported) if step != BALANCE_STEPS - 1)


def group_of_rank(collectives: Collectives, ranks: int, views_per_step: int) -> tuple[int, int, int] | None:
    try:
        team = Team(plan(ranks), make_settings(views_per_step=views_per_step), collectives)
    except RankLeftOut:
        return None
    return team.everybody.size, team.groups, team.own_group


def test_ranks_form_groups_and_unneeded_ranks_leave() -> None:
    assert on_ranks(4, group_of_rank, 4, 2) == [(4, 2, 0), (4, 2, 0), (4, 2, 1), (4, 2, 1)]
    assert on_ranks(4, group_of_rank, 2, 1) == [(2, 1, 0), (2, 1, 0), None, None]
