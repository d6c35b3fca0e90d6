"""Schedule of a job: its phases, and the order of views."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch

from sgsst_core.planning.plan import Plan
from sgsst_core.settings import Settings


@dataclass(frozen=True)
class Phase:
    """Phase of the schedule.

    Attributes:
        stage: Name of the phase: "coarse" (phase 1) or "sos" (phase 2) in every preset.
        steps: Number of steps.
        scale: Single scale to optimize, counted from the coarsest (0) of those with a weight; None for the SOS loss on
            all scales.
    """

    stage: str
    steps: int
    scale: int | None = None

    def scales(self, chosen: Sequence[int]) -> list[int]:
        """Return the scales to optimize, given a view's scales with a positive weight (`chosen`), finest first."""
        return list(chosen) if self.scale is None else [chosen[max(len(chosen) - 1 - self.scale, 0)]]


def planned_phases(plan: Plan, settings: Settings) -> list[Phase]:
    """Return the two phases of every preset."""
    return [Phase("coarse", plan.steps_coarse, 0), Phase("sos", settings.steps_sos)]


def phase_at(schedule: Sequence[Phase], step: int) -> Phase:
    """Return the phase of the step after `step` completed steps; the last phase if all steps are done."""
    for phase in schedule:
        if step < phase.steps:
            return phase
        step -= phase.steps
    return schedule[-1]


def drawn_round(covered: Sequence[int], generator: torch.Generator) -> list[int]:
    """Return every view once in random order, for taking views from the end of the list."""
    return [covered[i] for i in torch.randperm(len(covered), generator=generator).tolist()]


class ViewOrder:
    """Random order of the views of a job, in which every view comes once before any comes again.

    Args:
        covered: Indices of the views.
        seed: Seed of the order.

    Attributes:
        generator: Random generator, part of checkpoints.
        left: Remaining views of this round, next one last; part of checkpoints.
    """

    def __init__(self, covered: Sequence[int], seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)
        self.left: list[int] = []
        self._covered = covered

    def next_view(self) -> int:
        """Remove and return the next view. Rounds are drawn lazily, because checkpoints store the rest of a round."""
        if not self.left:
            self.left = drawn_round(self._covered, self.generator)
        return self.left.pop()


def drawn_views(covered: Sequence[int], seed: int) -> Iterator[int]:
    """Yield the views of all steps of a job from its start, round after round."""
    generator = torch.Generator().manual_seed(seed)
    while True:
        yield from reversed(drawn_round(covered, generator))
