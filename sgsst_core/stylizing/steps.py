"""Steps of a job: their phases, the order of views, their records and losses, and the state to resume from."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from sgsst_core.loss.terms import LossTerms, StyleTargets
from sgsst_core.scales import EVEN, ScaleWeights, ratio, smoothed
from sgsst_core.scene.camera import Camera
from sgsst_core.stylizing.views import ViewTargets

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
            drawn = torch.randperm(len(self._covered), generator=self.generator)
            self.left = [self._covered[index] for index in drawn.tolist()]
        return self.left.pop()


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


Evaluation = dict[int, LossTerms]
#: Callback that receives the number of completed and of all views.
ShowViews = Callable[[int, int], None]


def show_nothing(done: int, total: int) -> None:
    """Ignore the progress."""


def evaluate(
    targets: ViewTargets,
    style_targets: Callable[[Camera], StyleTargets],
    indices: Sequence[int],
    sh_dc: Tensor,
    show: ShowViews = show_nothing,
) -> Evaluation:
    """Return the mean SOS loss of colors [n, 3] over views, split by scale; `show` is called before each view."""
    views, loss = targets.views, targets.loss
    evaluations = []
    for done, index in enumerate(indices):
        show(done, len(indices))
        camera = views.cameras[index]
        with torch.no_grad():
            image = views.render(index, views.colors(index, sh_dc))
        target = targets.target(index, loss.tiling.scales((camera.height, camera.width)))
        evaluations.append(loss.evaluate(image, style_targets(camera), target, gradient=False).terms)
    return mean_evaluation(evaluations)


def mean_evaluation(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Return the mean over views, scale by scale; views without a scale do not count for it."""
    total: Evaluation = {}
    counts: Counter[int] = Counter()
    for evaluation in evaluations:
        counts.update(evaluation.keys())
        for scale, part in evaluation.items():
            total[scale] = total.get(scale, LossTerms()) + part
    return {scale: terms / counts[scale] for scale, terms in total.items()}


def completed(evaluation: Evaluation, scales: Sequence[int], view: int, history: Sequence[StepRecord]) -> Evaluation:
    """Return the loss of a step on a view, with estimates for the scales that it has not evaluated.

    An estimate is the loss of the coarsest scale times the ratio of both at the latest step that evaluated both: on the
    same view, or on any if there is none. Before the first of these steps, a scale is missing. Means over rounds are
    thereby comparable from round to round, whichever scales were drawn.

    Args:
        evaluation: Loss of the evaluated scales.
        scales: Scales of the view with a positive weight.
        history: Records of the earlier steps.
    """
    result, coarsest = dict(evaluation), max(evaluation)
    for scale in set(scales) - evaluation.keys():
        last = _last_with({scale, coarsest}, history, view) or _last_with({scale, coarsest}, history)
        if last:
            factor = ratio(evaluation[coarsest].total, last[coarsest].total) or 0.0
            result[scale] = last[scale] * factor
    return dict(sorted(result.items()))


def _last_with(scales: set[int], history: Sequence[StepRecord], view: int | None = None) -> Evaluation | None:
    """Return the loss of the last step that evaluated some scales, on one view or on any."""
    steps = (record for record in reversed(history) if view in (None, record.view))
    return next((record.terms for record in steps if scales <= set(record.evaluated)), None)


def round_loss(history: Sequence[StepRecord], round_length: int) -> float:
    """Return the loss of the last round of views: the geometric mean over the last steps of the current phase.

    Single steps see single views, whose losses differ by factors.
    """
    return smoothed([record.loss for record in _last_round(history, round_length)], round_length)


def round_evaluation(history: Sequence[StepRecord], round_length: int, weights: ScaleWeights = EVEN) -> Evaluation:
    """Return the loss of the last round of views by scale and term, scaled so that its mean is `round_loss`."""
    evaluation = mean_evaluation([record.terms for record in _last_round(history, round_length)])
    mean = mean_loss(evaluation, weights)
    factor = round_loss(history, round_length) / mean if mean > 0 else 1.0
    return {scale: terms * factor for scale, terms in evaluation.items()}


def _last_round(history: Sequence[StepRecord], round_length: int) -> list[StepRecord]:
    last = history[-round_length:]
    return [record for record in last if record.stage == last[-1].stage]


def relative_loss(before: Evaluation, after: Evaluation, weights: ScaleWeights = EVEN) -> float | None:
    """Return the loss after a job relative to that before it, over the scales that were computed.

    It is None if the loss before the job is 0.
    """
    return ratio(mean_loss(after, weights), mean_loss(on_scales_of(after, before), weights))


def on_scales_of(after: Evaluation, before: Evaluation) -> Evaluation:
    """Return the part of `before` on the scales of `after`, or all of `before` if they have none in common."""
    return {scale: before[scale] for scale in after if scale in before} or before


def mean_loss(evaluation: Evaluation, weights: ScaleWeights = EVEN) -> float:
    """Return E_SOS, the weighted mean of the losses of all scales."""
    return weights.mean({scale: terms.total for scale, terms in evaluation.items()})
