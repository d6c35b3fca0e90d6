"""Quality measurements at the end of a job: novel views, approximations, and what a compressed file lost.

Approximations are measured against the exact loss and gradient. Features are float32, and blend weights are recomputed
instead of cached. The result is within 1e-6 of the float64 reference (tests/sgsst_core/loss/test_sos.py).
"""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import memory_for
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.files.formats import by_name
from sgsst_core.files.scene_file import losses, read_scene
from sgsst_core.loss.sos import SosLoss, make_loss
from sgsst_core.loss.terms import layers_of
from sgsst_core.planning.survey import psnr
from sgsst_core.quality.judge import Judge, Lpips, load_lpips_or_none
from sgsst_core.quality.novel_views import MAX_VIEWS, NovelViews
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import WHOLE_FLOAT32, StyleLossName
from sgsst_core.stylizing.stylizer import Evaluation, ShowViews, Stylizer, evaluate, show_nothing
from sgsst_core.stylizing.views import Views, ViewTargets


class Measurements:
    """Quality measurements of a job, for as many novel views as its plan says.

    They are stored in `Stylizer.measured`. Networks and views are created at first use.

    Args:
        show: Callback before each view of a measurement, with the number of completed and of all views.
    """

    def __init__(self, stylizer: Stylizer, show: ShowViews = show_nothing) -> None:
        self._stylizer, self._show = stylizer, show
        self.approximated = approximations(stylizer)

    @cached_property
    def exact(self) -> "Float32Reference":
        """Exact loss and gradient of the job."""
        return Float32Reference(self._stylizer, memory_for("measuring", self._stylizer.job.memory))

    def start(self) -> Evaluation:
        """Return the exact loss of the unstylized scene on the evaluation views."""
        stylizer = self._stylizer
        if not self.approximated:
            return stylizer.start(self._show)
        with stylizer.timed("measuring"):
            return self.exact.evaluate(stylizer.job.evaluation_views, stylizer.job.scene.sh_dc, self._show)

    def at_the_end(self) -> None:
        """Measure the unstylized scene and the result, and judge both."""
        stylizer, most = self._stylizer, self._stylizer.job.plan.novel_views
        if not most:
            return
        with stylizer.timed("measuring"):
            novel_views = make_novel_views(stylizer, lpips=load_lpips_or_none(stylizer.job.network.device), most=most)
            moments, errors = [], []
            for start in (True, False):
                if self.approximated:
                    errors.append(asdict(self.exact.gradient_error(start=start)))
                if novel_views.views:
                    moment = novel_views.measure(stylizer.job.scene.sh_dc if start else stylizer.stylized(), self._show)
                    moments.append(moment.as_dict(0, 0.0) if start else moment.as_dict(stylizer.step, stylizer.seconds))
            between = {
                "views": [novel_views.cameras[index].name for index in novel_views.views],
                "lpips": novel_views.lpips.network if novel_views.lpips else None,
                "moments": moments,
                "judged": _judged(stylizer, novel_views),
            }
            stylizer.measured = {
                "novel_views": between if moments else None,
                "approximations": {"what": self.approximated, "moments": errors} if errors else None,
            }


def _judged(stylizer: Stylizer, novel_views: NovelViews) -> dict[str, Any] | None:
    """Return the judgments of the unstylized scene and of the result; None without AlexNet, or if not rank 0."""
    if novel_views.lpips is None or stylizer.job.collectives.rank:
        return None
    judge = make_judge(stylizer, novel_views, novel_views.lpips)
    colors = {"before": stylizer.job.scene.sh_dc, "after": stylizer.stylized()}
    judgments = {name: judge.judge(sh_dc) for name, sh_dc in colors.items()}
    return {name: asdict(one) for name, one in judgments.items() if one} or None


