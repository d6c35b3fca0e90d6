"""Stylizer: Adam on the DC colors, in a coarse phase followed by a phase on all scales.

Each call of `Stylizer.run_step` makes one step; `loop.run` makes all steps. On a GPU, it reads the losses of a step
after it has queued the next one, so that the GPU does not wait for the host.
"""

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
import psutil
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.adam import adam

from sgsst_core.budget import device_peak
from sgsst_core.devices import Timer, seconds_left
from sgsst_core.errors import DivergedError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.files.images import Color
from sgsst_core.loss.sos import SosResult
from sgsst_core.loss.terms import LossTerms, StyleTargets
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.planning.survey import ShowPlanning
from sgsst_core.planning.time_budget import SecondsLeft
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.regions import Regions
from sgsst_core.scales import EVEN, ScaleWeights, ratio, smoothed
from sgsst_core.scene.camera import Camera, checked_cameras
from sgsst_core.scene.colors import ColorSubspace, color_subspace_of
from sgsst_core.scene.gaussians import Scene, checked_scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import Settings
from sgsst_core.style import Style, image_of
from sgsst_core.stylizing.job import (
    JobInputs,
    Phase,
    StylizationJob,
    choose_within,
    in_bfloat16,
    plan_job,
    with_second_attempt,
)
from sgsst_core.stylizing.refining import refine
from sgsst_core.stylizing.styles import JobStyles, constrained, neighbors_change
from sgsst_core.stylizing.views import PhotoLoader, ViewTargets, drawn_color

#: Adam's epsilon: practically zero, so that Gaussians of any blend weight move at the learning rate (SGSST).
ADAM_EPS = 1e-15
#: Decay rates of the first and second moment, the usual ones.
_BETA1, _BETA2 = 0.9, 0.999
#: Adam squares gradients in float32. Beyond this limit the square is infinite, and the value would silently stop
#: moving.
LARGEST_GRADIENT = 1e19


