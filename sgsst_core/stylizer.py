"""The optimiser loop: Adam on the DC colours, coarse phase then SOS, one view a step.

The loop prints nothing and writes nothing; what is to be shown or saved goes through `Callbacks`.
"""

from __future__ import annotations

import importlib.util
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from sgsst_core.budget import default_memory_limit
from sgsst_core.camera import Camera, resized
from sgsst_core.errors import CameraError, DivergedError
from sgsst_core.loss import LayerTarget, LossTerms
from sgsst_core.planner import make_plan
from sgsst_core.pyramid import scale_count
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.scene import Scene
from sgsst_core.settings import Settings
from sgsst_core.sos import SosLoss
from sgsst_core.timing import Timer
from sgsst_core.unseen import neighbours_change
from sgsst_core.vgg import CONTENT_LAYER, STYLE_LAYERS, FeatureNetwork
from sgsst_core.views import PhotoLoader, Views
from sgsst_core.weights import BackboneWeights, load_weights

#: Adam's epsilon: as good as none, so that Gaussians of any blend weight move at the learning rate (SGSST).
ADAM_EPS = 1e-15
#: Adam squares gradients in float32. Beyond this a square is infinite and its value would never move again, silently.
LARGEST_GRADIENT = 1e19
#: Of the memory limit: activations of one iteration, view targets and colours, and the rasterizer's lists or weights.
MEMORY_SHARES = {"activations": 0.5, "views": 0.25, "rasterizer": 0.25}

Stage = Literal["coarse", "sos"]
Stopped = Literal["finished", "max-seconds", "interrupted"]


@dataclass(frozen=True)
class StepRecord:
    """One iteration.

    Attributes:
        step: counted from 1 over both phases.
        stage: "coarse" or "sos".
        view: index of the camera.
        seconds: wall-clock seconds of iterations so far, of all sessions of a resumed job.
        loss: E of the view before the step.
        terms: split loss by scale.
    """

    step: int
    stage: Stage
    view: int
    seconds: float
    loss: float
    terms: dict[int, LossTerms]


@dataclass(frozen=True)
class Progress:
    """What a progress bar shows."""

    stage: Stage
    step: int
    total: int
    loss: float
    seconds: float
    seconds_left: float


@dataclass
class Callbacks:
    """What the loop calls between iterations; each is optional.

    Attributes:
        progress: after every iteration.
        stop: asked before every iteration; True ends the loop as "interrupted".
        checkpoint: called with the stylizer about every `checkpoint_seconds`, and once when the loop ends early.
        preview: called with the stylizer about every `preview_seconds`.
    """

    progress: Callable[[Progress], None] | None = None
    stop: Callable[[], bool] | None = None
    checkpoint: Callable[[Stylizer], None] | None = None
    checkpoint_seconds: float = 300.0
    preview: Callable[[Stylizer], None] | None = None
    preview_seconds: float = 60.0


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


