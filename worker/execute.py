"""One job on one rank: read and check all inputs, plan the work or resume it, run all steps, and write the outputs.

Every rank calls the same functions. Until the steps start, nothing is printed, and nothing is written but the first
preview.
"""

import contextlib
import json
import secrets
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sgsst_core import container
from sgsst_core.devices import Timer
from sgsst_core.errors import CheckpointError, OutputError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.features.vgg import weights_for
from sgsst_core.files.atomic import remove_leftovers, write_json
from sgsst_core.files.formats.sog import STREAMED_SOG
from sgsst_core.files.images import save_jpg
from sgsst_core.files.scene_file import (
    SceneFile,
    write_colors,
    write_levels,
    write_scene,
    write_stylized,
)
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.planning.plan import LOSS_VIEWS, Plan, common_device, rasterizer_problem
from sgsst_core.planning.survey import ShowPlanning
from sgsst_core.planning.time_budget import SecondsLeft, TimeChoice
from sgsst_core.progress import Progress
from sgsst_core.quality.findings import findings_of
from sgsst_core.quality.measure import CompressionLoss, Measurements, measure_compression
from sgsst_core.rasterizer import RASTERIZERS
from sgsst_core.report.document import Sources, build_report, loss_over_time, plan_json, seconds_json
from sgsst_core.report.images import write_contact_sheet, write_views
from sgsst_core.scene.camera import resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.stylizing.checkpoint import Checkpoint, load_checkpoint, load_plan, save_checkpoint, save_plan, versions
from sgsst_core.stylizing.job import JobInputs, StylizationJob, choose_within, estimate, plan_job
from sgsst_core.stylizing.loop import Callbacks, Stopped, run
from sgsst_core.stylizing.refining import refine
from sgsst_core.stylizing.stylizer import (
    Evaluation,
    Stylizer,
    mean_loss,
    on_scales_of,
    render_first_view,
    round_evaluation,
    show_nothing,
    transferred_colors,
)
from worker.inputs import Inputs, fingerprint_of, read_inputs, same_weights, together
from worker.job import CONTINUABLE, JobSpec, Outputs, Result, Resume, check_request
from worker.run import Listener, WorkerOptions

Warn = Callable[[str], None]


@dataclass
class Job:
    """Job whose inputs have been read and checked.

    Attributes:
        resumed: Checkpoint to resume from; None to start from the beginning.
        planned_ranks: Number of ranks for which the plan was made.
        workers: Participating ranks and lost attempts, as JSON for the report.
        started: Value of `time.perf_counter` when the job started.
    """

    request: JobSpec
    outputs: Outputs
    scene_file: SceneFile
    sources: Sources
    stylizer: Stylizer
    fingerprint: str
    resumed: Checkpoint | None
    planned_ranks: int
    workers: dict[str, Any]
    started: float

    @property
    def seconds(self) -> float:
        """Seconds since the job started, and those of earlier sessions as far as their parts are known."""
        earlier = self.resumed.state.seconds_by_part.values() if self.resumed else ()
        return time.perf_counter() - self.started + sum(earlier)