class ColorOptimizer:
    """Adam (Kingma and Ba 2015) for a single tensor of colors.

    On a GPU, a step is one kernel that checks by itself whether the gradient is usable, so the host need not
    synchronize.

    Steps use PyTorch's function `adam`. Its class `Adam` gives the same steps but imports PyTorch's compiler, which
    takes two seconds per process although nothing is compiled here.

    Args:
        colors: [n, 3] float32, updated in place.
        unit: Unit of the features behind the gradients (`FeatureNetwork.unit`). Adam's steps do not depend on it, but
            gradients grow with its square and would overflow earlier.
        chroma_of: [n, 3], colors whose chroma is preserved: the optimized quantity is then each color's difference from
            them in luminance. None to let colors change freely.
        subspace: Color subspace that colors stay in; None to let them change freely.
        bounded: Whether to project colors to 0..1 after each step (`on_screen`).
        frozen: [n, 1] bool, frozen colors, whose gradients are 0; None if there are none.
    """

    def __init__(
        self,
        colors: Tensor,
        unit: float = 1.0,
        chroma_of: Tensor | None = None,
        subspace: ColorSubspace | None = None,
        *,
        bounded: bool = False,
        frozen: Tensor | None = None,
    ) -> None:
        self._chroma_of, self._subspace = chroma_of, subspace
        self._bounded, self._frozen = bounded, frozen
        self._colors = colors.requires_grad_()
        self._unit = unit
        self._fused = colors.is_cuda
        self._first, self._second = (torch.zeros_like(colors, requires_grad=False) for _ in range(2))
        self._steps = torch.zeros((), dtype=torch.float32, device=colors.device if self._fused else None)

    def update(self, gradient: Tensor, learning_rate: float) -> Tensor:
        """Make one step, or skip it if the gradient [n, 3] is not finite or exceeds `LARGEST_GRADIENT`.

        Returns:
            Largest magnitude in the gradient, in units of a 0-255 input: a scalar on the colors' device. The caller
                checks whether it was too large when it next synchronizes with the device.
        """
        if self._unit != 1:
            gradient = gradient / self._unit**2
        if self._chroma_of is not None:
            # The derivative with respect to a value added to all three channels. Adam's steps are then the same in each
            # channel.
            gradient = gradient.sum(dim=1, keepdim=True).expand(-1, 3).contiguous()
        if self._subspace is not None:
            # Adam scales each channel separately. Without the projection, its steps could ascend within the subspace.
            gradient = self._subspace.along(gradient)
        largest = gradient.abs().amax()
        self._colors.grad = gradient.to(self._colors.dtype)
        if self._fused:
            # PyTorch's flag for an unusable gradient in a fused step, intended for scaled half precision.
            self._step(learning_rate, torch.logical_not(largest <= LARGEST_GRADIENT).float())
        elif not is_too_large(float(largest)):
            self._step(learning_rate)
        else:
            return largest
        if self._bounded or self._chroma_of is not None or self._subspace is not None:
            with torch.no_grad():
                projected = constrained(self._colors, self._chroma_of, self._subspace, bounded=self._bounded)
                unchanged = ~(largest <= LARGEST_GRADIENT)  # the step was skipped
                if self._frozen is not None:
                    unchanged = unchanged | self._frozen
                self._colors.copy_(torch.where(unchanged, self._colors, projected))
        return largest

    @torch.no_grad()
    def _step(self, learning_rate: float, found_inf: Tensor | None = None) -> None:
        """Make a step, unless `found_inf` is non-zero."""
        assert self._colors.grad is not None
        adam(
            [self._colors],
            [self._colors.grad],
            [self._first],
            [self._second],
            [],
            [self._steps],
            fused=self._fused,
            found_inf=found_inf,
            amsgrad=False,
            beta1=_BETA1,
            beta2=_BETA2,
            lr=learning_rate,
            weight_decay=0.0,
            eps=ADAM_EPS,
            maximize=False,
        )

    def moments(self) -> tuple[Tensor, Tensor]:
        """Return the first and second moment [n, 3] on the CPU; zeros before the first step."""
        return self._first.cpu().clone(), self._second.cpu().clone()

    def load_moments(self, step: int, first: Tensor, second: Tensor) -> None:
        """Restore the moments [n, 3] after a number of steps, at least one."""
        self._steps.fill_(step)
        self._first.copy_(first)
        self._second.copy_(second)


def is_too_large(largest: float) -> bool:
    """Return whether a gradient with this largest magnitude (possibly NaN) is unusable."""
    return not largest <= LARGEST_GRADIENT


def transferred_colors(job: StylizationJob, colors: Tensor | None = None) -> Tensor:
    """Transfer the style's colors to the rendered Gaussians; see `warm_start`.

    Args:
        colors: [n, 3] on the CPU, colors before the transfer; None for the scene's, as before the first step.

    Returns:
        [n, 3] on the CPU.
    """
    seen = job.plan.seen
    colors = job.scene.sh_dc[seen] if colors is None else colors
    weights = job.plan.survey.total_blend_weights[seen]
    transferred = job.styles.transferred(colors, weights, seen, preserve_chroma=job.preserves_chroma)
    # `result_colors` derives colors that no view determines from those of their neighbors.
    return torch.where(job.plan.optimized[seen][:, None], transferred, colors)


def result_colors(job: StylizationJob, optimized: Tensor, *, transfer: bool) -> Tensor:
    """Return the colors of the whole scene, in which unseen Gaussians follow their neighbors if the settings say so.

    Args:
        optimized: [n, 3] on the CPU, colors of the rendered Gaussians.
        transfer: Whether to transfer the style's colors to `optimized`.

    Returns:
        [N, 3] float32 on the CPU.
    """
    colors, subspace = job.scene.sh_dc.clone(), color_subspace_of(job.styles.all, job.settings)
    colors[job.plan.seen] = optimized
    if transfer:
        transferred = transferred_colors(job, optimized)
        chroma_of = job.scene.sh_dc[job.plan.seen] if job.preserves_chroma else None
        bounded = constrained(transferred, chroma_of, subspace, bounded=job.settings.bounded)
        # Frozen colors remain bit-identical.
        colors[job.plan.seen] = torch.where(transferred != optimized, bounded, optimized)
    if job.settings.unseen != "neighbors":
        return colors
    weights = torch.where(job.plan.optimized, job.plan.survey.total_blend_weights, 0.0)
    free = torch.ones_like(job.plan.seen) if job.styles.regions is None else ~job.styles.regions.frozen
    unseen = (weights <= 0) & free
    change = neighbors_change(job.scene.means[free], (colors - job.scene.sh_dc)[free], weights[free])
    change = change.mean(dim=1, keepdim=True) if job.preserves_chroma else change
    original = job.scene.sh_dc[unseen]
    chroma_of = original if job.preserves_chroma else None
    colors[unseen] = constrained(original + change, chroma_of, subspace, bounded=job.settings.bounded)
    return colors


