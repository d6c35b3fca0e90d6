"""What is optimized when: the phases of a job."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from sgsst_core.planning.plan import Plan
from sgsst_core.settings import Settings


@dataclass(frozen=True)
class Phase:
    """A part of the schedule.

    Attributes:
        stage: its name: "coarse" (phase 1) and "sos" (phase 2) in every preset.
        steps: how many.
        scale: the one scale that is optimized, counted from the coarsest (0) of those that count; None for all of them,
            the SOS loss.
    """

    stage: str
    steps: int
    scale: int | None = None

    def scales(self, chosen: Sequence[int]) -> list[int]:
        """Those of a view's chosen scales, the finest first, that are optimized."""
        return list(chosen) if self.scale is None else [chosen[max(len(chosen) - 1 - self.scale, 0)]]


def planned_phases(plan: Plan, settings: Settings) -> list[Phase]:
    """The two phases of every preset."""
    return [Phase("coarse", plan.steps_coarse, 0), Phase("sos", settings.steps_sos)]


def phase_at(schedule: Sequence[Phase], step: int) -> Phase:
    """The phase that the step after so many belongs to; the last one when all are done."""
    for phase in schedule:
        if step < phase.steps:
            return phase
        step -= phase.steps
    return schedule[-1]


def drawn_round(covered: Sequence[int], generator: torch.Generator) -> list[int]:
    """Every view once in random order; the last one comes first."""
    return [covered[i] for i in torch.randperm(len(covered), generator=generator).tolist()]


def drawn_views(covered: Sequence[int], seed: int) -> Iterator[int]:
    """The views of all steps of a job from its first one on, round after round."""
    generator = torch.Generator().manual_seed(seed)
    while True:
        yield from reversed(drawn_round(covered, generator))
