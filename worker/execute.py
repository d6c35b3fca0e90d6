"""Execution of a prepared job: run all steps, then write the outputs."""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import torch

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import remove_leftovers, write_json
from sgsst_core.files.formats.sog import STREAMED_SOG
from sgsst_core.files.scene_file import write_levels, write_scene
from sgsst_core.files.stylized_ply import write_colors, write_stylized
from sgsst_core.planning.time_budget import SecondsLeft
from sgsst_core.progress import Progress
from sgsst_core.quality.findings import findings_of
from sgsst_core.quality.measure import CompressionLoss, Measurements, measure_compression
from sgsst_core.report.document import build_report, loss_over_time, plan_json, seconds_json
from sgsst_core.report.images import write_contact_sheet, write_views
from sgsst_core.stylizing.checkpoint import Checkpoint, save_checkpoint, versions
from sgsst_core.stylizing.job import estimate
from sgsst_core.stylizing.loop import Callbacks, Stopped, run
from sgsst_core.stylizing.stylizer import Evaluation, Stylizer, mean_loss, on_scales_of, round_evaluation, show_nothing
from worker.job import CONTINUABLE, Result
from worker.options import RunOptions
from worker.prepare import Job, Previews, Warn

if TYPE_CHECKING:
    from worker.run import Listener

#: Default seconds between checkpoints. If a rank is lost, at most this much work is repeated.
CHECKPOINT_SECONDS = RunOptions().checkpoint_seconds


def execute(
    job: Job,
    listener: Listener,
    *,
    preview: Previews | None = None,
    checkpoint_seconds: float = CHECKPOINT_SECONDS,
    run_id: str | None = None,
    left: SecondsLeft | None = None,
) -> Result:
    """Run a prepared job and write its outputs.

    The PLY is written first, so that it exists even if the report fails. Every participating rank must call this
    function. The listener is used on rank 0 only.

    Args:
        preview: Writer of previews after every step, and of the thumbnail at the end. None writes neither.
        checkpoint_seconds: Seconds between checkpoints. A job that ends early writes one more at its end.
        run_id: Identifier of this run, stored in checkpoints. None generates one.
        left: Seconds left of the time budget; None without one.

    Raises:
        OutputError: If the PLY, or the checkpoint of an interrupted job, cannot be written.
    """
    stylizer = job.stylizer
    first = stylizer.job.collectives.rank == 0
    reported = _ReportedSteps(listener.progress)
    measure = Measurements(stylizer, reported.show_views if first else show_nothing)
    if job.resumed:
        stylizer.load_state(job.resumed.state)
    if first:
        listener.progress(Progress(stage="starting", step=stylizer.step, total=stylizer.job.total_steps))
        job.outputs.ply.parent.mkdir(parents=True, exist_ok=True)
        for path in job.outputs.all:
            remove_leftovers(path)  # of an attempt that was killed
    stylizer.job.collectives.broadcast(lambda: write_json(job.outputs.plan, plan_json(stylizer.job)))
    if first:
        _write_views(job, listener.warn)
    checkpoint = _CheckpointWriter(job, run_id or secrets.token_hex(8), listener)
    callbacks = Callbacks(checkpoint_seconds=checkpoint_seconds, left=left)
    if first:
        callbacks.progress, callbacks.stop, callbacks.finish = reported, listener.stop, listener.finish
        callbacks.checkpoint, callbacks.preview = checkpoint, preview
        callbacks.preview_seconds = 0.0  # `Previews` itself limits how often a preview is written
        if preview and not _has_rows_of_file(job):
            preview.live.share_scene(stylizer.job.scene)
    stopped = run(stylizer, callbacks)
    if first and stopped in ("on-request", "within", "target-loss", "converged"):
        expected = estimate(stylizer.job)
        reported.end_early(expected.measuring + expected.ending)
    if stopped == "interrupted":
        if checkpoint.error is not None:
            raise checkpoint.error
        return Result(stopped=stopped, steps=stylizer.step, total=stylizer.job.total_steps)
    result = _finish(job, stopped, measure, left)
    if first and preview:
        preview.finish(stylizer)
    return result


