"""One stylization from its files to its files, on one rank or several: read and check every input, run, write.

Every rank goes through the same functions; the first one alone writes, and is told what to show. Nothing is printed.
"""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import torch
from torch import Tensor

from sgsst_core.errors import CheckpointError, OutputError, SettingsError, SgsstError
from sgsst_core.features.network_weights import BackboneWeights, load_weights
from sgsst_core.files.atomic import remove_leftovers
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import check_photos, load_image, load_photo
from sgsst_core.files.json_files import write_json
from sgsst_core.files.ply import SceneFile, write_stylized
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.planner import make_plan
from sgsst_core.planning.probe import common_device
from sgsst_core.planning.progress import ShowPlanning
from sgsst_core.quality.findings import findings_of
from sgsst_core.quality.measure import Measurements
from sgsst_core.report.charts import write_loss_chart
from sgsst_core.report.contact_sheet import write_contact_sheet
from sgsst_core.report.document import Sources, bought, build_report, plan_json
from sgsst_core.report.page import write_page
from sgsst_core.scene.camera import Camera, fit_cameras, orbit, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.stylizing.checkpoint import Checkpoint, fingerprint, versions
from sgsst_core.stylizing.evaluation import Evaluation
from sgsst_core.stylizing.loop import Callbacks, Progress, Stopped, run
from sgsst_core.stylizing.stylizer import Stylizer
from worker.ranks.geometry import read_shared_scene
from worker.request import Outputs, Resume, SceneRequest, StylizeRequest, check_request

T = TypeVar("T")

Warn = Callable[[str], None]

#: Seconds between checkpoints, unless told otherwise: what a lost rank costs at most.
CHECKPOINT_SECONDS = 60.0


@dataclass
class Job:
    """A job whose inputs have all been read and checked.

    Attributes:
        resumed: checkpoint to go on from; None starts from the beginning.
        planned_ranks: that there were when the plan was made.
        workers: who takes part, and what happened to earlier attempts; for the report.
    """

    request: StylizeRequest
    outputs: Outputs
    scene_file: SceneFile
    style: Tensor
    sources: Sources
    stylizer: Stylizer
    fingerprint: str
    resumed: Checkpoint | None
    planned_ranks: int
    workers: dict[str, Any]


@dataclass(frozen=True)
class Prepared:
    """What there is to tell before the first step.

    Attributes:
        lines: pairs of a heading and a line, see `describe`.
        step: at which the job starts; more than 0 after a resume.
        total: of all steps.
    """

    lines: list[tuple[str, str]]
    step: int
    total: int


@dataclass(frozen=True)
class Result:
    """How a job ended.

    Attributes:
        stopped: see `run`; where it is "interrupted", only the checkpoint was written.
        step, total: that were done, and planned.
        before, after: loss on the evaluation views; `after` is empty where the job was interrupted.
        bought: what error the time bought (`report.bought`).
        report_error: why report, contact sheet or curves are missing; None if they are not.
    """

    stopped: Stopped
    step: int
    total: int
    before: Evaluation
    after: Evaluation
    bought: dict[str, Any] | None = None
    report_error: str | None = None


def prepare(
    request: StylizeRequest,
    *,
    collectives: Collectives = ALONE,
    resume: Resume | None = None,
    warn: Warn = lambda line: None,
    show_planning: ShowPlanning | None = None,
) -> Job:
    """Read and check every input, and plan; nothing is written. Every rank calls this.

    Args:
        collectives: of all ranks.
        resume: None for what the request says.
        warn: told of checkpoints that cannot be used.
        show_planning: told how far the survey of the views has come; not used where a checkpoint has one.

    Raises:
        InvalidInputError: in one of its forms, for the first input that cannot be used; the same on every rank.
        RankLeftOut: the job goes on without this rank.
    """
    outputs = collectives.broadcast(lambda: check_request(request))
    weights = _same_weights(request.backbone, collectives)
    style = together(collectives, lambda: load_image(request.style))
    source = request.source
    scene_file, reader = read_shared_scene(source.scene, collectives, drop_invalid=source.drop_invalid)
    settings = request.settings
    cameras = together(collectives, lambda: fit_cameras(read_cameras_of(request.source, scene_file.scene), settings))
    images = request.images
    photos = together(collectives, lambda: check_photos(images, cameras)) if images else None
    stamps = collectives.broadcast(lambda: repr([_stamp(path) for path in photos]) if photos else "")
    own_id = fingerprint(scene_file.scene, cameras, style, settings, weights.sha256, stamps) if reader else None
    job_id = _same_inputs(own_id, collectives)
    resume = resume or Resume(request.resume)
    resumed = collectives.broadcast(lambda: _resumed(outputs, job_id, settings, resume, warn))
    if resumed and not settings.memory_limit:
        settings = settings.model_copy(update={"memory_limit": resumed.state.memory})
    plan, workshop, planned_ranks = _usable_plan(resumed, collectives), None, collectives.size
    if plan is not None and resumed is not None:
        planned_ranks = resumed.ranks
    else:
        plan, workshop = make_plan(
            scene_file.scene,
            cameras,
            settings,
            weights=weights,
            collectives=collectives,
            looked=resumed.plan.survey if resumed else None,
            measured=True,
            show=show_planning,
        )
    stylizer = Stylizer(
        plan,
        scene_file.scene,
        cameras,
        style,
        settings,
        weights=weights,
        photos=(lambda index: load_photo(photos[index], cameras[index])) if photos else None,
        collectives=collectives,
        workshop=workshop,
    )
    sources = Sources(source.scene, scene_file.dropped, request.style, source.cameras, images, weights)
    workers = {"asked": collectives.size, **_workers_used(stylizer), "attempts": []}
    return Job(request, outputs, scene_file, style, sources, stylizer, job_id, resumed, planned_ranks, workers)


