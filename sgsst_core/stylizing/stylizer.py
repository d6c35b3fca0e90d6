"""Stylizer: Adam on the DC colors, in a coarse phase followed by a phase on all scales.

Each call of `Stylizer.run_step` makes one step; `loop.run` makes all steps. On a GPU, it reads the losses of a step
after it has queued the next one, so that the GPU does not wait for the host.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
import psutil
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.budget import device_peak
from sgsst_core.errors import DivergedError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.files.images import Color
from sgsst_core.loss.sos import SosResult
from sgsst_core.parallel.collectives import ALONE, Collectives, Traffic
from sgsst_core.planning.survey import ShowPlanning
from sgsst_core.planning.time_budget import SecondsLeft
from sgsst_core.regions.definition import Regions
from sgsst_core.scene.camera import Camera, checked_cameras
from sgsst_core.scene.gaussians import Scene, checked_scene
from sgsst_core.settings import Settings
from sgsst_core.style import Style, image_of
from sgsst_core.stylizing.evaluation import (
    Evaluation,
    ShowViews,
    completed,
    evaluate,
    mean_evaluation,
    mean_loss,
    show_nothing,
)
from sgsst_core.stylizing.job import StylizationJob, in_bfloat16, with_second_attempt
from sgsst_core.stylizing.optimizer import ColorOptimizer, is_too_large
from sgsst_core.stylizing.photo_prefetch import PhotoLoader
from sgsst_core.stylizing.planner import choose_within, plan_job
from sgsst_core.stylizing.refining import refine, refined
from sgsst_core.stylizing.result_colors import result_colors, transferred_colors
from sgsst_core.stylizing.schedule import (
    BEFORE_STEPS,
    Phase,
    StepRecord,
    StylizerState,
    ViewOrder,
    drawn_scales,
    drawn_views,
    phase_at,
)
from sgsst_core.stylizing.training_background import drawn_color
from sgsst_core.timing import Timer, seconds_left


@dataclass(frozen=True)
class _QueuedStep:
    """Step whose work is queued on the device, and whose losses have yet to be read.

    Attributes:
        results: Results of this group's views, without gradients.
        pixels: Pixels that this rank passes through the network.
        values: Largest magnitude in the gradient, then the values of the results; in host memory, valid after `copied`.
        copied: Event after the copy of `values`; None if there is nothing to wait for.
        sent: Bytes that had been sent before the step.
    """

    step: int
    phase: Phase
    views: list[int]
    results: list[SosResult]
    pixels: int
    values: Tensor
    copied: torch.cuda.Event | None
    timer: Timer
    sent: dict[Traffic, int]

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
        measured: Measurements before and after the steps, JSON-serializable.
    """

    def __init__(self, job: StylizationJob) -> None:
        self.job = job
        self.step = 0
        self.seconds = 0.0
        self.seconds_by_part: dict[str, float] = {}
        self.history: list[StepRecord] = []
        self.measured: list[dict[str, Any]] = []
        self.latest: list[int] = []
        settings, views, seen = job.settings, job.views, job.plan.seen
        device = views.rasterizer.device
        # Computed once, because another processor may round differently and ranks must start with the same bits.
        warm = job.plan.warm_start
        start = job.collectives.broadcast(lambda: transferred_colors(job)) if warm else views.scene.sh_dc
        self.sh_dc = start.clone().to(device)
        frozen = job.regions.frozen[seen] if job.regions else torch.zeros(0, dtype=torch.bool)
        #: Mask [n, 1] of frozen Gaussians; None if there are none.
        self._frozen = frozen.to(device)[:, None] if frozen.any() else None
        subspace = job.collectives.broadcast(lambda: job.styles.color_subspace(settings))
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
        style, regions = Style.given(style), regions and regions.with_checked_styles()
        scene, cameras = checked_scene(scene), checked_cameras(cameras)
        weights = weights or load_network_weights("auto")
        left = left or seconds_left(settings.within)
        chosen = left and choose_within(
            scene, cameras, settings, left, weights=weights, rasterizer=rasterizer, collectives=collectives
        )
        views = chosen.views if chosen else range(len(cameras))
        cameras = [cameras[index] for index in views]
        applied = chosen.applied(settings) if chosen else settings
        refinement = refine(
            scene, cameras, style, applied, weights=weights, rasterizer=rasterizer, collectives=collectives,
            regions=regions, show=show,
        )  # fmt: skip
        job = plan_job(
            refined(scene, refinement),
            cameras,
            style,
            settings,
            photos=photos and (lambda index: image_of(photos(views[index]), f"photo of view {views[index]}")),
            regions=regions and regions.refined(refinement),
            refinement=refinement,
            weights=weights,
            rasterizer=rasterizer,
            collectives=collectives,
            show=show,
            chosen=chosen,
        )
        return cls(job)

    @property
    def phase(self) -> Phase:
        """Phase of the next step; the last phase if all steps are done."""
        return phase_at(self.job.schedule, self.step)

    def start(self, show: ShowViews = show_nothing) -> Evaluation:
        """Return the loss of the unstylized scene on the evaluation views; evaluated once, at the first call."""
        if self._start is None:
            with self.measuring():
                self._start = self.evaluate(self.job.evaluation_views, self.job.views.scene.sh_dc, show)
        return self._start

    @contextmanager
    def measuring(self) -> Iterator[None]:
        """Record the time of a `with` block as measuring, separately from the steps."""
        started, parts = time.perf_counter(), self.seconds_by_part
        yield
        parts["measuring"] = parts.get("measuring", 0.0) + time.perf_counter() - started

    def drawn_background(self, index: int) -> Color | None:
        """Return the background color of a view in the next step; None for the background of the settings."""
        return drawn_color(self.job.plan.training_background, self.job.settings.seed, self.step, index, self.job.style)

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
        self.job.timer.clear()
        self._cache_visited()
        sent = dict(self.job.collectives.sent)
        phase = self.phase
        self.latest = views = [self._order.next_view() for _ in range(self.job.settings.views_per_step)]
        before = self._queued
        self._queue(views, phase, sent)
        if self.job.plan.precision == "float16" and self._queued is not None and is_too_large(self._queued.largest()):
            self.job = in_bfloat16(self.job, self.step + 1)  # colors and moments are unchanged
            self._queue(views, phase, sent)
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
        every = self.job.collectives.sent
        record = StepRecord(
            step=queued.step,
            stage=queued.phase.stage,
            view=view,
            seconds=self.seconds,
            loss=mean_loss(terms, self.job.loss.weights),
            terms=terms,
            parts=parts,
            memory=psutil.Process().memory_info().rss,
            sent={kind: total - queued.sent[kind] for kind, total in every.items() if total > queued.sent[kind]},
            device_memory=device_peak(self.job.network.device),
            evaluated=tuple(evaluated),
            pixels=queued.pixels,
        )
        self.history.append(record)

    def _queue(self, views: list[int], phase: Phase, sent: dict[Traffic, int]) -> None:
        """Queue a step."""
        gradient, results, pixels = with_second_attempt(self.job, lambda: self._mean_gradient(views, phase))
        with self.job.timer("optimizer"):
            done = self.step / max(self.job.total_steps - 1, 1)
            # In float32, so that the rate does not depend on the number of steps by rounding (`Settings.with_steps`).
            rate = self.job.settings.learning_rate
            if self.job.settings.learning_rate_end != rate:
                rate = float(np.float32(self.job.settings.learning_rate_at(done)))
            largest = self._optimizer.update(gradient, rate)
        with self.job.timer("communication"):
            self.job.team.check_drift(self.step + 1, self.sh_dc)
        values, copied = self._copied(largest, results)
        results = [replace(result, image_gradient=None) for result in results]  # frees the gradients
        timer = self.job.timer.lap()
        self._queued = _QueuedStep(self.step + 1, phase, views, results, pixels, values, copied, timer, sent)

    def _mean_gradient(self, views: list[int], phase: Phase) -> tuple[Tensor, list[SosResult], int]:
        """Return the mean of dE/dsh_dc [n, 3] over some views, the results of this group's own views, and a cost.

        The cost is the number of pixels that this rank passes through the network.
        """
        gradient: Tensor | None = None
        results = []
        cost = 0
        own_views = views[self.job.team.own_group :: self.job.team.groups]
        for position, index in enumerate(own_views):
            scales = self._scales(index, phase, self.step, views[0])
            background = self.drawn_background(index)
            with self.job.timer("prepare", whole=True):
                self.job.views.cache_weights(index)
                target = self.job.view_targets.target(index, list(scales), background)
                self._prefetch(own_views[position + 1 :], phase)
                style = self.job.style_targets(self.job.views.cameras[index])
            assert target.division is not None
            cost += target.division.cost(self.job.group.rank, self.job.network.halo)
            own, result = self.job.gradient(index, self.sh_dc.detach(), style, target, scales, background)
            gradient = own if gradient is None else gradient.add_(own)
            results.append(result)
        assert gradient is not None
        if len(views) > 1:
            if self.job.team.groups > 1:  # all ranks of a group have the same gradient: count it once
                with self.job.timer("communication"):
                    gradient = self.job.collectives.all_reduce(gradient / self.job.group.size)
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
                every = self.job.collectives.all_gather(evaluations)[:: self.job.group.size]
            evaluations = [terms for part in every for terms in part]
        return mean_evaluation(evaluations)

    def _prefetch(self, left: Sequence[int], phase: Phase) -> None:
        """Announce the view that this group processes next, so that its data can be read while the device works.

        The queue is only inspected, not refilled: a new round is drawn only when it is needed, because checkpoints
        contain the queue and the random state.

        Args:
            left: Remaining views of this group in the present step.
        """
        if left:
            index = left[0]
        elif self.step + 1 < self.job.total_steps and len(self._order.left) > self.job.team.own_group:
            index, phase = self._order.left[-1 - self.job.team.own_group], phase_at(self.job.schedule, self.step + 1)
        else:
            return
        step, first = (self.step, self.latest[0]) if left else (self.step + 1, self._order.left[-1])
        self.job.view_targets.prefetch(index, list(self._scales(index, phase, step, first)))

    def _scales(self, index: int, phase: Phase, step: int, first: int) -> Sequence[int] | Mapping[int, float]:
        """Return the scales of a view that a step evaluates, finest first; with their weights if they are drawn.

        Args:
            step: Number of steps before this one.
            first: First view of the step, whose draw applies to all of them, so that no group of ranks waits.
        """
        chosen, settings = phase.scales(self.job.scales(index)), self.job.settings
        period = settings.scale_sampling
        if period == 1 or len(chosen) == 1:
            return chosen
        visit = step * settings.views_per_step // len(self.job.views.covered)
        drawn = drawn_scales(chosen, period, settings.seed, first, visit)
        return self.job.loss.weights.sampled(chosen, drawn, period)

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

    def gradient(self, index: int, scales: Sequence[int]) -> tuple[Tensor, float]:
        """Return dE/dsh_dc [n, 3] of the rendered Gaussians on the CPU, as a step computes it, and its time in seconds.

        Targets are prepared before timing starts. This does not affect steps.
        """
        self._cache_visited()
        target, style = (
            self.job.view_targets.target(index, scales),
            self.job.style_targets(self.job.views.cameras[index]),
        )
        with self.job.views.temporary_weights(index):
            started = time.perf_counter()
            gradient = self.job.gradient(index, self.sh_dc.detach(), style, target, scales)[0]
            return gradient.cpu(), time.perf_counter() - started

    def _cache_visited(self) -> None:
        """Cache, once after a resume, the blend weights that previous steps cached.

        The order is the same, so that the same views fit.
        """
        steps, self._visited_before = self._visited_before, 0
        if not steps:
            return
        order = drawn_views(self.job.views.covered, self.job.settings.seed)
        with self.job.timer("prepare"):
            for _ in range(steps):
                views = [next(order) for _ in range(self.job.settings.views_per_step)]
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

    def set_colors(self, sh_dc: Tensor) -> None:
        """Replace the present colors with sh_dc [N, 3] of the whole scene, for example to evaluate them."""
        self._stylized = None
        with torch.no_grad():
            self.sh_dc.copy_(sh_dc[self.job.plan.seen])

    @contextmanager
    def with_colors(self, sh_dc: Tensor) -> Iterator[None]:
        """Use sh_dc [N, 3] of the whole scene inside a `with` block, then restore the present colors exactly."""
        present, stylized = self.sh_dc.detach().clone(), self._stylized
        self.set_colors(sh_dc)
        try:
            yield
        finally:
            self._stylized = stylized
            with torch.no_grad():
                self.sh_dc.copy_(present)

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
            measured=list(self.measured),
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
        self.measured = list(state.measured)
        self._visited_before = state.step
