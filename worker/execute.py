"""A prepared job from its first step to its files."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import remove_leftovers
from sgsst_core.files.colors import write_colors
from sgsst_core.files.json_files import write_json
from sgsst_core.files.ply import write_packed, write_stylized
from sgsst_core.loss.scale_weights import EVEN, ScaleWeights
from sgsst_core.quality.findings import findings_of
from sgsst_core.quality.measure import Measurements
from sgsst_core.quality.packed import PackedLoss, measure_packed
from sgsst_core.report.charts import write_loss_chart
from sgsst_core.report.contact_sheet import write_contact_sheet, write_views
from sgsst_core.report.document import bought, build_report, plan_json, sent_json
from sgsst_core.report.page import write_page
from sgsst_core.stylizing.checkpoint import Checkpoint, versions
from sgsst_core.stylizing.evaluation import Evaluation, mean_loss
from sgsst_core.stylizing.loop import Callbacks, Progress, Stopped, run
from sgsst_core.stylizing.stylizer import Stylizer
from worker.options import RunOptions
from worker.prepare import Job, Warn
from worker.request import Outputs

#: Seconds between checkpoints, unless told otherwise: what a lost rank costs at most.
CHECKPOINT_SECONDS = RunOptions().checkpoint_seconds


@dataclass(frozen=True)
class Result:
    """How a job ended.

    Attributes:
        stopped: see `run`; where it is "interrupted", only the checkpoint was written.
        step, total: that were done, and planned.
        before, after: loss on the evaluation views; both are empty where the job was interrupted.
        bought: what error the time bought (`report.bought`).
        report_error: why report, contact sheet or curves are missing; None if they are not.
        packed: what the packed file loses that lies beside the PLY; None where there is none.
        weights: of the scales in `before` and `after`.
    """

    stopped: Stopped
    step: int
    total: int
    before: Evaluation
    after: Evaluation
    bought: dict[str, Any] | None = None
    report_error: str | None = None
    packed: PackedLoss | None = None
    weights: ScaleWeights = EVEN

    @property
    def losses(self) -> tuple[float, float]:
        """The loss before and after."""
        return mean_loss(self.before, self.weights), mean_loss(self.after, self.weights)


def execute(
    job: Job,
    *,
    progress: Callable[[Progress], None],
    stop: Callable[[], bool],
    warn: Warn,
    preview: Callable[[Stylizer], None] | None = None,
    saved: Callable[[int], None] = lambda step: None,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    run_id: str | None = None,
) -> Result:
    """Run a prepared job and write its outputs: the PLY first, so that no failing report can lose it.

    Checkpoints are written every `checkpoint_seconds` and where the job ends early. One that cannot be written is a
    warning as long as the job itself goes on. Every rank that takes part calls this; the callbacks are used on the
    first one alone: `saved` is told the step of each checkpoint, `preview` is called after every step (see `Previews`).

    Raises:
        OutputError: the PLY, or the checkpoint of an interrupted job, cannot be written.
    """
    stylizer = job.stylizer
    first = stylizer.collectives.rank == 0
    measure = Measurements(stylizer)
    if job.resumed:
        stylizer.load_state(job.resumed.state)
    if first:
        _make_room(job.outputs)
    stylizer.collectives.broadcast(lambda: write_json(job.outputs.plan, plan_json(stylizer.plan)))
    if first:
        _write_views(job, warn)
    checkpoint = _CheckpointWriter(job, run_id or secrets.token_hex(8), saved, warn)
    callbacks = Callbacks(measure=measure, checkpoint_seconds=checkpoint_seconds)
    if first:
        callbacks.progress, callbacks.stop = progress, stop
        callbacks.checkpoint, callbacks.preview = checkpoint, preview
        callbacks.preview_seconds = 0.0  # when it is time for one, it knows itself
    stopped = run(stylizer, callbacks)
    if stopped == "interrupted":
        if checkpoint.error is not None:
            raise checkpoint.error
        return Result(stopped, stylizer.step, stylizer.total, {}, {})
    return _finish(job, stopped, measure)


def _make_room(outputs: Outputs) -> None:
    """The folder of the outputs, without what an attempt that was killed has left there."""
    outputs.ply.parent.mkdir(parents=True, exist_ok=True)
    for path in outputs.all:
        remove_leftovers(path)


def _write_views(job: Job, warn: Warn) -> None:
    """The views of an orbit as pictures, so that it can be seen at once whether they are the right ones."""
    path = job.outputs.views
    if job.request.source.orbit is None or (job.resumed and path.exists()):
        return
    settings, cameras = job.stylizer.settings, job.stylizer.views.cameras
    try:
        write_views(path, job.scene_file.scene, cameras, background=settings.background, near=settings.near)
    except OutputError as error:
        warn(f"No pictures of the views could be written: {error}")


class _CheckpointWriter:
    """Saves a job's state; for `loop.Callbacks.checkpoint`.

    Attributes:
        error: why the last one could not be written; None where it was.
    """

    def __init__(self, job: Job, run_id: str, saved: Callable[[int], None], warn: Warn) -> None:
        self._job, self._run_id = job, run_id
        self._saved, self._warn = saved, warn
        self.error: OutputError | None = None

    def __call__(self, stylizer: Stylizer) -> None:
        """Write one, or warn."""
        job = self._job
        self.error = None
        checkpoint = Checkpoint(stylizer.state(), stylizer.plan, job.planned_ranks, self._run_id, versions())
        try:
            job.outputs.checkpoints.save(checkpoint, job.fingerprint)
            self._saved(stylizer.step)
        except OutputError as error:
            self.error = error
            self._warn(f"No checkpoint could be written: {error}")


def _finish(job: Job, stopped: Stopped, measure: Measurements) -> Result:
    """Write the PLY, then everything beside it. Every rank calls this."""
    stylizer, outputs = job.stylizer, job.outputs
    first = stylizer.collectives.rank == 0
    stylizer.collectives.broadcast(lambda: _write_ply(job))
    packed = stylizer.collectives.broadcast(lambda: _write_packed(job))
    if first and stopped != "max-seconds":
        outputs.checkpoints.remove()
    measure.at_the_end()
    # Now that the views are prepared; before the first step it would have been waited for.
    before, after = measure.evaluate(unstylized=True), measure.evaluate()
    error = _write_reports(job, stopped, before, after, packed) if first else None
    found = bought(stylizer, before)
    problem = str(error) if error else None
    return Result(stopped, stylizer.step, stylizer.total, before, after, found, problem, packed, stylizer.loss.weights)


def _write_ply(job: Job) -> None:
    stylizer = job.stylizer
    write_stylized(
        job.scene_file, job.outputs.ply, stylizer.stylized(), sh_attenuation=stylizer.settings.sh_attenuation
    )


def _only_colors_change(job: Job) -> bool:
    """Whether the result has the rows of the scene's file, each with all that it had but for f_dc."""
    file, attenuation = job.scene_file, job.stylizer.settings.sh_attenuation
    return file.kept is None and file.copies is None and not (attenuation and file.scene.sh_degree)


