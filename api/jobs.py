"""What the commands do: read and check every input, run, write every output. Prints nothing."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from torch import Tensor

from sgsst_core.camera import Camera, orbit, resized, spread
from sgsst_core.camera_files import read_cameras
from sgsst_core.check import Finding, check_scene, check_style, check_views
from sgsst_core.checkpoint import fingerprint, load_checkpoint, save_checkpoint
from sgsst_core.errors import CameraError, CheckpointError, OutputError, SettingsError
from sgsst_core.files import ensure_writable_folder
from sgsst_core.images import check_photos, load_image, load_photo, save_png
from sgsst_core.loop import Callbacks, Progress, Stopped, run
from sgsst_core.measure import Measurements, with_measuring
from sgsst_core.planner import Plan
from sgsst_core.ply import SceneFile, read_scene, write_stylized
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.report import (
    Sources,
    build_report,
    plan_json,
    write_contact_sheet,
    write_json,
    write_loss_curves,
)
from sgsst_core.report_page import write_page
from sgsst_core.scene import Scene
from sgsst_core.settings import Settings
from sgsst_core.spherical_harmonics import rest_colours, view_colours
from sgsst_core.stylizer import Evaluation, Stylizer, StylizerState, fit_cameras
from sgsst_core.survey import SEEN_COVERAGE
from sgsst_core.weights import load_weights

Up = Literal["x", "-x", "y", "-y", "z", "-z"]
Warn = Callable[[str], None]


@dataclass(frozen=True)
class SceneRequest:
    """A scene and the cameras to see it with, as the user names them.

    Attributes:
        scene: 3DGS PLY.
        cameras: camera file or folder; None for an orbit.
        orbit: number of views of a ring around the scene; None for `cameras`.
        up: world axis that points up, for the orbit.
        views: how many of the cameras to take, spread evenly; None for all.
        resolution: pixels of every view's longer side; None for the cameras' own.
        near: near plane, world units.
        drop_invalid: leave Gaussians with non-finite values out.
    """

    scene: Path
    cameras: Path | None
    orbit: int | None
    up: Up
    views: int | None
    resolution: int | None
    near: float
    drop_invalid: bool


@dataclass(frozen=True)
class StylizeRequest:
    """What `sgsst stylize` was asked for.

    Attributes:
        source: scene and cameras.
        style: style image.
        images: folder of photos for the content term; None for unstylized renders.
        out: PLY to write.
        backbone: "auto", "vgg19" or "vgg16".
        resume: go on from the checkpoint beside `out`.
        settings: everything else.
    """

    source: SceneRequest
    style: Path
    images: Path | None
    out: Path
    backbone: str
    resume: bool
    settings: Settings


@dataclass(frozen=True)
class Outputs:
    """The files of a job, named after its PLY so that jobs can share a folder."""

    ply: Path

    def _beside(self, suffix: str) -> Path:
        return self.ply.with_name(self.ply.stem + suffix)

    @property
    def report(self) -> Path:
        """The report."""
        return self._beside(".report.json")

    @property
    def page(self) -> Path:
        """The report for people."""
        return self._beside(".report.html")

    @property
    def plan(self) -> Path:
        """The plan."""
        return self._beside(".plan.json")

    @property
    def sheet(self) -> Path:
        """The contact sheet."""
        return self._beside(".before_after.jpg")

    @property
    def curves(self) -> Path:
        """The loss curves."""
        return self._beside(".loss.png")

    @property
    def checkpoint(self) -> Path:
        """Where an unfinished job can go on from."""
        return self._beside(".checkpoint.safetensors")


@dataclass
class Job:
    """A job whose inputs have all been read and checked."""

    request: StylizeRequest
    outputs: Outputs
    scene_file: SceneFile
    style: Tensor
    sources: Sources
    stylizer: Stylizer
    fingerprint: str
    state: StylizerState | None


@dataclass(frozen=True)
class Result:
    """How a job ended.

    Attributes:
        stopped: see `run`; where it is "interrupted", only the checkpoint was written.
        before, after: loss on the evaluation views; `after` is empty where the job was interrupted.
        report_error: why report, contact sheet or curves are missing; None if they are not.
    """

    stopped: Stopped
    before: Evaluation
    after: Evaluation
    report_error: Exception | None = None


def prepare(request: StylizeRequest) -> Job:
    """Read and check every input; nothing is written.

    Raises:
        InvalidInputError: in one of its forms, for the first input that cannot be used.
    """
    settings = request.settings
    if not settings.steps_coarse + settings.steps_sos:
        raise SettingsError("Both numbers of steps are 0, so that nothing would change. Give some.")
    check_choice(request.source, request.images)
    outputs = _check_output(request)
    weights = load_weights(request.backbone)
    style = load_image(request.style)
    scene_file = read_scene(request.source.scene, drop_invalid=request.source.drop_invalid)
    cameras = fit_cameras(read_cameras_of(request.source, scene_file.scene), settings)
    photos = check_photos(request.images, cameras) if request.images else None
    photo_stamps = repr([_stamp(path) for path in photos]) if photos else ""
    job_id = fingerprint(scene_file.scene, cameras, style, settings, weights.sha256, photo_stamps)
    state = _resumed(outputs, job_id, settings) if request.resume else None
    if state and not settings.memory_limit:
        settings = settings.model_copy(update={"memory_limit": state.memory})
    stylizer = Stylizer(
        scene_file.scene,
        cameras,
        style,
        settings,
        weights=weights,
        photos=(lambda index: load_photo(photos[index], cameras[index])) if photos else None,
    )
    stylizer.plan = with_measuring(stylizer.plan)
    source = request.source
    sources = Sources(source.scene, scene_file.dropped, request.style, source.cameras, request.images, weights)
    return Job(request, outputs, scene_file, style, sources, stylizer, job_id, state)


def execute(job: Job, *, progress: Callable[[Progress], None], stop: Callable[[], bool], warn: Warn) -> Result:
    """Run a prepared job and write its outputs: the PLY first, so that no failing report can lose it.

    Checkpoints are written every five minutes and where the job ends early. One that cannot be written is a warning
    as long as the job itself goes on.

    Raises:
        OutputError: the PLY, or the checkpoint of an interrupted job, cannot be written.
    """
    stylizer, outputs = job.stylizer, job.outputs
    measure = Measurements(stylizer)
    before = measure.evaluate(unstylized=True)
    if job.state:
        stylizer.load_state(job.state)
    outputs.ply.parent.mkdir(parents=True, exist_ok=True)
    unsaved: list[OutputError] = []

    def checkpoint(current: Stylizer) -> None:
        unsaved.clear()
        try:
            save_checkpoint(outputs.checkpoint, current.state(), job.fingerprint)
        except OutputError as error:
            unsaved.append(error)
            warn(f"No checkpoint could be written: {error}")

    write_json(outputs.plan, plan_json(stylizer.plan))
    callbacks = Callbacks(progress, stop, checkpoint, measure=measure, moments=measure.moments)
    stopped = run(stylizer, callbacks)
    if stopped == "interrupted":
        if unsaved:
            raise unsaved[0]
        return Result(stopped, before, {})
    write_stylized(job.scene_file, outputs.ply, stylizer.stylized())
    if stopped != "max-seconds":
        outputs.checkpoint.unlink(missing_ok=True)
    if stylizer.measured[-1]["step"] != stylizer.step:
        measure(stylizer)
    after = measure.evaluate()
    return Result(stopped, before, after, _write_reports(job, stopped, before, after))


def _write_reports(job: Job, stopped: Stopped, before: Evaluation, after: Evaluation) -> Exception | None:
    """Write what lies beside the PLY; returns what went wrong, since the scene itself is there."""
    stylizer, outputs = job.stylizer, job.outputs
    try:
        report = build_report(stylizer, job.sources, stopped, before, after, _findings(job))
        write_json(outputs.report, report)
        write_contact_sheet(outputs.sheet, stylizer)
        write_loss_curves(outputs.curves, stylizer.history, stylizer.round_length)
        write_page(outputs.page, report, outputs.sheet)
    except Exception as error:  # whatever it is, it must not look as if the job itself had failed
        return error
    return None


def _findings(job: Job) -> list[Finding]:
    stylizer = job.stylizer
    cameras, near = stylizer.views.cameras, stylizer.settings.near
    rasterizer = make_rasterizer("cpu", stylizer.scene, near=near)
    found = [*check_scene(job.scene_file), *check_views(job.scene_file, cameras, rasterizer, near=near)]
    return [*found, *check_style(stylizer.style, cameras)]


def describe(job: Job) -> list[tuple[str, str]]:
    """What was decided, as pairs of a heading and a line, for the user to read before the work starts."""
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
    if job.state:
        lines.append(("resuming", f"at step {job.state.step} of {stylizer.total}"))
    return lines


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


def check_choice(source: SceneRequest, images: Path | None = None) -> None:
    """Prove that there is one source of cameras, and photos only of known ones.

    Raises:
        CameraError: otherwise.
    """
    if source.cameras is None and source.orbit is None:
        raise CameraError(
            "There are no cameras. Give a camera file with --cameras, or --orbit N for N views around the scene."
        )
    if source.cameras is not None and source.orbit is not None:
        raise CameraError("Both --cameras and --orbit are given. Give one of them.")
    if images is not None and source.orbit is not None:
        raise CameraError(
            "--images are photos of known cameras, which an --orbit has not. Give --cameras, or no --images."
        )


def _check_output(request: StylizeRequest) -> Outputs:
    """The output's file names, after proof that they can be written; creates nothing."""
    out = request.out
    if out.is_dir():
        raise OutputError(f"{out}: is a folder. Name the PLY file to write, such as {out / 'stylized.ply'}.")
    if out.suffix.lower() != ".ply":
        raise OutputError(f"{out}: does not end in .ply. Name the PLY file to write.")
    if out.exists() and request.source.scene.exists() and os.path.samefile(out, request.source.scene):
        raise OutputError(f"{out}: is the scene itself, which would be lost. Name another file.")
    check_folder(out.parent)
    return Outputs(out)


