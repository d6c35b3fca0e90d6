"""Tests of the coordination of ranks, without a scene: groups, and agreement of colors."""

from __future__ import annotations

import pytest
import torch

from sgsst_core.errors import RanksDriftedError
from sgsst_core.parallel.collectives import DRIFT_STEPS, Collectives, Team
from sgsst_core.settings import make_settings
from tests.worker.ranks.spawn import on_ranks


def drift(collectives: Collectives) -> list[str]:
    """Run the drift check on equal colors, then on different ones, and return its error message in a list."""
    team = Team(make_settings(), collectives)
    colors, other = torch.zeros(3, 3), torch.full((3, 3), 1e-6 * collectives.rank)
    team.check_drift(DRIFT_STEPS, colors)
    team.check_drift(DRIFT_STEPS + 1, other)  # not checked at this step
    with pytest.raises(RanksDriftedError) as raised:
        team.check_drift(2 * DRIFT_STEPS, other)
    return [str(raised.value)]


def test_drift_is_detected_on_every_rank() -> None:
    for said in on_ranks(2, drift):
        assert said[0].startswith(f"Step {2 * DRIFT_STEPS}: the ranks' colors are no longer the same.")


def group_of_rank(collectives: Collectives) -> tuple[int, int, int]:
    team = Team(make_settings(views_per_step=2), collectives)
    return team.everybody.size, team.groups, team.own_group


def test_ranks_form_groups() -> None:
    assert on_ranks(4, group_of_rank) == [(4, 2, 0), (4, 2, 0), (4, 2, 1), (4, 2, 1)]