def _write_views(job: Job, warn: Warn) -> None:
    """Save images of an orbit's views, so that users can check the cameras before the job is done.

    Without an orbit, those of an earlier job of the same name are deleted.
    """
    path = job.outputs.views
    if job.request.source.cameras is not None:
        with suppress(OSError):  # on Windows, another program may hold it open
            path.unlink(missing_ok=True)  # or the report of this job would show it
        return
    if job.resumed and path.exists():
        return
    settings, cameras = job.stylizer.job.settings, job.stylizer.job.views.cameras
    try:
        write_views(path, job.scene_file.scene, cameras, background=settings.background, near=settings.near)
    except OutputError as error:
        warn(f"The images of the views could not be written: {error}")


class _ReportedSteps:
    """Progress callback for `loop.Callbacks.progress`, which also reports the views of quality checks after a step."""

    def __init__(self, report: Callable[[Progress], None]) -> None:
        self._report = report
        self._latest: Progress | None = None
        self._at = 0.0

    def __call__(self, now: Progress) -> None:
        """Report a step."""
        self._latest, self._at = now, time.monotonic()
        self._report(now)

    def end_early(self, seconds: float) -> None:
        """Report the remaining seconds of a job without its remaining steps; ignored before the first step."""
        if self._latest is not None:
            self(self._latest.model_copy(update={"stage": "measuring", "eta_s": seconds}))

    def show_views(self, done: int, total: int) -> None:
        """Report the views of a quality check; ignored before the first step."""
        if self._latest is not None:
            left = max((self._latest.eta_s or 0.0) - (time.monotonic() - self._at), 0.0)
            checked = {"stage": "measuring", "eta_s": left, "views_checked": done, "views_to_check": total}
            self._report(self._latest.model_copy(update=checked))


class _CheckpointWriter:
    """Checkpoint callback for `loop.Callbacks.checkpoint`.

    Attributes:
        error: Error of the last attempt to write a checkpoint; None if it succeeded.
    """

    def __init__(self, job: Job, run_id: str, listener: Listener) -> None:
        self._job, self._run_id = job, run_id
        self._listener = listener
        self.error: OutputError | None = None

    def __call__(self, stylizer: Stylizer) -> None:
        """Write a checkpoint; if that fails, warn and store the error."""
        job = self._job
        self.error = None
        checkpoint = Checkpoint(stylizer.state(), stylizer.job.plan, job.planned_ranks, self._run_id, versions())
        try:
            save_checkpoint(job.outputs.checkpoint, checkpoint, job.fingerprint)
            self._listener.saved(stylizer.step)
        except OutputError as error:
            self.error = error
            self._listener.warn(f"The checkpoint could not be written: {error}")


def _finish(job: Job, stopped: Stopped, measure: Measurements, left: SecondsLeft | None) -> Result:
    """Write the PLY, then all other outputs.

    Novel views are left out if a time budget has no time for them, or the user has ended the run, and waits.

    Every rank must call this function.
    """
    stylizer, outputs = job.stylizer, job.outputs
    first = stylizer.job.collectives.rank == 0
    _count_remaining(job, "other")
    attenuation, pad_sh = stylizer.job.settings.sh_attenuation, job.request.pad_sh
    stylizer.job.collectives.broadcast(
        lambda: write_stylized(
            job.scene_file, outputs.ply, stylizer.stylized(), sh_attenuation=attenuation, pad_sh=pad_sh
        )
    )
    compressed = stylizer.job.collectives.broadcast(lambda: _write_compressed(job))
    if first and stopped not in CONTINUABLE:
        outputs.checkpoint.unlink(missing_ok=True)
    if stylizer.job.collectives.broadcast(lambda: stopped != "on-request" and (left is None or left() > 0)):
        measure.at_the_end()
    # The initial loss is evaluated here, because evaluating it before the first step would delay the job.
    before = measure.start()
    weights = stylizer.job.loss.weights
    after = round_evaluation(stylizer.history, stylizer.job.round_length, weights)
    error = _write_reports(job, stopped, before, after, compressed) if first else None
    return Result(
        stopped=stopped,
        steps=stylizer.step,
        total=stylizer.job.total_steps,
        loss_before=mean_loss(on_scales_of(after, before), weights),
        loss_after=mean_loss(after, weights),
        report_error=str(error) if error else None,
        compressed=compressed and compressed.text("the PLY"),
        loss_views=len(stylizer.job.evaluation_views),
        loss_over_time=loss_over_time(stylizer, before, stopped),
    )


