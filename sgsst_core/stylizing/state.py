"""What a run leaves behind: a record of every step, and the state from which it can go on."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from sgsst_core.loss.terms import LossTerms

#: Parts of a job's time before its first step, as `seconds_by_part` names them: inputs, the look at every view, what
#: else the plan is made from, and what is built for the steps.
BEFORE_STEPS = ("reading", "refining", "survey", "planning", "preparing")


@dataclass(frozen=True)
class StepRecord:
    """One iteration.

    Attributes:
        step: counted from 1 over both phases.
        stage: of the phase: "coarse", "sos".
        view: index of the camera; the first one where a step has several.
        seconds: wall-clock seconds of iterations so far, of all sessions of a resumed job.
        loss: E of the step's views before the step, their mean.
        terms: split loss by scale.
        parts: seconds of this step by what they went into.
        memory: bytes of physical memory that the process held after the step.
        sent: bytes that this rank sent to others, by what for (`collectives.Traffic`); empty for one rank.
        device_memory: most bytes of the GPU's memory that its tensors have held so far; None on a CPU.
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


@dataclass
class StylizerState:
    """Everything that a resumed run needs to go on bit for bit."""

    sh_dc: Tensor  # [N, 3]
    first_moment: Tensor  # [N, 3]
    second_moment: Tensor  # [N, 3]
    step: int
    seconds: float
    generator: Tensor  # state of the random generator
    queue: list[int]  # views left in this round
    history: list[StepRecord] = field(default_factory=list)
    seconds_by_part: dict[str, float] = field(default_factory=dict)
    memory: int | None = None  # bytes planned with: partition and kept weights follow from it, and so does rounding
    measured: list[dict[str, Any]] = field(default_factory=list)  # see `Stylizer.measured`