def _usable_plan(resumed: Checkpoint | None, collectives: Collectives) -> Plan | None:
    """The plan of a resumed job; None where there is none, or where it was made for another device.

    Nor can a plan made for fewer ranks say what more of them are good for.
    """
    if resumed is None or collectives.size > resumed.ranks:
        return None
    return resumed.plan if resumed.plan.device == common_device(collectives) else None


def together(collectives: Collectives, make: Callable[[], T]) -> T:
    """What `make` returns on this rank, once it has succeeded on every rank.

    Raises:
        SgsstError: of the first rank on which it was raised, on every rank.
    """
    value, error = None, None
    try:
        value = make()
    except SgsstError as own:
        error = own
    for found in collectives.all_gather(error):
        if found is not None:
            raise found
    return value  # type: ignore[return-value]


def _same_weights(backbone: str, collectives: Collectives) -> BackboneWeights:
    """The feature network's weights: those that the first rank finds, on every rank."""
    name = collectives.broadcast(lambda: load_weights(backbone).name)
    return together(collectives, lambda: load_weights(name))


def _same_inputs(own: str | None, collectives: Collectives) -> str:
    """The job's fingerprint, once everybody who has read the scene has found the same.

    Args:
        own: this rank's; None where another rank of the same machine has read the scene for it.
    """
    found = collectives.all_gather((own, socket.gethostname()))
    for other, host in found:
        if other is not None and other != found[0][0]:
            raise SettingsError(
                f"The files of this job are not the same on {found[0][1]} and {host}: scene, cameras, style or weights "
                "differ. Give paths on a file system that all machines share."
            )
    assert found[0][0] is not None  # the first rank reads for itself
    return found[0][0]