def check_folder(folder: Path) -> None:
    """Prove that a folder can be written to, or created, without creating it.

    Raises:
        OutputError: it cannot.
    """
    while not (folder.exists() or folder.is_symlink()) and folder != folder.parent:
        folder = folder.parent
    ensure_writable_folder(folder)


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


def _resumed(outputs: Outputs, job_id: str, settings: Settings) -> StylizerState:
    if not outputs.checkpoint.exists() and outputs.ply.exists():
        raise CheckpointError(
            f"{outputs.ply}: is there, and no checkpoint beside it, so this job is finished. To start again, leave "
            "--resume out."
        )
    state = load_checkpoint(outputs.checkpoint, job_id)
    if settings.max_seconds and state.seconds >= settings.max_seconds:
        raise CheckpointError(
            f"{outputs.checkpoint}: the job has run for {state.seconds:.0f} s already, and --max-seconds counts these "
            f"too. Give more than {state.seconds:.0f}, or leave --max-seconds out."
        )
    return state


# --- plan ----------------------------------------------------------------------------------------------------------


def make_plan(source: SceneRequest, style: Path, backbone: str, settings: Settings, out: Path) -> Plan:
    """Plan a job as `sgsst stylize` would, and write the plan as JSON; no step is made.

    Raises:
        InvalidInputError: in one of its forms, for the first input that cannot be used.
    """
    check_choice(source)
    if out.is_dir() or out.suffix.lower() != ".json":  # a slip of the hand must not replace a scene or its cameras
        raise OutputError(f"{out}: is not the name of a JSON file. Name one to write, such as plan.json.")
    if source.cameras and out.exists() and source.cameras.exists() and os.path.samefile(out, source.cameras):
        raise OutputError(f"{out}: is the camera file, which would be lost. Name another file.")
    check_folder(out.parent)
    scene = read_scene(source.scene, drop_invalid=source.drop_invalid).scene
    weights = load_weights(backbone)
    stylizer = Stylizer(scene, read_cameras_of(source, scene), load_image(style), settings, weights=weights)
    out.parent.mkdir(parents=True, exist_ok=True)
    plan = with_measuring(stylizer.plan)
    write_json(out, plan_json(plan))
    return plan