def _count_remaining(job: Job, part: str) -> None:
    """Count the seconds of the job that are not in other parts for this one."""
    parts = job.stylizer.seconds_by_part
    parts[part] = max(job.seconds - sum(seconds for name, seconds in parts.items() if name != part), 0.0)


def _has_rows_of_file(job: Job) -> bool:
    """Return whether the job's Gaussians are the rows of the scene's file: none was dropped or split."""
    return job.scene_file.retained is None and job.scene_file.copies is None


def _write_compressed(job: Job) -> CompressionLoss | None:
    """Write the stylized scene in a compressed format beside the PLY, and measure the loss of quality."""
    path, format, stylizer = job.outputs.compressed, job.outputs.compressed_format, job.stylizer
    if path is None or format is None:
        return None
    scene = replace(stylizer.job.scene, sh_dc=stylizer.stylized().detach().to("cpu", torch.float32))
    if format is STREAMED_SOG:
        write_levels(path, scene, job.scene_file.path)
    else:
        write_scene(path, scene, format, job.scene_file.axes)
    settings, cameras = stylizer.job.settings, stylizer.job.views.cameras
    return measure_compression(
        path, scene, cameras, background=settings.background, near=settings.near, axes=job.scene_file.axes
    )


def _write_reports(
    job: Job, stopped: Stopped, before: Evaluation, after: Evaluation, compressed: CompressionLoss | None
) -> Exception | None:
    """Write the reports beside the PLY. Return an error instead of raising it, because the PLY is already written."""
    stylizer, outputs = job.stylizer, job.outputs
    try:
        # Matplotlib scans all fonts when it is first imported on a machine, for which no step should wait.
        from sgsst_core.report.charts import write_loss_chart
        from sgsst_core.report.page import write_page

        attenuated = stylizer.job.settings.sh_attenuation and job.scene_file.scene.sh_degree
        if job.request.colors and _has_rows_of_file(job) and not attenuated:  # only f_dc changes
            write_colors(outputs.colors, stylizer.stylized())
        near, survey = stylizer.job.settings.near, stylizer.job.plan.survey
        findings = findings_of(
            job.scene_file, stylizer.job.views.cameras, stylizer.job.styles.own, near=near, survey=survey
        )
        _count_remaining(job, "writing")
        report = build_report(stylizer, job.sources, stopped, before, after, findings)
        report |= seconds_json(stylizer, job.seconds)
        lost = sum(attempt["seconds_lost"] for attempt in job.workers["attempts"])
        report["compressed"] = compressed and compressed.as_dict()
        report["workers"] = {**job.workers, "seconds_lost": round(lost, 3)}
        write_json(outputs.report, report)
        write_contact_sheet(outputs.sheet, stylizer)
        write_loss_chart(outputs.curves, report)
        write_page(outputs.page, report, outputs.sheet, outputs.views if outputs.views.exists() else None)
        _count_remaining(job, "writing")  # now with the time of the figures and the page
        report |= seconds_json(stylizer, job.seconds)
        write_json(outputs.report, report)
    except Exception as error:  # a failing report must not fail the job
        return error
    return None
