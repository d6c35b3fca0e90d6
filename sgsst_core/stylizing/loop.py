"""The optimizer loop: all steps of a job, and when it ends before them.

The loop prints nothing and writes nothing; what is to be shown or saved goes through `Callbacks`. Of several ranks,
each runs it; the first one decides when it ends.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

from torch import Tensor

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.loss.convergence import has_converged, has_reached
from sgsst_core.loss.mixture import StyleMixture
from sgsst_core.planning.plan import Prediction
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.stylizing.ahead import PhotoLoader
from sgsst_core.stylizing.evaluation import mean_loss
from sgsst_core.stylizing.seconds_left import ExpectedPhase, SecondsLeft
from sgsst_core.stylizing.stylizer import Stylizer

Stopped = Literal["finished", "max-seconds", "target-loss", "converged", "interrupted"]


@dataclass(frozen=True)
class Progress:
    """What a progress bar shows.

    Attributes:
        stage: "coarse" or "sos", of the step that was made; "measuring" where the job is measured after it.
        step: made so far, of `total`.
        loss: of the step.
        seconds: of all steps so far.
        seconds_left: until the job ends, with all that is measured and written.
        scales: loss of the step by scale, full size first; None for scales that it has left out.
    """

    stage: str
    step: int
    total: int
    loss: float
    seconds: float
    seconds_left: float
    scales: tuple[float | None, ...] = ()


class Measuring(Protocol):
    """Measures a job at moments between its steps."""

    def __call__(self, stylizer: Stylizer) -> None:
        """Measure now; puts an entry into `Stylizer.measured`."""

    def due(self, step: int) -> bool:
        """Whether the job is to be measured after so many steps."""

    def seconds_left(self, step: int) -> float:
        """That measuring is expected to take after so many steps."""


@dataclass
class Callbacks:
    """What the loop calls between iterations; each is optional.

    `measure` is the same on every rank; the others are the first rank's alone.

    Attributes:
        progress: after every iteration.
        stop: asked before every iteration; True ends the loop as "interrupted".
        checkpoint: called with the stylizer about every `checkpoint_seconds`, and once when the loop ends early.
        preview: called with the stylizer before the first step and about every `preview_seconds`.
        measure: called with the stylizer after each step for which it is due; its time does not count as the job's.
    """

    progress: Callable[[Progress], None] | None = None
    stop: Callable[[], bool] | None = None
    checkpoint: Callable[[Stylizer], None] | None = None
    checkpoint_seconds: float = 300.0
    preview: Callable[[Stylizer], None] | None = None
    preview_seconds: float = 60.0
    measure: Measuring | None = None


def run(stylizer: Stylizer, callbacks: Callbacks | None = None) -> Stopped:
    """Iterate to the end of the schedule, or until one of the settings' limits or `callbacks.stop` ends it before."""
    try:
        return _iterate(stylizer, callbacks or Callbacks())
    finally:
        stylizer.views.end_look_ahead()


def _iterate(stylizer: Stylizer, callbacks: Callbacks) -> Stopped:
    """As `run`, which clears up after it."""
    last_checkpoint = last_preview = time.perf_counter()
    pace = _pace(stylizer)
    if callbacks.preview and not stylizer.step:
        callbacks.preview(stylizer)
    _measure(stylizer, callbacks)  # where a resumed job had not come to it
    while stylizer.step < stylizer.total:
        reason = stylizer.collectives.broadcast(lambda: _asked_to_end(stylizer, callbacks)) or _enough(stylizer)
        if reason:
            return _end_early(stylizer, callbacks, reason)
        _step(stylizer, pace)
        now = time.perf_counter()
        if callbacks.progress:
            callbacks.progress(_progress(stylizer, callbacks, pace))
        if callbacks.checkpoint and now - last_checkpoint >= callbacks.checkpoint_seconds:
            _checkpoint(stylizer, callbacks.checkpoint)
            last_checkpoint = time.perf_counter()
        if callbacks.preview and now - last_preview >= callbacks.preview_seconds:
            callbacks.preview(stylizer)
            last_preview = time.perf_counter()
        pace.add_beside(time.perf_counter() - now)
        _measure(stylizer, callbacks)
    return "finished"


def _asked_to_end(stylizer: Stylizer, callbacks: Callbacks) -> Stopped | None:
    """Whether the user or the clock ends the run before the next step; ranks may see these differently."""
    if callbacks.stop and callbacks.stop():
        return "interrupted"
    seconds = stylizer.settings.max_seconds
    return "max-seconds" if seconds and stylizer.seconds >= seconds else None


