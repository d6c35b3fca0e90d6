"""Optimization loop: run all steps of a job, and decide when to stop early.

The loop neither prints nor writes files; `Callbacks` display and save results. With several ranks, each rank runs the
loop, and the first rank decides when it stops.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, Protocol

from sgsst_core.loss.convergence import has_converged, has_reached, window_length
from sgsst_core.planning.plan import Prediction
from sgsst_core.planning.time_budget import SecondsLeft as BudgetLeft
from sgsst_core.planning.time_budget import seconds_left
from sgsst_core.progress import Progress
from sgsst_core.stylizing.evaluation import RunningRound, mean_loss
from sgsst_core.stylizing.seconds_left import Pace, SecondsLeft
from sgsst_core.stylizing.stylizer import Stylizer

Stopped = Literal["finished", "within", "target-loss", "converged", "on-request", "interrupted"]


class Measuring(Protocol):
    """Measurement of a job at certain steps."""

    def __call__(self, stylizer: Stylizer) -> None:
        """Measure now, and append an entry to `Stylizer.measured`."""

    def due(self, step: int) -> bool:
        """Return whether the job is to be measured after this many steps."""

    def seconds_left(self, step: int, *, ends: bool = False) -> float:
        """Return the expected seconds of the remaining measurements after this many steps, with `ends` the last."""


@dataclass
class Callbacks:
    """Optional callbacks of the loop, called between iterations.

    `measure` must be the same on every rank; give the other callbacks to the first rank only.

    Attributes:
        progress: Called after the first and the last iteration, and between them about every `progress_seconds`.
        stop: Called before every iteration; True ends the loop as "interrupted".
        finish: Called before every iteration but the first; True ends the loop as "on-request".
        checkpoint: Called with the stylizer about every `checkpoint_seconds`, and once if the loop ends early.
        preview: Called with the stylizer before the first step and about every `preview_seconds`.
        measure: Called with the stylizer after each step for which it is due; its time does not count toward
            `Stylizer.seconds`.
        left: Seconds left of the time budget (`Settings.within`); None to count it from the start of the loop.

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
    measure: Measuring | None = None
    left: BudgetLeft | None = None


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
    try:
        last_checkpoint = last_preview = time.perf_counter()
        pace, ended = _pace(stylizer), partial(_end_requested, stylizer, callbacks, stylizer.step)
        report = _Reports(stylizer, callbacks, pace)
        if callbacks.preview and not stylizer.step:
            callbacks.preview(stylizer)
        _measure(stylizer, callbacks)  # a resumed job may have been stopped before this measurement
        while stylizer.step < stylizer.job.total_steps:
            reason = stylizer.job.collectives.broadcast(ended) or _enough(stylizer)
            if reason:
                stylizer.read_step()
                report(last=True)
                if callbacks.checkpoint:
                    _checkpoint(stylizer, callbacks.checkpoint)
                return reason
            _step(stylizer, pace)
            now = time.perf_counter()
            measures = callbacks.measure is not None and callbacks.measure.due(stylizer.step)
            last = measures or stylizer.step == stylizer.job.total_steps
            if last:
                stylizer.read_step()
            report(last=last)
            if callbacks.checkpoint and now - last_checkpoint >= callbacks.checkpoint_seconds:
                _checkpoint(stylizer, callbacks.checkpoint)
                last_checkpoint = time.perf_counter()
            if callbacks.preview and now - last_preview >= callbacks.preview_seconds:
                callbacks.preview(stylizer)
                last_preview = time.perf_counter()
            pace.add_beside(time.perf_counter() - now)
            _measure(stylizer, callbacks)
        return "finished"
    finally:
        stylizer.job.view_targets.end_prefetch()


def _end_requested(stylizer: Stylizer, callbacks: Callbacks, first: int) -> Stopped | None:
    """Return the reason if the user or the time limit ends the run before the next step. Ranks may disagree.

    A run that is to have a result makes a step at least, given the step that it starts at: resuming it gets further.
    """
    if callbacks.stop and callbacks.stop():
        return "interrupted"
    if stylizer.step == first:
        return None
    if callbacks.finish and callbacks.finish():
        return "on-request"
    return "within" if callbacks.left and callbacks.left() <= _reserved(stylizer, callbacks) else None


