"""Records of steps, and the state from which a run can be resumed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from sgsst_core.loss.terms import LossTerms

#: Parts of a job's time before its first step, as named in `seconds_by_part`: inputs, refinement, survey, the rest of
#: planning, and preparation of the steps.
BEFORE_STEPS = ("reading", "refining", "survey", "planning", "preparing")


@dataclass(frozen=True)
class StepRecord:
    """Record of one iteration.

    Attributes:
        step: Step number, counted from 1 over both phases.
        stage: Name of the phase: "coarse" or "sos".
        view: Index of the camera; of the first one if the step has several views.
        seconds: Wall-clock seconds of all iterations so far, in all sessions of a resumed job.
        loss: Loss before the step, mean over the step's views.
        terms: Loss by scale, split into terms.
        parts: Time in seconds of this step by activity.
        memory: Physical memory of the process after the step, in bytes.
        sent: Bytes sent by this rank to others, by purpose (`collectives.Traffic`); empty for a single rank.
        device_memory: Peak GPU memory of tensors so far, in bytes; None on a CPU.
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