def _enough(stylizer: Stylizer) -> Stopped | None:
    """Whether the losses end the run before the next step; they are the same on every rank."""
    settings = stylizer.settings
    if not (settings.target_loss or settings.early_stop):
        return None
    losses = [record.loss for record in stylizer.history if record.stage == "sos"]
    if settings.target_loss and len(losses) >= stylizer.round_length:  # every view has been visited by then
        target = settings.target_loss * mean_loss(stylizer.start(), stylizer.loss.weights)
        if stylizer.plan.training_background != "background":
            losses = _losses_on_background(stylizer)
        if has_reached(losses, target, stylizer.round_length):
            return "target-loss"
    return "converged" if stylizer.stops_early and has_converged(losses, stylizer.round_length) else None


def _losses_on_background(stylizer: Stylizer) -> list[float]:
    """The loss as the start's was taken, once in a round, as often as it has steps: those of steps do not compare."""
    if stylizer.step % stylizer.round_length:
        return []
    with stylizer.measuring():
        return [mean_loss(stylizer.evaluate(stylizer.evaluation_views), stylizer.loss.weights)] * stylizer.round_length


def _measure(stylizer: Stylizer, callbacks: Callbacks) -> None:
    measured = stylizer.measured and stylizer.measured[-1]["step"] == stylizer.step  # before a resume
    if callbacks.measure and not measured and callbacks.measure.due(stylizer.step):
        callbacks.measure(stylizer)


def _pace(stylizer: Stylizer) -> SecondsLeft:
    """What tells the seconds left, with the steps of sessions before this one."""
    expected = stylizer.plan.prediction or Prediction(0.0, 0.0, 0)
    seconds = {
        "coarse": (expected.seconds_coarse, expected.first_visit_coarse),
        "sos": (expected.seconds, expected.first_visit),
    }
    phases = [ExpectedPhase(phase.stage, phase.steps, *seconds.get(phase.stage, ())) for phase in stylizer.schedule]
    views_per_step = stylizer.settings.views_per_step
    pace = SecondsLeft(phases, stylizer.views.covered, views_per_step)
    if views_per_step == 1:  # records name one view of each step
        before = 0.0
        for record in stylizer.history:
            pace.add_step(record.stage, [record.view], record.seconds - before, record.parts.get("prepare", 0.0))
            before = record.seconds
        pace.resume()
    return pace


def _step(stylizer: Stylizer, pace: SecondsLeft) -> None:
    """Make a step and count what it took, but for the style, which comes once."""
    before, style_before = stylizer.seconds, stylizer.style_seconds
    record = stylizer.run_step()
    style = stylizer.style_seconds - style_before
    seconds = stylizer.seconds - before - style
    prepared = max(record.parts.get("prepare", 0.0) - style, 0.0)
    pace.add_step(record.stage, stylizer.latest, seconds, prepared)


def _progress(stylizer: Stylizer, callbacks: Callbacks, pace: SecondsLeft) -> Progress:
    record, most, measure = stylizer.history[-1], stylizer.settings.max_seconds, callbacks.measure
    expected = stylizer.plan.prediction
    left = pace.left(
        stylizer.step,
        stylizer.coming,
        measuring=measure.seconds_left(stylizer.step) if measure else 0.0,
        limit=most - stylizer.seconds if most else None,
    )
    stage = "measuring" if measure and measure.due(stylizer.step) else record.stage
    if expected:
        left += expected.ending
    terms = record.terms
    scales = tuple(terms[scale].total if scale in terms else None for scale in range(max(terms, default=-1) + 1))
    return Progress(stage, record.step, stylizer.total, record.loss, stylizer.seconds, left, scales)


def _end_early(stylizer: Stylizer, callbacks: Callbacks, reason: Stopped) -> Stopped:
    if callbacks.checkpoint:
        _checkpoint(stylizer, callbacks.checkpoint)
    return reason


def _checkpoint(stylizer: Stylizer, save: Callable[[Stylizer], None]) -> None:
    """Save, and count the seconds beside those of the steps."""
    started = time.perf_counter()
    save(stylizer)
    parts = stylizer.seconds_by_part
    parts["checkpoint"] = parts.get("checkpoint", 0.0) + time.perf_counter() - started


def stylize(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Tensor | StyleMixture,
    settings: Settings,
    *,
    weights: BackboneWeights | None = None,
    photos: PhotoLoader | None = None,
    callbacks: Callbacks | None = None,
) -> Tensor:
    """Stylize a scene from beginning to end; the arguments are those of `Stylizer.planned`.

    Returns:
        The new sh_dc [N, 3], float32 on the CPU. Everything else of the scene stays as it is. (Of a refined scene
        they are of its Gaussians: `Stylizer.planned` has it.)
    """
    stylizer = Stylizer.planned(scene, cameras, style, settings, weights=weights, photos=photos)
    run(stylizer, callbacks)
    return stylizer.stylized()