def _workers_used(stylizer: Stylizer) -> dict[str, Any]:
    device = stylizer.network.device
    own = {
        "host": socket.gethostname(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "cpu",
        "threads": torch.get_num_threads(),
    }
    ranks = stylizer.collectives.all_gather(own)
    return {"used": len(ranks), "ranks": ranks}


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
    stylizer, outputs = job.stylizer, job.outputs
    collectives = stylizer.collectives
    first = collectives.rank == 0
    measure = Measurements(stylizer)
    before = job.resumed.before if job.resumed else measure.evaluate(unstylized=True)
    if job.resumed:
        stylizer.load_state(job.resumed.state)
    if first:
        outputs.ply.parent.mkdir(parents=True, exist_ok=True)
        for path in outputs.all:
            remove_leftovers(path)  # of an attempt that was killed
    unsaved: list[OutputError] = []
    run_id = run_id or secrets.token_hex(8)

    def checkpoint(current: Stylizer) -> None:
        unsaved.clear()
        kept = Checkpoint(current.state(), current.plan, job.planned_ranks, before, run_id, versions())
        try:
            outputs.checkpoints.save(kept, job.fingerprint)
            saved(current.step)
        except OutputError as error:
            unsaved.append(error)
            warn(f"No checkpoint could be written: {error}")

    collectives.broadcast(lambda: write_json(outputs.plan, plan_json(stylizer.plan)))
    callbacks = Callbacks(measure=measure, moments=measure.moments, checkpoint_seconds=checkpoint_seconds)
    if first:
        callbacks.progress, callbacks.stop = progress, stop
        callbacks.checkpoint, callbacks.preview = checkpoint, preview
        callbacks.preview_seconds = 0.0  # when it is time for one, it knows itself
    stopped = run(stylizer, callbacks)
    if stopped == "interrupted":
        if unsaved:
            raise unsaved[0]
        return Result(stopped, stylizer.step, stylizer.total, before, {})
    collectives.broadcast(lambda: write_stylized(job.scene_file, outputs.ply, stylizer.stylized()))
    if first and stopped != "max-seconds":
        outputs.checkpoints.remove()
    if stylizer.measured[-1]["step"] != stylizer.step:
        measure(stylizer)
    after = measure.evaluate()
    error = _write_reports(job, stopped, before, after) if first else None
    found = bought(stylizer, before)
    return Result(stopped, stylizer.step, stylizer.total, before, after, found, str(error) if error else None)


def _write_reports(job: Job, stopped: Stopped, before: Evaluation, after: Evaluation) -> Exception | None:
    """Write what lies beside the PLY; returns what went wrong, since the scene itself is there."""
    stylizer, outputs = job.stylizer, job.outputs
    try:
        near = stylizer.settings.near
        findings = findings_of(job.scene_file, stylizer.views.cameras, stylizer.style, near=near)
        report = build_report(stylizer, job.sources, stopped, before, after, findings)
        lost = sum(attempt["seconds_lost"] for attempt in job.workers["attempts"])
        report["workers"] = {**job.workers, "seconds_lost": round(lost, 3)}
        write_json(outputs.report, report)
        write_contact_sheet(outputs.sheet, stylizer)
        write_loss_chart(outputs.curves, report)
        write_page(outputs.page, report, outputs.sheet)
    except Exception as error:  # whatever it is, it must not look as if the job itself had failed
        return error
    return None


def describe(job: Job) -> Prepared:
    """What was decided, for the user to read before the work starts."""
    stylizer, settings = job.stylizer, job.stylizer.settings
    lines = [("scene", _describe_scene(job)), ("views", _describe_views(job)), ("network", _describe_network(job))]
    lines += [(decision.item, f"{decision.decision}: {decision.reason}") for decision in stylizer.plan.decisions]
    rate = f"learning rate {settings.learning_rate:g}"
    if settings.learning_rate_end != settings.learning_rate:
        rate += f" to {settings.learning_rate_end:g}"
    steps = f"{stylizer.plan.steps_coarse} steps on the coarsest scale, then {settings.steps_sos} on all"
    if not stylizer.plan.steps_coarse:
        steps = f"{settings.steps_sos} steps"
    lines.append(("schedule", f"{steps}; {rate} (preset {settings.preset})"))
    if job.resumed:
        lines.append(("resuming", f"at step {job.resumed.state.step} of {stylizer.total}"))
    elif job.outputs.checkpoints.exist:
        note = f"{job.outputs.checkpoint} of an earlier run is there. This run starts anew and will replace it; "
        lines.append(("note", note + "--resume would go on from it."))
    return Prepared(lines, job.resumed.state.step if job.resumed else 0, stylizer.total)


def _describe_scene(job: Job) -> str:
    scene = job.scene_file.scene
    dropped = f", {job.scene_file.dropped:,} invalid ones left out" if job.scene_file.dropped else ""
    return f"{len(scene):,} Gaussians{dropped}, SH degree {scene.sh_degree}"


def _describe_views(job: Job) -> str:
    views = job.stylizer.views
    sizes = sorted({(camera.width, camera.height) for camera in views.cameras})
    text = f"{len(views)} of {sizes[0][0]}x{sizes[0][1]}"
    if len(sizes) > 1:
        text = f"{len(views)} of {len(sizes)} sizes, {sizes[0][0]}x{sizes[0][1]} to {sizes[-1][0]}x{sizes[-1][1]}"
    scales = max(job.stylizer.loss.scale_count(height, width) for width, height in sizes)
    text += f", {scales} scale{'s' if scales > 1 else ''}"
    return text + f"; content from {'the photos' if job.request.images else 'unstylized renders'}"


def _describe_network(job: Job) -> str:
    name = job.sources.backbone.name.upper()
    if job.request.backbone == "auto" and name == "VGG16":
        return f"{name}, because VGG19 (the paper's) is not installed: `sgsst weights fetch vgg19` gets it"
    return name


def read_cameras_of(source: SceneRequest, scene: Scene) -> list[Camera]:
    """The cameras that were asked for, at their resolution."""
    if source.cameras is not None:
        cameras = read_cameras(source.cameras)
    else:
        axis = [float(name == source.up[-1]) * (-1.0 if source.up.startswith("-") else 1.0) for name in "xyz"]
        cameras = orbit(scene, source.orbit or 0, up=axis, near=source.near)
    if source.views is not None:
        cameras = spread(cameras, source.views)
    if source.resolution is not None:
        cameras = [resized(camera, source.resolution) for camera in cameras]
    return cameras


def _stamp(path: Path) -> tuple[str, int, int]:
    status = path.stat()
    return path.name, status.st_size, status.st_mtime_ns


def _resumed(outputs: Outputs, job_id: str, settings: Settings, resume: Resume, warn: Warn) -> Checkpoint | None:
    """The checkpoint to go on from; None to start from the beginning."""
    if not resume.wanted:
        return None
    checkpoints = outputs.checkpoints
    if resume.required and not checkpoints.exist and outputs.ply.exists():
        raise CheckpointError(
            f"{outputs.ply}: is there, and no checkpoint beside it, so this job is finished. To start again, leave "
            "--resume out."
        )
    try:
        found = checkpoints.load(job_id, warn, resume.run)
    except CheckpointError:
        if resume.required:
            raise
        return None
    if resume.required and settings.max_seconds and found.state.seconds >= settings.max_seconds:
        raise CheckpointError(
            f"{outputs.checkpoint}: the job has run for {found.state.seconds:.0f} s already, and --max-seconds counts "
            f"these too. Give more than {found.state.seconds:.0f}, or leave --max-seconds out."
        )
    if found.written_by["torch"] != torch.__version__:
        warn(f"The checkpoint was written with PyTorch {found.written_by['torch']}: last digits may differ.")
    return found