def prepare(
    request: JobSpec,
    *,
    collectives: Collectives = ALONE,
    resume: Resume | None = None,
    warn: Warn = lambda line: None,
    show_planning: ShowPlanning | None = None,
    preview: "Previews | None" = None,
    plan_file: Path | None = None,
    left: SecondsLeft | None = None,
    start: float = 0.0,
) -> Job:
    """Read and check all inputs of a job, and plan it. Every rank must call this function.

    Nothing is written but the first preview.

    Args:
        resume: Choice of the checkpoint to resume from; None follows the request.
        warn: Callback for the warning that the checkpoint is of another PyTorch version.
        show_planning: Callback for the progress of planning. It is not called if the checkpoint's plan
            is used.
        preview: Writer of previews, used on rank 0 of a new job; None to write none.
        plan_file: Plan that `dry_run` has handed over; None or a missing file for none.
        left: Seconds left of the time budget, which chooses what the checkpoint or the plan has not; None without one.
        start: Seconds since the start of the job before this call.

    Raises:
        InvalidInputError: If an input cannot be used. Every rank raises the same error.
    """
    started = time.perf_counter() - start
    timer = Timer()  # no CUDA synchronization needed: no GPU work is pending when a phase ends
    outputs = collectives.broadcast(lambda: check_request(request))
    settings = request.settings
    with timer("reading"):
        weights = weights_for(same_weights(request.backbone, collectives), settings)
        inputs = read_inputs(request, collectives)
        fingerprint = fingerprint_of(inputs, settings, weights.sha256, collectives)
    resume = resume or Resume(request.resume)
    resumed = collectives.broadcast(lambda: _find_checkpoint(outputs, fingerprint, resume, warn))
    if resumed and not settings.memory_limit:
        settings = settings.model_copy(update={"memory_limit": resumed.state.memory})
    if preview and not resumed and collectives.rank == 0:
        preview.write_first(inputs, settings)
    known, known_ranks = resumed.plan if resumed else None, resumed.ranks if resumed else 0
    if plan_file and not resumed:
        known, known_ranks = collectives.broadcast(lambda: _handed_over(plan_file, fingerprint, inputs, settings))
    chosen = known.time_choice if known else None
    if not known:
        with timer("planning"):
            chosen = left and choose_within(_job_inputs(inputs, settings, weights), left, collectives)
    asked, settings = settings, chosen.applied(settings) if chosen else settings
    inputs = inputs.chosen(chosen, settings) if chosen else inputs
    refinement, scene_file = known.refinement if known else None, inputs.scene_file
    if settings.growth > 1:
        with timer("refining"):
            of_job = _job_inputs(inputs, settings, weights)
            refinement = refinement if known else refine(of_job, collectives=collectives, show=show_planning)
            scene_file = together(collectives, lambda: inputs.scene_file.refined(refinement))
    plan = known if known and collectives.size <= known_ranks and _is_usable(known, collectives) else None
    if known and not plan and known.device == common_device(collectives):
        asked = asked.model_copy(update={"precision": known.precision})  # a job has one precision
    of_job = _job_inputs(inputs, asked, weights, chosen).refined(refinement, scene_file.scene)
    stylization = plan_job(
        replace(of_job, photos=inputs.photo_loader(settings.background)),
        plan=plan,
        collectives=collectives,
        survey=known.survey if known else None,
        groups=resumed.plan.groups if resumed else None,
        show=show_planning,
        timer=timer,
    )
    with timer("preparing"):
        stylizer = Stylizer(stylization)
    stylizer.seconds_by_part.update(({"start": start} if start else {}) | timer.seconds)
    source, styles = request.source, tuple(file.path for file in request.styles)
    sources = Sources(source.scene, scene_file.dropped, styles, source.cameras, request.images, weights)
    workers = {"requested": collectives.size, **_workers_used(stylizer), "attempts": []}
    ranks = known_ranks if plan else collectives.size
    return Job(request, outputs, scene_file, sources, stylizer, fingerprint, resumed, ranks, workers, started)


def dry_run(
    request: JobSpec,
    inputs: Inputs,
    show: ShowPlanning | None = None,
    hand_over: Path | None = None,
    left: SecondsLeft | None = None,
) -> StylizationJob:
    """Plan a job as `prepare` would on one rank, and return it without its photos.

    Args:
        hand_over: Existing file to write the plan to, for `prepare`; None writes nothing.
        left: Seconds left of the time budget if the job had been started instead; None without one.

    Raises:
        InvalidInputError: If the job cannot be planned.
    """
    settings = request.settings
    weights = weights_for(load_network_weights(request.backbone), settings)
    whole, chosen = inputs, left and choose_within(_job_inputs(inputs, settings, weights), left)
    inputs = inputs.chosen(chosen, chosen.applied(settings)) if chosen else inputs
    of_job = _job_inputs(inputs, settings, weights, chosen)
    job = plan_job(of_job.refined(refine(of_job, show=show)), show=show)
    if hand_over:
        fingerprint = fingerprint_of(whole, settings, weights.sha256, ALONE)
        with contextlib.suppress(OSError):  # a job without this file plans again
            save_plan(hand_over, job.plan, fingerprint, _conditions(settings))
    return job