def _reserved(stylizer: Stylizer, callbacks: Callbacks) -> float:
    """Return the seconds of a time budget that the next step and the end of the job need."""
    expected = stylizer.job.plan.prediction or Prediction(0.0, 0.0, 0)
    step = stylizer.seconds / stylizer.step if stylizer.step else expected.seconds
    measuring = callbacks.measure.seconds_left(stylizer.step, ends=True) if callbacks.measure else 0.0
    return step + measuring + expected.ending


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
                with stylizer.measuring():
                    loss = mean_loss(stylizer.evaluate(stylizer.job.evaluation_views), stylizer.job.loss.weights)
                losses = [loss] * stylizer.job.round_length
        if has_reached(losses, target, stylizer.job.round_length):
            return "target-loss"
    stops_early = settings.early_stop and stylizer.job.plan.training_background == "background"
    return "converged" if stops_early and has_converged(losses, stylizer.job.round_length) else None


def _measure(stylizer: Stylizer, callbacks: Callbacks) -> None:
    measured = stylizer.measured and stylizer.measured[-1]["step"] == stylizer.step  # by an earlier session
    if callbacks.measure and not measured and callbacks.measure.due(stylizer.step):
        callbacks.measure(stylizer)


def _pace(stylizer: Stylizer) -> SecondsLeft:
    """Return the estimator of the remaining time."""
    expected = stylizer.job.plan.prediction or Prediction(0.0, 0.0, 0)
    seconds = {
        "coarse": (expected.seconds_coarse, expected.first_visit_coarse),
        "sos": (expected.seconds, expected.first_visit),
    }
    phases = {phase.stage: Pace(phase.steps, *seconds.get(phase.stage, ())) for phase in stylizer.job.schedule}
    return SecondsLeft(phases, stylizer.job.views.covered, stylizer.job.settings.views_per_step)


def _step(stylizer: Stylizer, pace: SecondsLeft) -> None:
    """Run and time one step, without the one-off style setup."""
    before, style_before, stage = stylizer.seconds, stylizer.job.style_targets.seconds, stylizer.phase.stage
    stylizer.queue_step()
    style = stylizer.job.style_targets.seconds - style_before
    pace.add_step(stage, stylizer.latest, stylizer.seconds - before - style)


class _Reports:
    """Reports of the progress, with the mean loss of the last round of views."""

    def __init__(self, stylizer: Stylizer, callbacks: Callbacks, pace: SecondsLeft) -> None:
        self._stylizer, self._callbacks, self._pace = stylizer, callbacks, pace
        self._running = RunningRound(stylizer.job.round_length, stylizer.job.loss.weights, stylizer.history)
        self._added = self._reported = len(stylizer.history)
        self._at = -math.inf

    def __call__(self, *, last: bool) -> None:
        """Report the latest known step, unless it has been reported, or it is not the last and a report is recent."""
        if self._callbacks.progress is None:
            return
        history, now = self._stylizer.history, time.perf_counter()
        for record in history[self._added :]:
            self._running.add(record)
        self._added = len(history)
        if self._reported < self._added and (last or now - self._at >= self._callbacks.progress_seconds):
            self._reported, self._at = self._added, now
            self._callbacks.progress(_progress(self._stylizer, self._callbacks, self._pace, self._running))


def _progress(stylizer: Stylizer, callbacks: Callbacks, pace: SecondsLeft, running: RunningRound) -> Progress:
    record, measure, expected = stylizer.history[-1], callbacks.measure, stylizer.job.plan.prediction
    limit = callbacks.left() - _reserved(stylizer, callbacks) if callbacks.left else None
    left = pace.left(stylizer.step, limit=limit)
    left += measure.seconds_left(stylizer.step) if measure else 0.0
    stage = "measuring" if measure and measure.due(stylizer.step) else record.stage
    if expected:
        left += expected.ending
    return Progress(
        stage=stage,
        step=record.step,
        total=stylizer.job.total_steps,
        eta_s=left,
        loss=record.loss,
        scales=_by_scale({scale: terms.total for scale, terms in record.terms.items()}),
        mean_loss=running.loss,
        mean_scales=_by_scale(running.scales()),
        seconds=stylizer.seconds,
    )


def _by_scale(losses: Mapping[int, float]) -> list[float | None] | None:
    """Return losses by scale, full size first and None for skipped scales; None without losses."""
    return [losses.get(scale) for scale in range(max(losses, default=-1) + 1)] or None


def _checkpoint(stylizer: Stylizer, save: Callable[[Stylizer], None]) -> None:
    """Save a checkpoint, and record its time separately from the steps."""
    started = time.perf_counter()
    save(stylizer)
    parts = stylizer.seconds_by_part
    parts["checkpoint"] = parts.get("checkpoint", 0.0) + time.perf_counter() - started
