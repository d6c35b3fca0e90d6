"""Stylization of a scene in one call, and its loop: run all steps of a job, and decide when to stop early.

The loop neither prints nor writes files; `Callbacks` display and save results. With several ranks, each rank runs the
loop, and the first rank decides when it stops.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, cast

from numpy.typing import NDArray
from rich.console import Console
from torch import Tensor

from sgsst_core.devices import seconds_left
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.files.library import F, as_scene, stylized
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.planning.time_budget import SecondsLeft, ending_seconds
from sgsst_core.progress import Progress, job_bar
from sgsst_core.scales import has_converged, has_reached, window_length
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.rendering import RenderMode
from sgsst_core.settings import PresetName, make_settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import NETWORK_PARTS, Rates, estimate
from sgsst_core.stylizing.stylizer import Evaluation, Stylizer, mean_loss, round_evaluation, round_loss
from sgsst_core.stylizing.views import PhotoLoader

#: Number of latest steps that the remaining time follows from, and number from which on it does.
_LATEST, _KNOWN = 30, 10
#: Number of steps between two choices of how many remain of a time budget, and number of steps before the first.
_STEERED, _FIRST_STEERED = 5, 4


@dataclass
class Callbacks:
    """Optional callbacks of the loop, called between iterations; give them to the first rank only.

    Attributes:
        progress: Called after the first and the last iteration, and between them about every `progress_seconds`.
        stop: Called before every iteration; True ends the loop as "interrupted".
        finish: Called before every iteration but the first; True ends the loop as "on-request".
        checkpoint: Called with the stylizer about every `checkpoint_seconds`, and once if the loop ends early.
        preview: Called with the stylizer before the first step and about every `preview_seconds`.
        left: Seconds left of the time budget (`Settings.within`), on every rank; None to count it from the start of
            the loop.

    Example:
        >>> steps = []
        >>> callbacks = Callbacks(progress=lambda progress: steps.append(progress.step))
        >>> scene, cameras = load_scene("scene.ply"), load_cameras("cameras.json")
        >>> style = load_image("style.png")
        >>> result = stylize(scene, cameras, style, preset="preview", steps_sos=2, callbacks=callbacks)
        >>> steps
        [1, 2]
    """

    progress: Callable[[Progress], None] | None = None
    progress_seconds: float = 0.25
    stop: Callable[[], bool] | None = None
    finish: Callable[[], bool] | None = None
    checkpoint: Callable[[Stylizer], None] | None = None
    checkpoint_seconds: float = 300.0
    preview: Callable[[Stylizer], None] | None = None
    preview_seconds: float = 60.0
    left: SecondsLeft | None = None


def run(stylizer: Stylizer, callbacks: Callbacks | None = None) -> Stopped:
    """Iterate to the end of the schedule, unless a limit in the settings or `callbacks.stop` ends the run earlier.

    Example:
        >>> scene, cameras = load_scene("scene.ply").scene, load_cameras("cameras.json")
        >>> settings = make_settings("preview", steps_sos=2)
        >>> stylizer = Stylizer.planned(scene, cameras, load_image("style.png"), settings)
        >>> run(stylizer)
        'finished'
    """
    callbacks = replace(callbacks or Callbacks())
    callbacks.left = callbacks.left or seconds_left(stylizer.job.settings.within)
    last_checkpoint = last_preview = time.perf_counter()
    pace, ended = _Pace(stylizer), partial(_end_requested, stylizer, callbacks, stylizer.step)
    report = _Reports(stylizer, callbacks, pace)
    if callbacks.preview and not stylizer.step:
        _timed(stylizer, "preview", callbacks.preview)
    if stylizer.step:  # a resumed job may have had more steps than were chosen at first
        _steer(stylizer, callbacks, pace, at_once=True)
    while stylizer.step < stylizer.job.total_steps:
        reason = stylizer.job.collectives.broadcast(partial(ended, pace)) or _enough(stylizer)
        if reason:
            stylizer.read_step()
            pace.remember()
            report(last=True)
            if callbacks.checkpoint:
                _timed(stylizer, "checkpoint", callbacks.checkpoint)
            return reason
        stylizer.queue_step()
        _steer(stylizer, callbacks, pace)
        now = time.perf_counter()
        last = stylizer.step == stylizer.job.total_steps
        if last:
            stylizer.read_step()
        report(last=last)
        if callbacks.checkpoint and now - last_checkpoint >= callbacks.checkpoint_seconds:
            _timed(stylizer, "checkpoint", callbacks.checkpoint)
            last_checkpoint = time.perf_counter()
        if callbacks.preview and now - last_preview >= callbacks.preview_seconds:
            _timed(stylizer, "preview", callbacks.preview)
            last_preview = time.perf_counter()
        pace.beside += time.perf_counter() - now
    pace.remember()
    choice = stylizer.job.plan.time_choice
    return "within" if choice and stylizer.job.settings.steps_sos < choice.all_steps else "finished"


class _Pace:
    """Pace of a job's steps: seconds per pixel that this rank passes through the network.

    Before the first ten steps, it is that of the estimate. The very first one does not count: it prepares the style.

    Attributes:
        beside: Seconds between the steps so far, for reports, checkpoints and previews.
    """

    def __init__(self, stylizer: Stylizer) -> None:
        self._stylizer, self._estimate, self._first = stylizer, estimate(stylizer.job), len(stylizer.history)
        self._earlier, self.beside = stylizer.seconds, 0.0
        self._started = time.perf_counter(), time.process_time()
        for ranks in (stylizer.job.team.everybody, stylizer.job.team.group):
            ranks.set_timeout_for(self._estimate.seconds)

    def step_seconds(self, *, coarse: bool = False, least: int = _KNOWN) -> float:
        """Return the seconds of a mean step of a phase, with what happens between steps.

        Args:
            least: Number of steps from which on they count instead of the estimate.
        """
        work, expected, history = self._stylizer.job.plan.work, self._estimate, self._stylizer.history
        start = max(self._first + 1, len(history) - _LATEST)
        pixels = sum(record.pixels for record in history[start:])
        if len(history) - start < least or not pixels:
            return expected.seconds_coarse if coarse else expected.seconds
        seconds = history[-1].seconds - history[start - 1].seconds
        beside = self.beside / (history[-1].seconds - self._earlier)
        return (work.coarse if coarse else work.sos) * seconds / pixels * (1 + beside)

    def ending_seconds(self) -> float:
        """Return the seconds from the last step to the last file, with the measurements."""
        work = self._stylizer.job.plan.work
        measuring = work.measuring / work.sos * self.step_seconds(least=1) if work.sos else 0.0
        return measuring + self._slowdown() * ending_seconds(len(self._stylizer.job.scene))

    def _slowdown(self) -> float:
        """Return how many times other processes lengthen the ending, which runs on one core: if this one gets less.

        The first steps are not judged: they also wait for memory that the system reads from disk.
        """
        job, steps = self._stylizer.job, len(self._stylizer.history) - self._first
        if job.network.device.type != "cpu" or steps <= _FIRST_STEERED:
            return 1.0
        seconds, of_processor = (
            now - then for now, then in zip((time.perf_counter(), time.process_time()), self._started, strict=True)
        )
        return max(1.0, seconds / max(of_processor, 1e-9))

    def left(self) -> float:
        """Return the remaining seconds of the job."""
        job, step = self._stylizer.job, self._stylizer.step
        coarse = max(job.plan.steps_coarse - step, 0)
        sos = job.total_steps - max(step, job.plan.steps_coarse)
        return coarse * self.step_seconds(coarse=True) + sos * self.step_seconds() + self.ending_seconds()

    def remember(self) -> None:
        """Leave the rate of the network in this run's steps behind for later jobs."""
        job, records = self._stylizer.job, self._stylizer.history[self._first + 1 :]  # the first one prepares the style
        seconds = sum(record.parts.get(name, 0.0) for record in records for name in NETWORK_PARTS)
        rate = sum(record.pixels for record in records) / max(seconds, 1e-9)
        if job.collectives.rank == 0 and rate and seconds:
            Rates(job.network, job.plan.precision, job.settings).remember(job.plan.work.sos, rate)