def make_novel_views(stylizer: Stylizer, *, lpips: Lpips | None = None, most: int = MAX_VIEWS) -> NovelViews:
    """Create the novel views of a job; their Gram distance is that of the paper's loss in float32 for every job."""
    job, loss = stylizer.job, _float32_loss(stylizer, "sos")
    scene = job.scene.without_zero_bands()
    own = job.views.rasterizer.uncached  # caches the latest tile intersections only
    rasterizer = own.for_scene(scene, **own.options(0))
    return NovelViews(
        job.views.cameras,
        job.views.covered,
        scene,
        rasterizer,
        loss,
        job.styles.cached_targets(loss),
        weighted=job.plan.weighted,
        lpips=lpips,
        most=most,
        memory=memory_for("measuring", job.memory),
        maps=job.styles.maps(rasterizer),
    )


def make_judge(stylizer: Stylizer, novel_views: NovelViews, lpips: Lpips) -> Judge:
    """Create the judge of a job's colors on its novel views."""
    cameras = [novel_views.cameras[index] for index in novel_views.views]
    background = stylizer.job.settings.background
    return Judge(lpips, stylizer.job.styles, novel_views.scene, novel_views.rasterizer, cameras, background)


def approximations(stylizer: Stylizer) -> list[str]:
    """Return the names of a job's approximations whose gradient error exceeds rounding; empty if there are none."""
    names = []
    if stylizer.job.plan.precision not in WHOLE_FLOAT32:
        names.append("TF32 convolutions" if stylizer.job.network.tf32 else f"{stylizer.job.network.precision} features")
    if stylizer.job.plan.cached_weights == "half":
        names.append("half-precision blend weights")
    return names


def difference(actual: Tensor, exact: Tensor) -> tuple[float, float]:
    """Return the `relative_error` and the `cosine` of a `GradientError` for two gradients of the same shape.

    Computes in float64. If a value is not finite, the error is infinite.
    """
    error, length = (actual - exact).double().norm(), exact.double().norm()
    product = float((actual.double() * exact.double()).sum())
    lengths = float(actual.double().norm() * length)
    if not math.isfinite(lengths):
        return math.inf, 0.0
    return (
        float(error / length) if length > 0 else float(error > 0),
        product / lengths if lengths > 0 else float(not error > 0),
    )


@dataclass(frozen=True)
class GradientError:
    """Error of a color gradient relative to the exact one, over all optimized Gaussians.

    Attributes:
        relative_error: |actual - exact| / |exact| in the Euclidean norm. If the exact gradient is 0, the error is 0 if
            the actual gradient is also 0, and 1 otherwise.
        cosine: Cosine of the angle between the gradients. If one gradient is 0, the cosine is 1 if both are 0, and 0
            otherwise.
        step: Number of steps before the measurement.
        seconds: Seconds to compute the gradient with the job's approximations.
    """

    relative_error: float
    cosine: float
    step: int
    view: str
    seconds: float
    seconds_exact: float


def _float32_loss(stylizer: Stylizer, style_loss: StyleLossName) -> SosLoss:
    """Return a loss in float32, whose network is the job's if that is the same one."""
    job = stylizer.job
    settings = job.settings.model_copy(update={"style_loss": style_loss})
    layers = layers_of(style_loss, job.weights, content=settings.content_weight > 0)
    network = job.network
    if job.plan.precision != "float32" or network.layers != layers:
        network = FeatureNetwork(job.weights, layers, torch.float32, network.device)
    return make_loss(network, settings, job.loss.memory, content_weight=job.loss.content_weight)