class Stylizer:
    """One scene's stylization, step by step.

    Args:
        scene: what to stylize.
        cameras: the views; larger ones are brought down to `settings.max_resolution`. Those that see nothing are left
            out (see `views.covered`).
        style: [H, W, 3] in 0..1.
        settings: see `Settings`.
        weights: of the feature network; None loads VGG19, or VGG16 where only that is installed.
        photos: content image of a camera by its index, at its (brought down) size; None for unstylized renders.
        rasterizer: "auto", "cpu", "cached", "cuda" or "reference".

    Raises:
        CameraError: no cameras, or none sees a Gaussian.
        WeightsError: no weights.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        style: Tensor,
        settings: Settings,
        *,
        weights: BackboneWeights | None = None,
        photos: PhotoLoader | None = None,
        rasterizer: str = "auto",
    ) -> None:
        if not cameras:
            raise CameraError("There are no cameras. Give a camera file, or let --orbit make some.")
        self.settings = settings
        self.timer = Timer()
        self.seconds = 0.0
        self.seconds_by_part: dict[str, float] = {}
        self.step = 0
        self.history: list[StepRecord] = []
        self.memory = settings.memory_limit or default_memory_limit()
        self.network = self._network(weights or load_weights("auto"))
        self.loss = SosLoss(
            self.network,
            content_weight=settings.content_weight,
            memory=int(self.memory * MEMORY_SHARES["activations"]),
            leave_out=not settings.keep_everything,
            timer=self.timer,
        )
        cameras = fit_cameras(cameras, settings)
        whole = self._rasterizer(scene, "cpu" if rasterizer in ("auto", "cached") else rasterizer)
        self.plan = make_plan(scene, cameras, settings, self.loss, whole, self.memory)
        self.scene = scene
        seen = scene if settings.keep_everything else scene.subset(self.plan.seen)
        self.views = Views(
            seen,
            cameras,
            self._rasterizer(seen, "cpu" if settings.keep_everything and rasterizer == "auto" else rasterizer),
            self.loss,
            covered=self.plan.survey.covered,
            weighted=self.plan.weighted,
            photos=photos,
            memory=int(self.memory * MEMORY_SHARES["views"]),
        )
        self._style = style
        self._style_targets: dict[tuple[int, int], dict[int, dict[str, LayerTarget]]] = {}
        self.sh_dc = seen.sh_dc.clone().to(self.views.rasterizer.device).requires_grad_()
        self._adam = torch.optim.Adam([self.sh_dc], lr=settings.learning_rate, eps=ADAM_EPS)
        self._generator = torch.Generator().manual_seed(settings.seed)
        self._queue: list[int] = []
        self.steps_coarse = self.plan.steps_coarse
        self.total = self.steps_coarse + settings.steps_sos

    def _network(self, weights: BackboneWeights) -> FeatureNetwork:
        layers = (*STYLE_LAYERS, CONTENT_LAYER) if self.settings.content_weight else STYLE_LAYERS
        device = "cuda" if torch.cuda.is_available() else "cpu"
        return FeatureNetwork(weights, layers, getattr(torch, self.settings.precision), device)

    def _rasterizer(self, scene: Scene, name: str) -> Rasterizer:
        """The rasterizer of a name; "auto" is gsplat on a GPU that has it, else kept blend weights as memory allows."""
        options: dict[str, Any] = {"background": self.settings.background, "near": self.settings.near}
        if name == "auto":
            gsplat = self.network.device.type == "cuda" and importlib.util.find_spec("gsplat") is not None
            name = "cuda" if gsplat else "cached"
        if name == "cached":
            options |= {"device": self.network.device, "max_bytes": int(self.memory * MEMORY_SHARES["rasterizer"])}
        return make_rasterizer(name, scene, **options)

    @property
    def stage(self) -> Stage:
        """The phase that the next step belongs to."""
        return "coarse" if self.step < self.steps_coarse else "sos"

    def style_targets(self, camera: Camera) -> dict[int, dict[str, LayerTarget]]:
        """The style's statistics for views of the camera's size."""
        size = (camera.height, camera.width)
        if size not in self._style_targets:
            self._style_targets[size] = self.loss.style_targets(self._style.to(self.network.device), size)
        return self._style_targets[size]

    def run_step(self) -> StepRecord:
        """One iteration.

        Raises:
            DivergedError: the gradient has left the range of float32; the colours are those before the step.
        """
        started = time.perf_counter()
        self.timer.seconds.clear()
        index = self._next_view()
        with self.timer("prepare"):
            target = self.views.target(index)
            style = self.style_targets(self.views.cameras[index])
        stage = self.stage
        camera = self.views.cameras[index]
        scales = [scale_count(camera.height, camera.width) - 1] if stage == "coarse" else None
        with self.timer("render"), torch.no_grad():
            colours = self.views.colours(index, self.sh_dc.detach())
            image = self.views.render(index, colours)
        with self.timer("loss"):
            result = self.loss.evaluate(image, style, target, scales)
        with self.timer("raster_backward"):
            assert result.image_gradient is not None
            gradient = self.views.gradient(index, result.image_gradient.to(image.device), colours)
        with self.timer("optimiser"):
            self._update(gradient)
        self.step += 1
        self.seconds += time.perf_counter() - started
        for name, seconds in self.timer.seconds.items():
            self.seconds_by_part[name] = self.seconds_by_part.get(name, 0.0) + seconds
        record = StepRecord(self.step, stage, index, self.seconds, result.loss, result.terms)
        self.history.append(record)
        return record

    def _update(self, gradient: Tensor) -> None:
        largest = float(gradient.abs().max())
        if not largest <= LARGEST_GRADIENT:
            raise DivergedError(
                f"Step {self.step + 1}: the colour gradient has grown to {largest:.3g}, which cannot be optimised; the "
                f"largest colour coefficient is {float(self.sh_dc.detach().abs().max()):.3g}. Give a smaller "
                f"--learning-rate than {self.settings.learning_rate:g}, or look for extreme coefficients with `sgsst "
                "check`."
            )
        for group in self._adam.param_groups:
            group["lr"] = self.settings.learning_rate_at(self.step / max(self.total - 1, 1))
        self.sh_dc.grad = gradient.to(self.sh_dc.dtype)
        self._adam.step()

    def _next_view(self) -> int:
        """Random views without replacement: every view once before any comes again."""
        if not self._queue:
            covered = self.views.covered
            self._queue = [covered[i] for i in torch.randperm(len(covered), generator=self._generator).tolist()]
        return self._queue.pop()

    def evaluate(self, indices: Sequence[int]) -> dict[int, LossTerms]:
        """Mean SOS loss over views, split by scale; changes nothing, its time does not count."""
        total: dict[int, LossTerms] = {}
        for index in indices:
            with torch.no_grad():
                image = self.views.render(index, self.views.colours(index, self.sh_dc.detach()))
            style = self.style_targets(self.views.cameras[index])
            terms = self.loss.evaluate(image, style, self.views.target(index), gradient=False).terms
            for scale, part in terms.items():
                total[scale] = total.get(scale, LossTerms()) + part
        return {scale: terms.divided(len(indices)) for scale, terms in total.items()}

    def stylized(self) -> Tensor:
        """sh_dc [N, 3] float32 of the whole scene, on the CPU: the optimised colours, and those of unseen Gaussians."""
        result = self.scene.sh_dc.clone()
        result[self.plan.seen] = self.sh_dc.detach().cpu()
        if self.settings.unseen == "neighbours":
            weights = self.plan.survey.total_weights
            result[weights <= 0] += neighbours_change(self.scene.means, result - self.scene.sh_dc, weights)
        return result

    def set_colours(self, sh_dc: Tensor) -> None:
        """Put the colours [N, 3] of the whole scene in place of the present ones, to evaluate them on these views."""
        with torch.no_grad():
            self.sh_dc.copy_(sh_dc[self.plan.seen])

    def state(self) -> StylizerState:
        """A copy of all that a resumed run needs."""
        adam = self._adam.state.get(self.sh_dc, {})
        empty = torch.zeros_like(self.sh_dc)
        return StylizerState(
            sh_dc=self.sh_dc.detach().cpu().clone(),
            first_moment=adam.get("exp_avg", empty).detach().cpu().clone(),
            second_moment=adam.get("exp_avg_sq", empty).detach().cpu().clone(),
            step=self.step,
            seconds=self.seconds,
            generator=self._generator.get_state().clone(),
            queue=list(self._queue),
            history=list(self.history),
            seconds_by_part=dict(self.seconds_by_part),
            memory=self.memory,
        )

    def load_state(self, state: StylizerState) -> None:
        """Go on from a state of a stylizer with the same arguments, and state.memory as its memory limit."""
        with torch.no_grad():
            self.sh_dc.copy_(state.sh_dc)
        if state.step:
            self._adam.state[self.sh_dc] = {
                "step": torch.tensor(float(state.step)),
                "exp_avg": state.first_moment.to(self.sh_dc.device).clone(),
                "exp_avg_sq": state.second_moment.to(self.sh_dc.device).clone(),
            }
        self.step = state.step
        self.seconds = state.seconds
        self._generator.set_state(state.generator)
        self._queue = list(state.queue)
        self.history = list(state.history)
        self.seconds_by_part = dict(state.seconds_by_part)


def fit_cameras(cameras: Sequence[Camera], settings: Settings) -> list[Camera]:
    """The cameras, those with more pixels than `settings.max_resolution` on their longer side brought down to it."""
    limit = settings.max_resolution
    return [
        resized(camera, limit) if limit and max(camera.width, camera.height) > limit else camera for camera in cameras
    ]


def run(stylizer: Stylizer, callbacks: Callbacks | None = None) -> Stopped:
    """Iterate to the end of the schedule, to the time budget, or until `callbacks.stop` says so."""
    callbacks = callbacks or Callbacks()
    started, before = time.perf_counter(), stylizer.step
    last_checkpoint = last_preview = started
    while stylizer.step < stylizer.total:
        if callbacks.stop and callbacks.stop():
            return _end_early(stylizer, callbacks, "interrupted")
        if stylizer.settings.max_seconds and stylizer.seconds >= stylizer.settings.max_seconds:
            return _end_early(stylizer, callbacks, "max-seconds")
        record = stylizer.run_step()
        now = time.perf_counter()
        if callbacks.progress:
            per_step = (now - started) / (stylizer.step - before)
            left = per_step * (stylizer.total - stylizer.step)
            if stylizer.settings.max_seconds:
                left = min(left, max(stylizer.settings.max_seconds - stylizer.seconds, 0.0))
            callbacks.progress(Progress(record.stage, record.step, stylizer.total, record.loss, stylizer.seconds, left))
        if callbacks.checkpoint and now - last_checkpoint >= callbacks.checkpoint_seconds:
            callbacks.checkpoint(stylizer)
            last_checkpoint = time.perf_counter()
        if callbacks.preview and now - last_preview >= callbacks.preview_seconds:
            callbacks.preview(stylizer)
            last_preview = time.perf_counter()
    return "finished"


def _end_early(stylizer: Stylizer, callbacks: Callbacks, reason: Stopped) -> Stopped:
    if callbacks.checkpoint:
        callbacks.checkpoint(stylizer)
    return reason


def stylize(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Tensor,
    settings: Settings,
    *,
    weights: BackboneWeights | None = None,
    photos: PhotoLoader | None = None,
    callbacks: Callbacks | None = None,
) -> Tensor:
    """Stylize a scene from beginning to end; the arguments are those of `Stylizer`.

    Returns:
        The new sh_dc [N, 3], float32 on the CPU. Everything else of the scene stays as it is.
    """
    stylizer = Stylizer(scene, cameras, style, settings, weights=weights, photos=photos)
    run(stylizer, callbacks)
    return stylizer.stylized()