def _steer(stylizer: Stylizer, callbacks: Callbacks, pace: _Pace, *, at_once: bool = False) -> None:
    """Let the pace of a job with a time budget decide, every few steps, how many steps remain."""
    job = stylizer.job
    choice, done = job.plan.time_choice, stylizer.step - job.plan.steps_coarse
    if choice is None or choice.most_steps is None or done < _FIRST_STEERED:
        return
    if not at_once and (done - _FIRST_STEERED) % _STEERED:
        return

    def total() -> int:
        usable = (callbacks.left() if callbacks.left else 0.0) - pace.ending_seconds()
        more = math.floor(usable / pace.step_seconds(least=_FIRST_STEERED))
        return min(max(done + more, done), choice.most_steps or done)

    steps = job.collectives.broadcast(total)
    stylizer.job = replace(job, settings=job.settings.with_steps(job.plan.steps_coarse, steps))


def _end_requested(stylizer: Stylizer, callbacks: Callbacks, first: int, pace: _Pace) -> Stopped | None:
    """Return the reason if the user or the time limit ends the run before the next step. Ranks may disagree.

    A run that is to have a result makes a step at least, given the step that it starts at: resuming it gets further. It
    makes a second one, from which on its own pace is known, if there is any time left.
    """
    if callbacks.stop and callbacks.stop():
        return "interrupted"
    if stylizer.step == first:
        return None
    if callbacks.finish and callbacks.finish():
        return "on-request"
    if callbacks.left is None:
        return None
    coarse, left = stylizer.phase.stage == "coarse", callbacks.left()
    if stylizer.step == first + 1 and left > 0:
        return None
    return "within" if left <= pace.step_seconds(coarse=coarse, least=1) + pace.ending_seconds() else None


