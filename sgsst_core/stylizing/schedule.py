"""Steps of a job: their phases, the order of views, records, and the state from which a run can be resumed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from sgsst_core.loss.terms import LossTerms

#: Parts of a job's time before its first step, as named in `seconds_by_part`: start of the program, inputs, refinement,
#: survey, the rest of planning, and preparation of the steps.
BEFORE_STEPS = ("start", "reading", "refining", "survey", "planning", "preparing")


@dataclass(frozen=True)
class Phase:
    """Phase of the schedule.

    Attributes:
        stage: Name of the phase: "coarse" (phase 1) or "sos" (phase 2) in every preset.
        scale: Single scale to optimize, counted from the coarsest (0) of those with a weight; None for the SOS loss on
            all scales.
    """

    stage: str
    steps: int
    scale: int | None = None

    def scales(self, chosen: Sequence[int]) -> list[int]:
        """Return the scales to optimize, given a view's scales with a positive weight (`chosen`), finest first."""
        return list(chosen) if self.scale is None else [chosen[max(len(chosen) - 1 - self.scale, 0)]]


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

    Attributes:
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


def drawn_scales(chosen: Sequence[int], period: int, seed: int, view: int, visit: int) -> list[int]:
    """Return the scales of a view that a visit of phase 2 evaluates, finest first (`Settings.scale_sampling`).

    The coarsest is always among them. Of each `period` visits that evaluate a scale, one evaluates the next finer one
    too. The draw depends only on the arguments: there is no random state, and all ranks agree.

    Args:
        chosen: Scales of the view with a positive weight, finest first.
        period: Number of visits; 1 for all scales in every visit.
        visit: Number of earlier visits of the view.
    """
    count = 1
    while count < len(chosen):
        visit, position = divmod(visit, period)
        digest = hashlib.blake2b(f"{seed},{view},{count},{visit}".encode(), digest_size=8).digest()
        if position != int.from_bytes(digest, "big") % period:
            break
        count += 1
    return list(chosen[-count:])


@dataclass(frozen=True)
class StepRecord:
    """Record of one iteration.

    Attributes:
        step: Step number, counted from 1 over both phases.
        view: Index of the camera; of the first one if the step has several views.
        seconds: Wall-clock seconds of all iterations so far, in all sessions of a resumed job.
        loss: Loss before the step, mean over the step's views and over the scales in `terms`.
        terms: Loss by scale and term; of scales that the step has not evaluated, an estimate (`completed`).
        parts: Time in seconds of this step by activity.
        memory: Physical memory of the process after the step, in bytes.
        sent: Bytes sent by this rank to others, by purpose (`collectives.Traffic`); empty for a single rank.
        device_memory: Peak GPU memory of tensors so far, in bytes; None on a CPU.
        evaluated: Scales that the step has evaluated.
        pixels: Pixels that this rank has passed through the network.
    """

    step: int
    stage: str
    view: int
    seconds: float
    loss: float
    terms: dict[int, LossTerms]
    parts: dict[str, float]
    memory: int
    sent: dict[str, int] = field(default_factory=dict)
    device_memory: int | None = None
    evaluated: tuple[int, ...] = ()
    pixels: int = 0


@dataclass
class StylizerState:
    """State from which a run resumes with bit-identical results."""

    sh_dc: Tensor  # [N, 3]
    first_moment: Tensor  # [N, 3]
    second_moment: Tensor  # [N, 3]
    step: int
    seconds: float
    generator: Tensor  # state of the random generator
    queue: list[int]  # views left in this round
    history: list[StepRecord] = field(default_factory=list)
    seconds_by_part: dict[str, float] = field(default_factory=dict)
    # memory budget in bytes: it determines partition and cached weights, and thereby rounding
    memory: int | None = None
    measured: list[dict[str, Any]] = field(default_factory=list)  # see `Stylizer.measured`