# --- check ---------------------------------------------------------------------------------------------------------


def check_inputs(source: SceneRequest, style: Path | None) -> list[Finding]:
    """What is extreme in a scene, its views and its style; nothing is written.

    Raises:
        InvalidInputError: scene, cameras or style cannot be used.
    """
    check_choice(source)
    image = load_image(style) if style else None
    file = read_scene(source.scene, drop_invalid=True)
    cameras = read_cameras_of(source, file.scene)
    rasterizer = make_rasterizer("cpu", file.scene, near=source.near)
    found = [*check_scene(file), *check_views(file, cameras, rasterizer, near=source.near)]
    return found if image is None else [*found, *check_style(image, cameras)]


# --- render --------------------------------------------------------------------------------------------------------


def render_views(
    source: SceneRequest,
    background: tuple[float, float, float],
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Path]:
    """Render every view into a folder as PNG, numbered in the cameras' order; all inputs are checked before.

    Raises:
        InvalidInputError: scene, cameras or folder cannot be used.
    """
    check_choice(source)
    check_folder(out)
    scene = read_scene(source.scene, drop_invalid=source.drop_invalid).scene
    cameras = read_cameras_of(source, scene)
    rasterizer = make_rasterizer("cpu", scene, background=background, near=source.near)
    if not any(float(rasterizer.coverage(camera).amax()) > SEEN_COVERAGE for camera in cameras):
        raise CameraError(
            f"None of the {len(cameras)} cameras sees a Gaussian. Check that cameras and scene belong together."
        )
    ensure_writable_folder(out)
    paths = [out / name for name in view_file_names(cameras)]
    for index, (camera, path) in enumerate(zip(cameras, paths, strict=True)):
        colours = view_colours(scene.sh_dc, rest_colours(scene.sh_rest, scene.means, camera))
        save_png(path, rasterizer.render(colours, camera))
        progress(index + 1, len(cameras))
    return paths


def view_file_names(cameras: Sequence[Camera]) -> list[str]:
    """A file name for each view: its number, so that names sort in the cameras' order, then the camera's name.

    Folders and characters that file systems may refuse become underscores.
    """
    digits = max(4, len(str(len(cameras) - 1)))
    names = []
    for index, camera in enumerate(cameras):
        stem = re.sub(r"\.(png|jpe?g|tiff?|webp|bmp|exr)$", "", camera.name, flags=re.IGNORECASE)
        plain = re.sub(r"[^A-Za-z0-9.-]+", "_", stem).strip("._")[-80:]
        names.append(f"{index:0{digits}d}_{plain}.png" if plain else f"{index:0{digits}d}.png")
    return names