def _enough(stylizer: Stylizer) -> Stopped | None:
    """Return the reason if the losses end the run before the next step. Ranks always agree."""
    settings = stylizer.job.settings
    if not (settings.target_loss or settings.early_stop):
        return None
    windows = 2 * window_length(stylizer.job.round_length)  # what `has_converged` compares
    # A checkpoint reads the last step, but must not change when the job ends.
    end = stylizer.step - stylizer.reads_late
    losses = [record.loss for record in stylizer.history[max(end - windows, 0) : max(end, 0)] if record.stage == "sos"]
    if settings.target_loss and len(losses) >= stylizer.job.round_length:  # all views have been visited at this point
        target = settings.target_loss * mean_loss(stylizer.start(), stylizer.job.loss.weights)
        if stylizer.job.plan.training_background != "background":
            # Losses of steps with different backgrounds are not comparable, so the loss over the settings' background
            # is evaluated at the end of each round, in the same way as the initial loss.
            losses = []
            if not stylizer.step % stylizer.job.round_length:
                with stylizer.timed("measuring"):
                    loss = mean_loss(stylizer.evaluate(stylizer.job.evaluation_views), stylizer.job.loss.weights)
                losses = [loss] * stylizer.job.round_length
        if has_reached(losses, target, stylizer.job.round_length):
            return "target-loss"
    stops_early = settings.early_stop and stylizer.job.plan.training_background == "background"
    return "converged" if stops_early and has_converged(losses, stylizer.job.round_length) else None


class _Reports:
    """Reports of the progress, with the mean loss of the last round of views."""

    def __init__(self, stylizer: Stylizer, callbacks: Callbacks, pace: _Pace) -> None:
        self._stylizer, self._callbacks, self._pace = stylizer, callbacks, pace
        self._reported = len(stylizer.history)
        self._at = -math.inf

    def __call__(self, *, last: bool) -> None:
        """Report the latest known step, unless it has been reported, or it is not the last and a report is recent."""
        if self._callbacks.progress is None:
            return
        known, now = len(self._stylizer.history), time.perf_counter()
        if self._reported < known and (last or now - self._at >= self._callbacks.progress_seconds):
            self._reported, self._at = known, now
            self._callbacks.progress(self._progress())

    def _progress(self) -> Progress:
        stylizer, record = self._stylizer, self._stylizer.history[-1]
        length, weights = stylizer.job.round_length, stylizer.job.loss.weights
        means = round_evaluation(stylizer.history, length, weights)
        left = self._pace.left()
        return Progress(
            stage=record.stage,
            step=record.step,
            total=stylizer.job.total_steps,
            eta_s=left if self._callbacks.left is None else min(left, max(self._callbacks.left(), 0.0)),
            loss=record.loss,
            scales=_by_scale(record.terms),
            mean_loss=round_loss(stylizer.history, length),
            mean_scales=_by_scale(means),
            seconds=stylizer.seconds,
        )