def _handed_over(file: Path, fingerprint: str, inputs: Inputs, settings: Settings) -> tuple[Plan | None, int]:
    """Return the plan of a dry run of the same job, and the number of ranks for which it was made.

    The plan is None if there is none. The number is 0 if only its survey and its refinement can be used here.

    The fingerprint covers the content of all inputs, and the settings that determine the course of the job. A plan
    holds for the same settings, machine and versions alone; otherwise, only its survey is used.
    """
    try:
        plan, conditions = load_plan(file, fingerprint, inputs.scene_file.scene, inputs.cameras)
    except CheckpointError:
        return None, 0
    return plan, int(conditions == _conditions(settings))


def _conditions(settings: Settings) -> str:
    """Return a text about everything besides the inputs that a plan depends on."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    machine = (socket.gethostname(), *container.memory()[:1], container.cores(), torch.get_num_threads(), device)
    return json.dumps([settings.model_dump(mode="json"), versions(), machine])


def _job_inputs(
    inputs: Inputs, settings: Settings, weights: BackboneWeights, chosen: TimeChoice | None = None
) -> JobInputs:
    """Return the inputs of a job, given the choice of its time budget; without photos."""
    return JobInputs(
        inputs.scene_file.scene, inputs.cameras, inputs.style, settings, weights, regions=inputs.regions,
        measured=True, orbit=inputs.orbit, about_inputs=inputs.decisions, chosen=chosen,
    )  # fmt: skip


def _is_usable(plan: Plan, collectives: Collectives) -> bool:
    """Return whether a plan can be used on these machines; one that was made for another device cannot.

    If it uses a GPU rasterizer, its kernels are compiled and checked here: compiling may take longer than ranks wait
    for each other during a step.
    """
    if plan.device != common_device(collectives):
        return False
    return not RASTERIZERS[plan.uncached].on_gpu or not rasterizer_problem(collectives, plan.uncached)


def _workers_used(stylizer: Stylizer) -> dict[str, Any]:
    device = stylizer.job.network.device
    own = {
        "host": socket.gethostname(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
    }
    ranks = stylizer.job.collectives.all_gather(own)
    return {"used": len(ranks), "ranks": ranks}


def _find_checkpoint(outputs: Outputs, job_id: str, resume: Resume, warn: Warn) -> Checkpoint | None:
    """Return the checkpoint to resume from; None to start from the beginning."""
    if not resume.wanted:
        return None
    if resume.required and not outputs.checkpoint.exists() and outputs.ply.exists():
        raise CheckpointError(
            f"{outputs.ply}: exists without a checkpoint beside it, so this job is finished. To start again, leave "
            "--resume out."
        )
    try:
        checkpoint = load_checkpoint(outputs.checkpoint, job_id, resume.run)
    except CheckpointError:
        if resume.required:
            raise
        return None
    if checkpoint.written_by["torch"] != torch.__version__:
        warn(f"The checkpoint was written with PyTorch {checkpoint.written_by['torch']}: last digits may differ.")
    return checkpoint


@dataclass(frozen=True)
class Prepared:
    """Summary of a job before its first step.

    Attributes:
        lines: Pairs of a heading and a line of text; see `describe`.
        step: Step at which the job starts; more than 0 if it resumes from a checkpoint.
        total: Number of steps of the whole job.
    """

    lines: list[tuple[str, str]]
    step: int
    total: int


def describe(job: Job) -> Prepared:
    """Summarize the inputs and the plan for the user."""
    stylizer, settings = job.stylizer, job.stylizer.job.settings
    network = job.sources.backbone.name.upper()
    if job.request.backbone == "auto" and network == "VGG16":
        network += ", because VGG19 (the paper's) is not installed; install it with `sgsst weights fetch vgg19`"
    lines = [("scene", describe_scene(job.scene_file)), ("views", _describe_views(job)), ("network", network)]
    lines += [(decision.item, f"{decision.decision}: {decision.reason}") for decision in stylizer.job.plan.decisions]
    rates = f"learning rate {settings.learning_rate:g} to {settings.learning_rate_end:g}"
    steps = f"{stylizer.job.plan.steps_coarse} steps on the coarsest scale, then {settings.steps_sos} on all"
    lines.append(("schedule", f"{steps}; {rates} (preset {settings.preset})"))
    if job.resumed:
        lines.append(("resuming", f"at step {job.resumed.state.step} of {stylizer.job.total_steps}"))
    elif job.outputs.checkpoint.exists():
        note = (
            "exists from an earlier run. This run starts from the beginning and replaces it; use --resume to continue"
        )
        lines.append(("note", f"{job.outputs.checkpoint} {note} from it."))
    return Prepared(lines, job.resumed.state.step if job.resumed else 0, stylizer.job.total_steps)


def describe_scene(file: SceneFile) -> str:
    """Return a text about the Gaussians of a file; `about_notes` has what was not read, or not as stored."""
    notes = f", {file.dropped:,} invalid ones dropped" if file.dropped else ""
    if file.clamped:
        notes += f", {file.clamped:,} infinite opacities read as almost 0 or 1"
    return f"{len(file.scene):,} Gaussians{notes}, SH degree {file.scene.sh_degree}"


def _describe_views(job: Job) -> str:
    cameras = job.stylizer.job.views.cameras
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    ends = dict.fromkeys(f"{width}x{height}" for width, height in (sizes[0], sizes[-1]))
    tiling = job.stylizer.job.loss.tiling
    scales = max(len(tiling.scales((height, width))) for width, height in sizes)
    content = "the photos" if job.request.images else "unstylized renders"
    plural = "s" if scales > 1 else ""
    return f"{len(cameras)} of {' to '.join(ends)}, {scales} scale{plural}; content from {content}"


# --- steps and outputs ------------------------------------------------------------------------------------------------


def execute(
    job: Job,
    listener: Listener,
    *,
    preview: "Previews | None" = None,
    checkpoint_seconds: float = WorkerOptions.checkpoint_seconds,
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
            preview.share_scene(stylizer.job.scene)
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
        with contextlib.suppress(OSError):  # on Windows, another program may hold it open
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
        from sgsst_core.report.page import write_loss_chart, write_page

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


# --- previews ---------------------------------------------------------------------------------------------------------

#: Minimum time between two previews, as a fraction of the job's elapsed time. It limits the number of previews.
_SHARE = 0.05
#: Minimum time between a job's first previews, which differ most, in seconds and as a fraction of the elapsed time.
_FIRST_SECONDS, _FIRST_SHARE = 2.0, 0.1
#: Maximum length of a preview's longer side in pixels.
_SIDE = 960
#: Maximum length of the thumbnail's longer side in pixels.
THUMBNAIL_SIDE = 480
#: Name of the thumbnail. Clients show the last preview by name.
_THUMBNAIL = "thumbnail.jpg"
#: Minimum time between two writes of the colors, in seconds and as a fraction of the elapsed time.
_COLOR_SECONDS, _COLOR_SHARE = 2.0, 0.02
#: Maximum fraction of the elapsed time that writing the colors may take.
_COST_SHARE = 0.01
_NO_COLORS = "The colors to watch could not be written"


class Previews:
    """Preview callback for `loop.Callbacks.preview`.

    A preview is a render of one view with the current colors. The first one is written before the job is planned, or
    before the first step on a GPU. It has the colors of a warm start, so that users get a first impression of the
    result within seconds.

    The current colors are written for clients that watch the job in 3D, each time in place of the former ones.
    Gaussians that no view shows have their original colors, because theirs are computed only at the end.

    Args:
        folder: Folder of the JPEGs (`step_0000123.jpg`). It is created with the first preview. Colors (`colors.f16`)
            are written to the folder `live` beside it.
        seconds: Minimum seconds between two previews, except for the first ones.
        warn: Callback that receives the reason why a preview is missing. A missing preview does not fail the job.
    """

    def __init__(self, folder: Path, seconds: float, warn: Callable[[str], None]) -> None:
        self._folder = folder
        self._seconds = seconds
        self._warn = warn
        self._started = self._colors_due = time.monotonic()
        #: Time of the last preview; None before the first.
        self._last: float | None = None
        self._live = folder.parent / "live"

    def write_first(self, inputs: Inputs, settings: Settings) -> None:
        """Write the first preview of a job that has not been planned, unless a GPU will plan it within seconds."""
        if torch.cuda.is_available():
            return
        camera = inputs.cameras[_shown_view(range(len(inputs.cameras)))]
        camera = resized(camera, min(camera.side, _SIDE))
        self._write(
            0, lambda: render_first_view(inputs.scene_file.scene, camera, inputs.style, settings, inputs.regions)
        )

    def __call__(self, stylizer: Stylizer) -> None:
        """Write a preview and the colors, each if enough time has passed since the last time."""
        if stylizer.step and time.monotonic() >= self._colors_due:
            self._write_colors(stylizer)
        now, last = time.monotonic(), self._last
        elapsed = now - self._started
        wait = max(min(self._seconds, max(_FIRST_SECONDS, _FIRST_SHARE * elapsed)), _SHARE * elapsed)
        if last is not None and (not stylizer.step or now - last < wait):
            return
        self._write(stylizer.step, lambda: _rendered(stylizer, _colors(stylizer), _SIDE))

    def finish(self, stylizer: Stylizer) -> None:
        """Write the thumbnail of a finished job: a view whose left half is unstylized. It replaces the previews."""
        with _warning(self._warn, "The thumbnail could not be rendered"):
            before = _rendered(stylizer, stylizer.job.views.scene.sh_dc.to(stylizer.sh_dc.device), THUMBNAIL_SIDE)
            after = _rendered(stylizer, stylizer.shown(), THUMBNAIL_SIDE)
            save_thumbnail(self._folder, before, after)

    def share_scene(self, scene: Scene) -> None:
        """Write the scene to which the colors belong (`scene.ply`), whose rows are not those of the job's input."""
        with _warning(self._warn, _NO_COLORS):
            write_scene(_created(self._live) / "scene.ply", scene)

    def _write_colors(self, stylizer: Stylizer) -> None:
        started = time.monotonic()
        with _warning(self._warn, _NO_COLORS):
            colors = stylizer.job.scene.sh_dc.clone()
            colors[stylizer.job.plan.seen] = stylizer.shown().cpu()
            write_colors(_created(self._live) / "colors.f16", colors)
        now = time.monotonic()
        wait = max(_COLOR_SECONDS, _COLOR_SHARE * (now - self._started), (now - started) / _COST_SHARE)
        self._colors_due = now + wait

    def _write(self, step: int, render: Callable[[], Tensor | None]) -> None:
        """Write the preview of a step, if there is an image to write."""
        with _warning(self._warn, "The preview could not be rendered"):
            image = render()
            if image is None:
                return
            save_jpg(_created(self._folder) / f"step_{step:07d}.jpg", image)
        self._last = time.monotonic()


