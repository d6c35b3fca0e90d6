"""Preparation of a job: read and check all inputs, find the checkpoint to resume from, and plan the work.

Every rank calls the same functions. Nothing is printed, and nothing is written but the first preview.

Preview images of a running job, and its colors for clients that watch it in 3D.
"""

from __future__ import annotations

import contextlib
import json
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
from sgsst_core.errors import CheckpointError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.files.images import save_jpg
from sgsst_core.files.scene_file import SceneFile, write_scene
from sgsst_core.files.stylized_ply import write_colors
from sgsst_core.loss.feature_scale import weights_for
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.plan import LOSS_VIEWS, Plan, common_device, rasterizer_problem
from sgsst_core.planning.survey import ShowPlanning
from sgsst_core.planning.time_budget import SecondsLeft, TimeChoice
from sgsst_core.rasterizer import RASTERIZERS
from sgsst_core.report.document import Sources
from sgsst_core.scene.camera import resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.stylizing.checkpoint import Checkpoint, load_checkpoint, load_plan, save_plan, versions
from sgsst_core.stylizing.job import JobInputs, StylizationJob, choose_within, plan_job
from sgsst_core.stylizing.refining import refine
from sgsst_core.stylizing.stylizer import Stylizer, render_first_view, transferred_colors
from worker.inputs import Inputs, fingerprint_of, read_inputs, same_weights, together
from worker.job import JobSpec, Resume
from worker.outputs import Outputs, check_request

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
    preview: Previews | None = None,
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
    known: Checkpoint | _HandedOver | None = resumed
    if plan_file and not resumed:
        known = collectives.broadcast(lambda: _handed_over(plan_file, fingerprint, inputs, settings))
    chosen = known.plan.time_choice if known else None
    if not known:
        with timer("planning"):
            chosen = left and choose_within(_job_inputs(inputs, settings, weights), left, collectives)
    asked, settings = settings, chosen.applied(settings) if chosen else settings
    inputs = inputs.chosen(chosen, settings) if chosen else inputs
    refinement, scene_file = known.plan.refinement if known else None, inputs.scene_file
    if settings.growth > 1:
        with timer("refining"):
            of_job = _job_inputs(inputs, settings, weights)
            refinement = refinement if known else refine(of_job, collectives=collectives, show=show_planning)
            scene_file = together(collectives, lambda: inputs.scene_file.refined(refinement))
    plan = _usable_plan(known, collectives)
    if known and not plan and known.plan.device == common_device(collectives):
        asked = asked.model_copy(update={"precision": known.plan.precision})  # a job has one precision
    planned_ranks = known.ranks if known and plan else collectives.size
    of_job = _job_inputs(inputs, asked, weights, chosen).refined(refinement, scene_file.scene)
    stylization = plan_job(
        replace(of_job, photos=inputs.photo_loader(settings.background)),
        plan=plan,
        collectives=collectives,
        survey=known.plan.survey if known else None,
        groups=resumed.plan.groups if resumed else None,
        show=show_planning,
        timer=timer,
    )
    with timer("preparing"):
        stylizer = Stylizer(stylization)
    stylizer.seconds_by_part.update(({"start": start} if start else {}) | timer.seconds)
    source, images = request.source, request.images
    styles = tuple(file.path for file in request.styles)
    sources = Sources(source.scene, scene_file.dropped, styles, source.cameras, images, weights)
    workers = {"requested": collectives.size, **_workers_used(stylizer), "attempts": []}
    return Job(request, outputs, scene_file, sources, stylizer, fingerprint, resumed, planned_ranks, workers, started)


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


@dataclass(frozen=True)
class _HandedOver:
    """Plan that a dry run has handed over.

    Attributes:
        ranks: Number of ranks for which it was made; 0 if only its survey and its refinement can be used here.
    """

    plan: Plan
    ranks: int


def _handed_over(file: Path, fingerprint: str, inputs: Inputs, settings: Settings) -> _HandedOver | None:
    """Return the plan of a dry run of the same job; None if there is none.

    The fingerprint covers the content of all inputs, and the settings that determine the course of the job. A plan
    holds for the same settings, machine and versions alone; otherwise, only its survey is used.
    """
    try:
        plan, conditions = load_plan(file, fingerprint, inputs.scene_file.scene, inputs.cameras)
    except CheckpointError:
        return None
    return _HandedOver(plan, int(conditions == _conditions(settings)))


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