def _by_scale(evaluation: Evaluation) -> list[float | None]:
    """Return losses by scale, full size first and None for skipped scales."""
    return [evaluation[scale].total if scale in evaluation else None for scale in range(max(evaluation) + 1)]


def _timed(stylizer: Stylizer, part: str, action: Callable[[Stylizer], None]) -> None:
    """Call an action between steps, and record its time as a part of the job's."""
    with stylizer.timed(part):
        action(stylizer)


def stylize(
    scene: F,
    cameras: Sequence[Camera],
    style: Tensor | NDArray[Any] | Style,
    *,
    preset: PresetName = "standard",
    render_mode: RenderMode = "auto",
    eps2d: float | None = None,
    photos: PhotoLoader | None = None,
    progress: bool = False,
    callbacks: Callbacks | None = None,
    weights: BackboneWeights | None = None,
    **settings: Any,
) -> F:
    """Stylize a scene from start to finish. The given scene is not changed.

    Args:
        scene: Result of `load_scene`, a `Scene`, or a dictionary of tensors of gsplat (`scene_of_splats`).
        style: Style image, such as from `load_image`; or a mixture of several.
        preset: Preset of the settings: "preview", "standard" or "paper".
        render_mode: Render mode of the scene's training, "classic" or "antialiased"; "auto" for that of its file, which
            is classic for checkpoints and tensors.
        eps2d: Blur of projected Gaussians in square pixels; None for that of the file or the mode.
        photos: Function that loads the content image of a view by its index, at the size of the view; None for
            unstylized renders.
        progress: Whether to show a progress bar, on a terminal or in a notebook (which needs ipywidgets).
        callbacks: Callbacks for progress, checkpoints and previews.
        weights: Weights of the feature network; None for VGG19 if it is installed, else VGG16.
        settings: Further fields of `Settings`, such as `steps_sos=100`.

    Returns:
        Stylized scene, of the type of the given one. `save` writes it to a file.

    Raises:
        InvalidInputError: If an input or a setting cannot be used.

    Example:
        >>> scene, cameras = load_scene("scene.ply"), load_cameras("cameras.json")
        >>> result = stylize(scene, cameras, load_image("style.png"), preset="preview", steps_sos=2)
        >>> save("stylized.ply", result)
        >>> torch.equal(load_scene("stylized.ply").scene.sh_dc, result.scene.sh_dc)
        True
    """
    chosen = make_settings(preset, **settings)
    left = seconds_left(chosen.within)
    with job_bar(Console(highlight=False, markup=False, emoji=False)) if progress else nullcontext() as bar:
        show = bar.show if bar else None
        given = as_scene(scene)
        given = replace(given, rendering=given.rendering.requested(render_mode, eps2d))
        stylizer = Stylizer.planned(given, cameras, style, chosen, weights=weights, photos=photos, show=show, left=left)
        job = stylizer.job
        if isinstance(scene, SceneFile):
            scene.refined(job.plan.refinement)  # raises before the steps if the file cannot hold the result
        own = callbacks or Callbacks()

        def report(now: Progress) -> None:
            if show:
                show(now)
            if own.progress:
                own.progress(now)

        run(stylizer, replace(own, progress=report, left=own.left or left))
    result = replace(job.scene, sh_dc=stylizer.stylized())
    return cast(F, stylized(scene, result, job.plan.refinement, chosen.sh_attenuation))


Stopped = Literal["finished", "within", "target-loss", "converged", "on-request", "interrupted"]