class Float32Reference:
    """Exact loss and gradient of a job's colors in float32.

    Args:
        stylizer: Job to evaluate; not modified.
        memory: Budget in bytes for view targets.
        style_loss: Style loss to evaluate, for comparing jobs with different style losses; None for the job's own.
    """

    def __init__(self, stylizer: Stylizer, memory: int = 1 << 30, *, style_loss: StyleLossName | None = None) -> None:
        self._stylizer = stylizer
        self.loss = _float32_loss(stylizer, style_loss or stylizer.job.settings.style_loss)
        self.style_targets = stylizer.job.styles.cached_targets(self.loss)
        rasterizer = stylizer.job.views.rasterizer.uncached
        self.seen = stylizer.job.plan.seen
        self.views = Views(
            stylizer.job.views.scene,
            stylizer.job.views.cameras,
            rasterizer,
            covered=stylizer.job.plan.survey.covered,
            memory=memory,
            clamp_aware_gradient=stylizer.job.settings.clamp_aware_gradient,
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
        approximate, seconds = stylizer.gradient(index, scales, colors[self.seen])
        exact, seconds_exact = self.gradient(index, colors, scales)
        error = difference(approximate, exact[self.seen])
        step, view = 0 if start else stylizer.step, stylizer.job.views.cameras[index].name
        return GradientError(*error, step, view, seconds, seconds_exact)


#: PSNR in dB below which the loss of a converted file is large. Real scenes have 47 or more.
_LARGE_LOSS = 35.0
#: Number of views in which a converted file is compared, and their longer side in pixels.
_VIEWS, _SIDE = 3, 256


def scene_psnr(
    first: Scene,
    second: Scene,
    cameras: Sequence[Camera],
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float,
) -> float | None:
    """Return the PSNR in dB of CPU renders of two scenes over all views, with colors clamped to 0 to 1.

    Args:
        cameras: Cameras of the views, at least one.

    Returns:
        PSNR; None if all renders are identical.
    """

    def renders(scene: Scene) -> Iterator[Tensor]:
        rasterizer = make_rasterizer("cpu", scene, background=background, near=near, memory=0)
        for camera in cameras:
            yield rasterizer.render(scene_colors(scene, camera), camera).clamp(0, 1)

    squares = values = 0.0
    for one, other in zip([*renders(first)], renders(second), strict=True):  # one rasterizer at a time
        squares += float((one.double() - other.double()).square().sum())
        values += one.numel()
    return psnr(squares / values) if squares else None


@dataclass(frozen=True)
class CompressionLoss:
    """Quality loss of a compressed file relative to the original scene.

    Attributes:
        psnr: PSNR in dB of these views against those of the original scene, with colors clamped to 0 to 1; None if all
            are identical.
        lost_mode: How the file is read if it cannot state the scene's render mode; empty if it can.
        warnings: Losses that the format causes.
    """

    name: str
    format: str
    size: int
    views: list[str]
    psnr: float | None
    lost_mode: str = ""
    warnings: tuple[str, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the values for the JSON report."""
        psnr = None if self.psnr is None else round(self.psnr, 2)
        values = {"name": self.name, "format": self.format, "bytes": self.size, "views": self.views, "psnr_db": psnr}
        more = {"lost_mode": self.lost_mode, "warnings": list(self.warnings)}
        return values | {name: value for name, value in more.items() if value}

    def text(self, original: str) -> str:
        """Return a description of the result in one line, given that of the original file."""
        psnr = "renders identical to" if self.psnr is None else f"{self.psnr:.1f} dB PSNR against"
        lost = "".join(
            f"; {each}" for each in (self.lost_mode, *(f"warning: {each}" for each in self.warnings)) if each
        )
        return f"{self.format}, {self.size / 1e6:.1f} MB, {psnr} {original}{lost}"


def measure_compression(
    path: Path,
    scene: Scene,
    cameras: Sequence[Camera],
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float,
    axes: str = "rub",
) -> CompressionLoss:
    """Read a compressed file back, and compare small CPU renders of some views with the original scene.

    Args:
        cameras: Cameras to choose views from, at least one.
        axes: Axes that an SPZ was written with.

    Raises:
        SceneError: If the file cannot be read.
    """
    back = read_scene(path, spz_axes="rdf" if axes == "rdf" else "auto")
    chosen = [resized(camera, min(_SIDE, max(camera.width, camera.height))) for camera in spread(cameras, _VIEWS)]
    loss = scene_psnr(scene, back.scene, chosen, background=background, near=near)
    names, read_as = [camera.name for camera in chosen], back.scene.rendering
    lost = "" if read_as == scene.rendering else f"read as {read_as.text}, since it cannot state {scene.rendering.text}"
    warnings = losses(scene, by_name(back.format))
    if loss is not None and loss < _LARGE_LOSS:
        warnings += ("the loss is large",)
    return CompressionLoss(path.name, back.format, path.stat().st_size, names, loss, lost, warnings)