@contextlib.contextmanager
def _warning(warn: Warn, text: str) -> Iterator[None]:
    """Warn of an error in the block instead of raising it."""
    try:
        yield
    except Exception as error:
        warn(f"{text}: {error}")


def _created(folder: Path) -> Path:
    """Create a folder if it does not exist, and return it."""
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def save_thumbnail(folder: Path, before: Tensor, after: Tensor) -> None:
    """Write the thumbnail of a job to its folder of previews, given two images [h, w, 3] of one view."""
    middle = before.shape[1] // 2
    save_jpg(_created(folder) / _THUMBNAIL, torch.cat([before[:, :middle], after[:, middle:]], dim=1))


def _shown_view(covered: Sequence[int]) -> int:
    """Return the index of the view that previews show, given those of the views that see anything.

    It is the first of those on which the loss is evaluated, if there is time for all of these.
    """
    return spread(covered, LOSS_VIEWS)[0]


def _colors(stylizer: Stylizer) -> Tensor:
    """Return the colors [n, 3] of a preview: before the first step, those of a warm start even if the job has none."""
    return stylizer.shown() if stylizer.step else transferred_colors(stylizer.job).to(stylizer.sh_dc.device)


def _rendered(stylizer: Stylizer, colors: Tensor, side: int) -> Tensor:
    """Render the view that previews show with colors [n, 3] at a limited size, on this rank alone."""
    views = stylizer.job.views
    index = _shown_view(views.covered)
    camera = views.cameras[index]
    camera = resized(camera, min(camera.side, side))
    with torch.no_grad():
        return views.rasterizer.render(views.colors(index, colors), camera)