def render_first_view(
    scene: Scene, camera: Camera, style: Style, settings: Settings, regions: Regions | None = None
) -> Tensor | None:
    """Render a view with the colors of a warm start whose weights are those of this view alone.

    For a job with this one view, these are the colors of its warm start. It runs on the CPU and shares nothing with the
    job, whose measurements it must not change.

    Returns:
        Image [H, W, 3]; None if the view shows nothing that may change.
    """
    scene = scene.attenuated(settings.sh_attenuation)
    rasterizer = make_rasterizer("cpu", scene, background=settings.background, near=settings.near)
    weights = rasterizer.survey(camera)[1].double()
    if regions is not None:
        weights[regions.frozen] = 0
    rows = weights > 0
    if not bool(rows.any()):
        return None
    styles = JobStyles.prepared(style, regions and regions.resolved(weights), settings, scene.sh_dc, weights)
    colors, by_luminance = scene.sh_dc.clone(), settings.preserve_colors == "luminance"
    colors[rows] = styles.transferred(colors[rows], weights[rows], rows, preserve_chroma=by_luminance)
    return rasterizer.render(scene_colors(replace(scene, sh_dc=colors), camera), camera)


# --- steps and their losses ----------------------------------------------------------------------------------------

#: Parts of a job's time before its first step, as named in `seconds_by_part`: start of the program, inputs, refinement,
#: survey, the rest of planning, and preparation of the steps.
BEFORE_STEPS = ("start", "reading", "refining", "survey", "planning", "preparing")


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
    result: Evaluation = {}
    for scale in dict.fromkeys(scale for evaluation in evaluations for scale in evaluation):
        parts = [evaluation[scale] for evaluation in evaluations if scale in evaluation]
        result[scale] = sum(parts, LossTerms()) / len(parts)
    return result


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


# --- stylizer ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _QueuedStep:
    """Step whose work is queued on the device, and whose losses have yet to be read.

    Attributes:
        results: Results of this group's views, without gradients.
        pixels: Pixels that this rank passes through the network.
        values: Largest magnitude in the gradient, then the values of the results; in host memory, valid after `copied`.
        copied: Event after the copy of `values`; None if there is nothing to wait for.
    """

    step: int
    phase: Phase
    views: list[int]
    results: list[SosResult]
    pixels: int
    values: Tensor
    copied: torch.cuda.Event | None
    timer: Timer

    def largest(self) -> float:
        """Wait for the device, and return the largest magnitude in the gradient."""
        if self.copied is not None:
            self.copied.synchronize()
        return float(self.values[0])