def _usable_plan(known: Checkpoint | _HandedOver | None, collectives: Collectives) -> Plan | None:
    """Return the plan that is known already; None if there is none or it cannot be used on this machine.

    A plan made for another device or for fewer ranks cannot be used. If the plan uses a GPU rasterizer, its kernels are
    compiled and checked here: compiling may take longer than ranks wait for each other during a step.
    """
    if known is None or collectives.size > known.ranks:
        return None
    plan = known.plan
    if plan.device != common_device(collectives):
        return None
    on_gpu = RASTERIZERS[plan.uncached].on_gpu
    return None if on_gpu and rasterizer_problem(collectives, plan.uncached) else plan


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
    lines = [
        ("scene", describe_scene(job.scene_file)),
        ("views", _describe_views(job)),
        ("network", _describe_network(job)),
    ]
    lines += [(decision.item, f"{decision.decision}: {decision.reason}") for decision in stylizer.job.plan.decisions]
    rate = f"learning rate {settings.learning_rate:g}"
    if settings.learning_rate_end != settings.learning_rate:
        rate += f" to {settings.learning_rate_end:g}"
    steps = f"{stylizer.job.plan.steps_coarse} steps on the coarsest scale, then {settings.steps_sos} on all"
    if not stylizer.job.plan.steps_coarse:
        steps = f"{settings.steps_sos} steps"
    lines.append(("schedule", f"{steps}; {rate} (preset {settings.preset})"))
    if job.resumed:
        lines.append(("resuming", f"at step {job.resumed.state.step} of {stylizer.job.total_steps}"))
    elif job.outputs.checkpoint.exists():
        note = (
            f"{job.outputs.checkpoint} exists from an earlier run. This run starts from the beginning and replaces it; "
        )
        lines.append(("note", note + "use --resume to continue from it."))
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
    text = f"{len(cameras)} of {sizes[0][0]}x{sizes[0][1]}"
    if len(sizes) > 1:
        text = f"{len(cameras)} of {len(sizes)} sizes, {sizes[0][0]}x{sizes[0][1]} to {sizes[-1][0]}x{sizes[-1][1]}"
    tiling = job.stylizer.job.loss.tiling
    scales = max(tiling.scale_count((height, width)) for width, height in sizes)
    chosen = max(len(tiling.scales((height, width))) for width, height in sizes)
    text += f", {f'{chosen} of ' if chosen < scales else ''}{scales} scale{'s' if scales > 1 else ''}"
    return text + f"; content from {'the photos' if job.request.images else 'unstylized renders'}"


def _describe_network(job: Job) -> str:
    name = job.sources.backbone.name.upper()
    if job.request.backbone == "auto" and name == "VGG16":
        return f"{name}, because VGG19 (the paper's) is not installed; install it with `sgsst weights fetch vgg19`"
    return name


#: Minimum time between two previews, as a fraction of the job's elapsed time. It limits the number of previews.
_SHARE = 0.05
#: Minimum time between a job's first previews, which differ most, in seconds and as a fraction of the elapsed time.
_FIRST_SECONDS, _FIRST_SHARE = 2.0, 0.1
#: Maximum length of a preview's longer side in pixels.
_SIDE = 960
#: Maximum length of the thumbnail's longer side in pixels.
_THUMBNAIL_SIDE = 480
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

    Args:
        folder: Folder of the JPEGs (`step_0000123.jpg`). It is created with the first preview. Colors are written to
            the folder `live` beside it.
        seconds: Minimum seconds between two previews, except for the first ones.
        warn: Callback that receives the reason why a preview is missing. A missing preview does not fail the job.
    """

    def __init__(self, folder: Path, seconds: float, warn: Callable[[str], None]) -> None:
        self._folder = folder
        self._seconds = seconds
        self._warn = warn
        self._started = time.monotonic()
        #: Time of the last preview; None before the first.
        self._last: float | None = None
        self.live = LiveColors(folder.parent / "live", warn)

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
        self.live(stylizer)
        now, last = time.monotonic(), self._last
        elapsed = now - self._started
        wait = max(min(self._seconds, max(_FIRST_SECONDS, _FIRST_SHARE * elapsed)), _SHARE * elapsed)
        if last is not None and (not stylizer.step or now - last < wait):
            return
        self._write(stylizer.step, lambda: _rendered(stylizer, _colors(stylizer), _SIDE))

    def finish(self, stylizer: Stylizer) -> None:
        """Write the thumbnail of a finished job: a view whose left half is unstylized. It replaces the previews."""
        with _warning(self._warn, "The thumbnail could not be rendered"):
            before = _rendered(stylizer, stylizer.job.views.scene.sh_dc.to(stylizer.sh_dc.device), _THUMBNAIL_SIDE)
            after = _rendered(stylizer, stylizer.shown(), _THUMBNAIL_SIDE)
            save_thumbnail(self._folder, before, after)

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


class LiveColors:
    """Writer of a job's current colors (`colors.f16`), each time in place of the former ones.

    Gaussians that no view shows have their original colors, because theirs are computed only at the end.

    Args:
        folder: Folder of the files. It is created with the first one.
        warn: Callback that receives the reason why a file is missing. A missing file does not fail the job.
    """

    def __init__(self, folder: Path, warn: Callable[[str], None]) -> None:
        self._folder = folder
        self._warn = warn
        self._started = self._due = time.monotonic()

    def share_scene(self, scene: Scene) -> None:
        """Write the scene to which the colors belong (`scene.ply`), whose rows are not those of the job's input."""
        with _warning(self._warn, _NO_COLORS):
            write_scene(_created(self._folder) / "scene.ply", scene)

    def __call__(self, stylizer: Stylizer) -> None:
        """Write the colors after a step if enough time has passed since the last time."""
        started = time.monotonic()
        if not stylizer.step or started < self._due:
            return
        with _warning(self._warn, _NO_COLORS):
            colors = stylizer.job.scene.sh_dc.clone()
            colors[stylizer.job.plan.seen] = stylizer.shown().cpu()
            write_colors(_created(self._folder) / "colors.f16", colors)
        now = time.monotonic()
        self._due = now + max(_COLOR_SECONDS, _COLOR_SHARE * (now - self._started), (now - started) / _COST_SHARE)
