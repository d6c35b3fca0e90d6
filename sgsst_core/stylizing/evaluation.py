"""SOS loss of given colors on some views, split by scale."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from sgsst_core.loss.scale_weights import EVEN, ScaleWeights
from sgsst_core.loss.targets import StyleTargets
from sgsst_core.loss.terms import LossTerms
from sgsst_core.scene.camera import Camera
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
    """Return the mean over views, scale by scale."""
    total: Evaluation = {}
    for evaluation in evaluations:
        for scale, part in evaluation.items():
            total[scale] = total.get(scale, LossTerms()) + part
    return {scale: terms / len(evaluations) for scale, terms in total.items()}


def mean_loss(evaluation: Evaluation, weights: ScaleWeights = EVEN) -> float:
    """Return E_SOS, the weighted mean of the losses of all scales."""
    return weights.mean({scale: terms.total for scale, terms in evaluation.items()})