class Stylizer:
    """Optimization of the colors of one scene, step by step.

    Args:
        job: Job of the scene, from `plan_job` or `prepare_job`. Every rank has a stylizer of the same job and calls the
            same methods in the same order. Methods that only read, such as `state` and `stylized`, may be called by a
            single rank.

    Attributes:
        sh_dc: [n, 3], present colors of the rendered Gaussians, on the rasterizer's device.
        measured: Fields `novel_views` and `approximations` of the report; None where nothing was measured.
    """

    def __init__(self, job: StylizationJob) -> None:
        self.job = job
        self.step = 0
        self.seconds = 0.0
        self.seconds_by_part: dict[str, float] = {}
        self.history: list[StepRecord] = []
        self.measured: dict[str, Any] = {"novel_views": None, "approximations": None}
        settings, views, seen = job.settings, job.views, job.plan.seen
        device = views.rasterizer.device
        # Computed once, because another processor may round differently and ranks must start with the same bits.
        warm = job.plan.warm_start
        start = job.collectives.broadcast(lambda: transferred_colors(job)) if warm else views.scene.sh_dc
        self.sh_dc = start.clone().to(device)
        frozen = job.styles.regions.frozen[seen] if job.styles.regions else torch.zeros(0, dtype=torch.bool)
        #: Mask [n, 1] of frozen Gaussians; None if there are none.
        self._frozen = frozen.to(device)[:, None] if frozen.any() else None
        subspace = job.collectives.broadcast(lambda: color_subspace_of(job.styles.all, settings))
        self._optimizer = ColorOptimizer(
            self.sh_dc,
            job.network.unit,
            views.scene.sh_dc.to(device) if job.preserves_chroma else None,
            subspace and subspace.to(device),
            bounded=settings.bounded,
            frozen=self._frozen,
        )
        self._order = ViewOrder(views.covered, settings.seed)
        #: Number of steps before a resume whose blend weights have yet to be cached again.
        self._visited_before = 0
        self._queued: _QueuedStep | None = None
        self._start: Evaluation | None = None
        self._stylized: Tensor | None = None

    @classmethod
    def planned(
        cls,
        scene: Scene,
        cameras: Sequence[Camera],
        style: Tensor | NDArray[Any] | Style,
        settings: Settings,
        *,
        weights: BackboneWeights | None = None,
        photos: PhotoLoader | None = None,
        rasterizer: str | None = None,
        collectives: Collectives = ALONE,
        regions: Regions | None = None,
        show: ShowPlanning | None = None,
        left: SecondsLeft | None = None,
    ) -> Self:
        """Check the inputs, refine the scene if the settings request it, plan the job, and create its stylizer.

        The arguments are those of `plan_job`. The job contains the refined scene. A time budget of the settings counts
        from this call unless `left` is given.

        Example:
            >>> scene, cameras = load_scene("scene.ply").scene, load_cameras("cameras.json")
            >>> settings = make_settings("preview", steps_sos=2)
            >>> stylizer = Stylizer.planned(scene, cameras, load_image("style.png"), settings)
            >>> stylizer.job.total_steps
            2
        """
        inputs = JobInputs(
            checked_scene(scene), checked_cameras(cameras), Style.given(style), settings,
            weights or load_network_weights("auto"), regions=regions and regions.with_checked_styles(),
            rasterizer=rasterizer,
        )  # fmt: skip
        left = left or seconds_left(settings.within)
        chosen = left and choose_within(inputs, left, collectives)
        views = chosen.views if chosen else range(len(cameras))
        inputs = replace(
            inputs,
            cameras=[inputs.cameras[index] for index in views],
            photos=photos and (lambda index: image_of(photos(views[index]), f"photo of view {views[index]}")),
            chosen=chosen,
        )
        inputs = inputs.refined(refine(inputs, collectives=collectives, show=show))
        job = plan_job(inputs, collectives=collectives, show=show)
        return cls(job)

    @property
    def phase(self) -> Phase:
        """Phase of the next step; the last phase if all steps are done."""
        coarse, sos = self.job.schedule
        return coarse if self.step < coarse.steps else sos

    def start(self, show: ShowViews = show_nothing) -> Evaluation:
        """Return the loss of the unstylized scene on the evaluation views; evaluated once, at the first call."""
        if self._start is None:
            with self.timed("measuring"):
                self._start = self.evaluate(self.job.evaluation_views, self.job.views.scene.sh_dc, show)
        return self._start

    @contextmanager
    def timed(self, part: str) -> Iterator[None]:
        """Record the time of a `with` block as a part of the job's, separately from the steps."""
        started, parts = time.perf_counter(), self.seconds_by_part
        yield
        parts[part] = parts.get(part, 0.0) + time.perf_counter() - started

    def drawn_background(self, index: int) -> Color | None:
        """Return the background color of a view in the next step; None for the background of the settings."""
        return drawn_color(
            self.job.plan.training_background, self.job.settings.seed, self.step, index, self.job.styles.own
        )

    @property
    def reads_late(self) -> bool:
        """Whether `queue_step` leaves the losses of its step unread.

        Ranks read theirs at once, because they exchange them, and so do jobs that end at a certain loss.
        """
        job = self.job
        return job.network.device.type == "cuda" and job.collectives.size == 1 and not job.settings.target_loss

    def run_step(self) -> StepRecord:
        """Run one iteration, and read its losses.

        Raises:
            DivergedError: If the gradient has left the range of float32; the colors are those before the step.
            DeviceMemoryError: If a GPU's memory is not enough.
        """
        self.queue_step()
        self.read_step()
        return self.history[-1]

    def queue_step(self) -> None:
        """Queue one iteration, then read the losses of the one before; if not `reads_late`, also those of this one.

        Raises as `run_step`, if need be one step late.
        """
        started = time.perf_counter()
        self._stylized = None
        self.job.loss.timer.lap()  # without what was measured between steps
        self._cache_visited()
        phase = self.phase
        views = [self._order.next_view() for _ in range(self.job.settings.views_per_step)]
        before = self._queued
        self._queue(views, phase)
        if self.job.plan.precision == "float16" and self._queued is not None and is_too_large(self._queued.largest()):
            self.job = in_bfloat16(self.job, self.step + 1)  # colors and moments are unchanged
            self._queue(views, phase)
        self.step += 1
        self.seconds += time.perf_counter() - started
        if before is not None:
            self._record(before)
        if not self.reads_late:
            self.read_step()

    def read_step(self) -> None:
        """Wait for the last step, unless its losses have been read."""
        if self._queued is not None:
            queued, self._queued = self._queued, None
            self._record(queued)

    def _record(self, queued: _QueuedStep) -> None:
        """Append the record of a step to the history, when the device has finished it."""
        started = time.perf_counter()
        evaluated, view = self._read(queued), queued.views[0]
        terms = completed(evaluated, queued.phase.scales(self.job.scales(view)), view, self.history)
        parts = queued.timer.read()
        for name, seconds in parts.items():
            self.seconds_by_part[name] = self.seconds_by_part.get(name, 0.0) + seconds
        self.seconds += time.perf_counter() - started
        record = StepRecord(
            step=queued.step,
            stage=queued.phase.stage,
            view=view,
            seconds=self.seconds,
            loss=mean_loss(terms, self.job.loss.weights),
            terms=terms,
            parts=parts,
            memory=psutil.Process().memory_info().rss,
            device_memory=device_peak(self.job.network.device),
            evaluated=tuple(evaluated),
            pixels=queued.pixels,
        )
        self.history.append(record)

    def _queue(self, views: list[int], phase: Phase) -> None:
        """Queue a step."""
        gradient, results, pixels = with_second_attempt(self.job, lambda: self._mean_gradient(views, phase))
        with self.job.loss.timer("optimizer"):
            done = self.step / max(self.job.total_steps - 1, 1)
            # In float32, so that the rate does not depend on the number of steps by rounding (`Settings.with_steps`).
            rate = self.job.settings.learning_rate
            if self.job.settings.learning_rate_end != rate:
                rate = float(np.float32(self.job.settings.learning_rate_at(done)))
            largest = self._optimizer.update(gradient, rate)
        with self.job.loss.timer("communication"):
            self.job.team.check_drift(self.step + 1, self.sh_dc)
        values, copied = self._copied(largest, results)
        results = [replace(result, image_gradient=None) for result in results]  # frees the gradients
        timer = self.job.loss.timer.lap()
        self._queued = _QueuedStep(self.step + 1, phase, views, results, pixels, values, copied, timer)

    def _mean_gradient(self, views: list[int], phase: Phase) -> tuple[Tensor, list[SosResult], int]:
        """Return the mean of dE/dsh_dc [n, 3] over some views, the results of this group's own views, and a cost.

        The cost is the number of pixels that this rank passes through the network.
        """
        gradient: Tensor | None = None
        results = []
        cost = 0
        own_views = views[self.job.team.own_group :: self.job.team.groups]
        for index in own_views:
            scales = self._scales(index, phase, self.step, views[0])
            background = self.drawn_background(index)
            with self.job.loss.timer("prepare", whole=True):
                self.job.views.cache_weights(index)
                target = self.job.view_targets.target(index, list(scales), background)
                style = self.job.style_targets(self.job.views.cameras[index])
            assert target.division is not None
            cost += target.division.cost(self.job.team.group.rank, self.job.network.halo)
            own, result = self.job.gradient(index, self.sh_dc.detach(), style, target, scales, background)
            gradient = own if gradient is None else gradient.add_(own)
            results.append(result)
        assert gradient is not None
        if len(views) > 1:
            if self.job.team.groups > 1:  # all ranks of a group have the same gradient: count it once
                with self.job.loss.timer("communication"):
                    gradient = self.job.collectives.all_reduce(gradient / self.job.team.group.size)
            gradient = gradient / len(views)
        if self._frozen is not None:
            gradient = gradient.masked_fill(self._frozen, 0)  # Adam does not change colors with zero gradient
        return gradient, results, cost

    def _copied(self, largest: Tensor, results: Sequence[SosResult]) -> tuple[Tensor, torch.cuda.Event | None]:
        """Queue the copy of a step's numbers to the host. Return them in a tensor, and the event after the copy."""
        # The rasterizer, and with it the colors, may be on the CPU while the network is on a GPU.
        device = self.job.network.device
        first = largest.double()[None].to(device)
        values = torch.cat([first, *(result.values.flatten() for result in results)])
        if device.type != "cuda":
            return values, None
        values, copied = values.to("cpu", non_blocking=True), torch.cuda.Event()
        copied.record()
        return values, copied

    def _read(self, queued: _QueuedStep) -> Evaluation:
        """Wait for the device, once per step, and return the loss of each scale, mean over the step's views.

        Raises:
            DivergedError: If the gradient was too large for a step.
        """
        magnitude = queued.largest()
        lengths = [result.values.numel() for result in queued.results]
        _, *values = queued.values.split([1, *lengths])
        if is_too_large(magnitude):
            self.step = queued.step - 1
            raise DivergedError(
                f"Step {queued.step}: the color gradient has grown to {magnitude:.3g}, which cannot be "
                f"optimized; the largest color coefficient is {float(self.sh_dc.detach().abs().max()):.3g}. Give a "
                f"smaller --learning-rate than {self.job.settings.learning_rate:g}, or look for extreme coefficients "
                "with `sgsst check`."
            )
        evaluations = [
            replace(result, values=own.view_as(result.values)).terms
            for result, own in zip(queued.results, values, strict=True)
        ]
        if self.job.team.groups > 1:
            with queued.timer("communication"):
                every = self.job.collectives.all_gather(evaluations)[:: self.job.team.group.size]
            evaluations = [terms for part in every for terms in part]
        return mean_evaluation(evaluations)

    def _scales(self, index: int, phase: Phase, step: int, first: int) -> Sequence[int] | Mapping[int, float]:
        """Return the scales of a view that a step evaluates, finest first; with their weights if they are drawn.

        Args:
            step: Number of steps before this one.
            first: First view of the step, whose draw applies to all of them, so that no group of ranks waits.
        """
        chosen, settings = phase.scales(self.job.scales(index)), self.job.settings
        if settings.scale_sampling == 1 or len(chosen) == 1:
            return chosen
        visit = step * settings.views_per_step // len(self.job.views.covered)
        drawn = drawn_scales(chosen, settings.scale_sampling, settings.seed, first, visit)
        return self.job.loss.weights.sampled(chosen, drawn, settings.scale_sampling)

    def evaluate(
        self, indices: Sequence[int], sh_dc: Tensor | None = None, show: ShowViews = show_nothing
    ) -> Evaluation:
        """Return the mean SOS loss over views, split by scale.

        This does not affect steps, and its time is not recorded.

        Args:
            sh_dc: [n, 3], colors of the rendered Gaussians to evaluate; None for the present ones.
        """
        self._cache_visited()
        values = (self.sh_dc.detach() if sh_dc is None else sh_dc).to(self.sh_dc.device)
        job = self.job
        return with_second_attempt(job, lambda: evaluate(job.view_targets, job.style_targets, indices, values, show))

    def gradient(self, index: int, scales: Sequence[int], sh_dc: Tensor | None = None) -> tuple[Tensor, float]:
        """Return dE/dsh_dc [n, 3] of the rendered Gaussians on the CPU, as a step computes it, and its time in seconds.

        Targets are prepared before timing starts. This does not affect steps, and caches no blend weights.

        Args:
            sh_dc: [n, 3], colors of the rendered Gaussians; None for the present ones.
        """
        self._cache_visited()
        values = (self.sh_dc.detach() if sh_dc is None else sh_dc).to(self.sh_dc.device)
        target, style = (
            self.job.view_targets.target(index, scales),
            self.job.style_targets(self.job.views.cameras[index]),
        )
        started = time.perf_counter()
        gradient = self.job.gradient(index, values, style, target, scales)[0].cpu()
        return gradient, time.perf_counter() - started

    def _cache_visited(self) -> None:
        """Cache, once after a resume, the blend weights that previous steps cached.

        The order is the same, so that the same views fit.
        """
        steps, self._visited_before = self._visited_before, 0
        if not steps:
            return
        order = ViewOrder(self.job.views.covered, self.job.settings.seed)
        with self.job.loss.timer("prepare"):
            for _ in range(steps):
                views = [order.next_view() for _ in range(self.job.settings.views_per_step)]
                for index in views[self.job.team.own_group :: self.job.team.groups]:
                    self.job.views.cache_weights(index)

    def stylized(self) -> Tensor:
        """Return sh_dc [N, 3] float32 of the whole scene on the CPU: optimized colors, and colors of unseen Gaussians.

        This is the output of a job that ends now, including the final transfer if there is one. It is cached until the
        colors change, because finding the neighbors of millions of unseen Gaussians takes seconds. It must not be
        modified.
        """
        if self._stylized is None:
            # Before the first step, colors need no transfer, because they already are the style's.
            transfer = self.job.transfers_last and self.step > 0
            self._stylized = result_colors(self.job, self.sh_dc.detach().cpu(), transfer=transfer)
        return self._stylized

    def shown(self) -> Tensor:
        """Return sh_dc [n, 3] of the rendered Gaussians in the output of a job that ends now.

        It is on the rasterizer's device. In contrast to `sh_dc`, from which steps continue, it includes the final
        transfer, if the job has one.
        """
        if not self.job.transfers_last:
            return self.sh_dc.detach()
        return self.stylized()[self.job.plan.seen].to(self.sh_dc.device)

    def state(self) -> StylizerState:
        """Return a copy of everything that a resumed run needs."""
        self.read_step()
        first_moment, second_moment = self._optimizer.moments()
        return StylizerState(
            sh_dc=self.sh_dc.detach().cpu().clone(),
            first_moment=first_moment,
            second_moment=second_moment,
            step=self.step,
            seconds=self.seconds,
            generator=self._order.generator.get_state().clone(),
            queue=list(self._order.left),
            history=list(self.history),
            seconds_by_part=dict(self.seconds_by_part),
            memory=self.job.memory_limit,
        )

    def load_state(self, state: StylizerState) -> None:
        """Resume from the state of a stylizer with the same arguments, and `state.memory` as its memory limit."""
        self._stylized = None
        with torch.no_grad():
            self.sh_dc.copy_(state.sh_dc)
        if state.step:
            self._optimizer.load_moments(state.step, state.first_moment, state.second_moment)
        self.step = state.step
        self.seconds = state.seconds
        self._order.generator.set_state(state.generator)
        self._order.left = list(state.queue)
        self.history = list(state.history)
        own = {name: self.seconds_by_part[name] for name in BEFORE_STEPS if name in self.seconds_by_part}
        earlier = state.seconds_by_part
        self.seconds_by_part = {**earlier, **{name: earlier.get(name, 0.0) + own[name] for name in own}}
        self._visited_before = state.step
