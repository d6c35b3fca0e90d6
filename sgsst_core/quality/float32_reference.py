"""Exact loss and gradient of a job, as the reference for measuring its approximations.

Features are float32, and blend weights are recomputed instead of cached. The
result is within 1e-6 of the float64 reference (tests/sgsst_core/loss/test_sos.py).
"""

from __future__ import annotations

import time
from contextlib import nullcontext
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.gradient_error import Difference
from sgsst_core.loss.sos import make_loss
from sgsst_core.loss.terms import layers_of
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import WHOLE_FLOAT32, StyleLossName
from sgsst_core.stylizing.job import StyleTargetCache
from sgsst_core.stylizing.steps import Evaluation, ShowViews, evaluate, show_nothing
from sgsst_core.stylizing.stylizer import Stylizer
from sgsst_core.stylizing.views import Views, ViewTargets


def approximations(stylizer: Stylizer) -> list[str]:
    """Return the names of a job's approximations whose gradient error exceeds rounding; empty if there are none."""
    names = []
    if stylizer.job.plan.precision not in WHOLE_FLOAT32:
        names.append("TF32 convolutions" if stylizer.job.network.tf32 else f"{stylizer.job.network.precision} features")
    if stylizer.job.plan.cached_weights == "half":
        names.append("half-precision blend weights")
    return names


def rasterizer_beside(stylizer: Stylizer, scene: Scene) -> Rasterizer:
    """Create a rasterizer of another scene with the job's settings.

    It shares the job's memory budget for tile intersections, with lower priority.
    """
    return stylizer.job.views.rasterizer.uncached.beside(scene)


@dataclass(frozen=True)
class GradientError(Difference):
    """Error of a color gradient relative to the exact one, over all optimized Gaussians.

    Attributes:
        step: Number of steps before the measurement.
        seconds: Seconds to compute the gradient with the job's approximations.
    """

    step: int
    view: str
    seconds: float
    seconds_exact: float


class ExactLoss:
    """Loss of a job in float32.

    Args:
        stylizer: Job to evaluate; not modified.
        style_loss: Style loss to evaluate, for comparing jobs with different style losses; None for the job's own.
    """

    def __init__(self, stylizer: Stylizer, style_loss: StyleLossName | None = None) -> None:
        self._stylizer = stylizer
        settings = stylizer.job.settings
        settings = settings.model_copy(update={"style_loss": style_loss or settings.style_loss})
        with_content, weights = settings.content_weight > 0, stylizer.job.weights
        layers = layers_of(settings.style_loss, weights, content=with_content, settings=settings)
        network = FeatureNetwork(weights, layers, torch.float32, stylizer.job.network.device)
        own = stylizer.job.loss
        self.loss = make_loss(network, settings, own.memory, content_weight=own.content_weight)
        self.style_targets = StyleTargetCache(stylizer.job.styles.to(network.device), self.loss)


class Float32Reference(ExactLoss):
    """Exact loss and gradient of a job's colors; `memory` is the budget in bytes for view targets."""

    def __init__(self, stylizer: Stylizer, memory: int = 1 << 30, *, style_loss: StyleLossName | None = None) -> None:
        super().__init__(stylizer, style_loss)
        settings = stylizer.job.settings
        rasterizer = stylizer.job.views.rasterizer.uncached
        self.seen = stylizer.job.plan.seen
        self.views = Views(
            stylizer.job.views.scene,
            stylizer.job.views.cameras,
            rasterizer,
            covered=stylizer.job.plan.survey.covered,
            memory=memory,
            clamp_aware_gradient=settings.clamp_aware_gradient,
        )
        self.view_targets = ViewTargets(
            self.views,
            self.loss,
            weighted=stylizer.job.plan.weighted,
            photos=stylizer.job.view_targets.photos,
            memory=memory,
            maps=stylizer.job.styles.maps(rasterizer, self.seen),
            content_maps=stylizer.job.styles.content_maps(rasterizer, self.seen),
        )

    def evaluate(self, indices: list[int], sh_dc: Tensor, show: ShowViews = show_nothing) -> Evaluation:
        """Return the mean SOS loss over views, by scale, for colors [N, 3] of the whole scene."""
        values = sh_dc[self.seen].to(self.views.rasterizer.device)
        return evaluate(self.view_targets, self.style_targets, indices, values, show)

    def gradient(self, index: int, sh_dc: Tensor, scales: list[int]) -> tuple[Tensor, float]:
        """Compute dE/dsh_dc [N, 3] for colors [N, 3] of the whole scene.

        Returns:
            Gradient, and the seconds to compute it without the view's targets.
        """
        target, style = self.view_targets.target(index, scales), self.style_targets(self.views.cameras[index])
        gradient = torch.zeros_like(sh_dc)
        values = sh_dc[self.seen].to(self.views.rasterizer.device)
        started = time.perf_counter()
        colors = self.views.colors(index, values)
        image = self.views.render(index, colors)
        pixels = self.loss.evaluate(image, style, target, scales).image_gradient
        assert pixels is not None
        gradient[self.seen] = self.views.gradient(index, pixels.to(image.device), colors).cpu()
        return gradient, time.perf_counter() - started

    def gradient_error(self, *, start: bool = False) -> GradientError:
        """Compare the job's gradient for its latest view with the exact one, at the job's current result colors.

        Args:
            start: Whether to use the unstylized colors and the first view instead.
        """
        stylizer = self._stylizer
        if start or not stylizer.history:
            index, phase = stylizer.job.views.covered[0], stylizer.job.schedule[0]
        else:
            index, phase = stylizer.history[-1].view, stylizer.phase
        scales = phase.scales(stylizer.job.scales(index))
        colors = stylizer.job.scene.sh_dc if start else stylizer.stylized()
        with stylizer.with_colors(colors) if start or stylizer.job.transfers_last else nullcontext():
            approximate, seconds = stylizer.gradient(index, scales)
        exact, seconds_exact = self.gradient(index, colors, scales)
        difference = Difference.of(approximate, exact[self.seen])
        step, view = 0 if start else stylizer.step, stylizer.job.views.cameras[index].name
        return GradientError(difference.relative_error, difference.cosine, step, view, seconds, seconds_exact)