def _write_packed(job: Job) -> PackedLoss | None:
    """Write the stylized scene in a packed form beside the PLY, and measure what that loses."""
    path, form, stylizer = job.outputs.packed, job.outputs.packed_form, job.stylizer
    if path is None or form is None:
        return None
    scene = replace(stylizer.scene, sh_dc=stylizer.stylized().detach().to("cpu", torch.float32))
    write_packed(path, scene, form)
    settings = stylizer.settings
    return measure_packed(path, scene, stylizer.views.cameras, background=settings.background, near=settings.near)


def _write_reports(
    job: Job, stopped: Stopped, before: Evaluation, after: Evaluation, packed: PackedLoss | None
) -> Exception | None:
    """Write what lies beside the PLY; returns what went wrong, since the scene itself is there."""
    stylizer, outputs = job.stylizer, job.outputs
    try:
        if job.request.colors and _only_colors_change(job):
            write_colors(outputs.colors, stylizer.stylized())
        near, survey = stylizer.settings.near, stylizer.plan.survey
        findings = findings_of(job.scene_file, stylizer.views.cameras, stylizer.style, near=near, survey=survey)
        report = build_report(stylizer, job.sources, stopped, before, after, findings)
        lost = sum(attempt["seconds_lost"] for attempt in job.workers["attempts"])
        sent = sent_json(stylizer.history)
        report["packed"] = packed and packed.as_dict()
        report["workers"] = {**job.workers, "bytes_sent": sent, "seconds_lost": round(lost, 3)}
        write_json(outputs.report, report)
        write_contact_sheet(outputs.sheet, stylizer)
        write_loss_chart(outputs.curves, report)
        write_page(outputs.page, report, outputs.sheet, outputs.views if outputs.views.exists() else None)
    except Exception as error:  # whatever it is, it must not look as if the job itself had failed
        return error
    return None
