"""SOS loss of given colors on some views, split by scale."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from sgsst_core.loss.convergence import ratio, smoothed
from sgsst_core.loss.scale_weights import EVEN, ScaleWeights
from sgsst_core.loss.targets import StyleTargets
from sgsst_core.loss.terms import LossTerms
from sgsst_core.scene.camera import Camera
from sgsst_core.stylizing.state import StepRecord
from sgsst_core.stylizing.view_targets import ViewTargets

Evaluation = dict[int, LossTerms]


def evaluate(
    targets: ViewTargets, style_targets: Callable[[Camera], StyleTargets], indices: Sequence[int], sh_dc: Tensor
) -> Evaluation:
    """Return the mean SOS loss of colors [n, 3] over views, split by scale."""
    views, loss = targets.views, targets.loss
    evaluations = []
    for index in indices:
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
    return {
        scale: LossTerms(**{name: value * factor for name, value in terms.items()})
        for scale, terms in evaluation.items()
    }


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
