"""Videos of a scene: the cameras of a requested path, and reading and rendering of the scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from sgsst_core.errors import CameraError, SettingsError
from sgsst_core.files.images import Color
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.files.video import check_video_path, encoder, frames_folder, is_encoded, video_writer
from sgsst_core.orbit.cameras import ELEVATION, turntable
from sgsst_core.orbit.choice import find_upright_subject
from sgsst_core.progress import warnings_of
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.report.video import Layer, write_frames
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.camera_path import CameraPath, framed, in_path_order
from sgsst_core.scene.gaussians import Scene
from worker.capture import Capture, orbit_request, read_capture
from worker.inputs import check_something_in_view, read_job_capture, read_requested
from worker.job import JobSpec, SceneRequest, check_choice
from worker.options import DEFAULT_SIDE, VideoOptions
from worker.outputs import check_folder, check_is_not_input
from worker.selecting import cropped


@dataclass(frozen=True)
class VideoRequest:
    """Request for a video of a scene.

    Attributes:
        source: Scene and cameras; its resolution is the longer side of the video.
        out: Video, or images, to write; see `sgsst_core.files.video`.
        background: Background color, in 0..1.
        unstylized: Scene file at the start of a transition; None for no transition.
        transparent: Whether to write an alpha channel instead of the background.
        job: Job whose result the scene is, for a path through the job's own views; None for those of `source`.
    """

    source: SceneRequest
    out: Path
    options: VideoOptions
    background: Color
    unstylized: Path | None = None
    transparent: bool = False
    job: JobSpec | None = None

    @property
    def along_cameras(self) -> bool:
        """Return whether the path leads through cameras rather than around the scene."""
        path = self.options.path
        return path == "cameras" or (path == "auto" and self.source.cameras is not None)


def check_video_request(request: VideoRequest) -> None:
    """Check a request as far as possible without reading the scene.

    Raises:
        InvalidInputError: If options contradict each other, or the video cannot be written.
        ModuleNotFoundError: If the extra `video` is required but not installed.
    """
    source, out = request.source, request.out
    check_video_path(out, alpha=request.transparent)
    if request.along_cameras:
        check_choice(source)
    elif source.orbit is not None:
        raise SettingsError(
            "--orbit creates single views, but a turntable has a view per frame. Omit it, or add --path cameras for a "
            "path through these views."
        )
    for scene in (source.scene, request.unstylized):
        if scene is not None:
            check_is_not_input(out, scene)
    check_folder(frames_folder(out))


def render_video(
    request: VideoRequest,
    progress: Callable[[int, int], None] = lambda done, total: None,
    warn: Callable[[str], None] = lambda line: None,
    *,
    in_place: bool = False,
) -> list[Camera]:
    """Render a requested video on the CPU, and return its cameras. All inputs are checked first.

    Args:
        request: Request that `check_video_request` accepts.
        progress: Callback that receives the numbers of completed and of all frames.
        warn: Callback for warnings about scene and cameras.
        in_place: Whether to write directly to the existing file, because no temporary file can be created beside it.

    Raises:
        InvalidInputError: If an input cannot be used, or the video cannot be written.
    """
    source = request.source
    file, decisions = read_requested(source)
    scene, before = file.scene, None
    if request.unstylized is not None:
        before = read_requested(source.model_copy(update={"scene": request.unstylized}))[0].scene
    through = remaining = None
    if request.along_cameras:
        capture = _read_views(request, file).checked(scene, source.near)
        through, decisions = capture.cameras, [*decisions, *capture.decisions]
    elif request.job is not None and request.job.regions:
        file, _ = read_requested(request.job.source)  # regions select its Gaussians, which may have been split since
        remaining = cropped(request.job.regions, file, source.near)
    even, side = is_encoded(request.out), source.resolution
    cameras = video_cameras(file.scene, source, through, request.options, side, remaining, even=even)
    check_something_in_view(scene, cameras, source.near)
    for line in warnings_of(decisions):
        warn(line)
    background = (0.0, 0.0, 0.0) if request.transparent else request.background

    def layer(shown: Scene) -> Layer:
        # the intersections of the current frame alone are cached
        return Layer(shown, make_rasterizer("cpu", shown, background=background, near=source.near, memory=0))

    after = layer(scene)
    unstylized = None
    if before is not None:
        shape = ("means", "quats", "scales", "opacities")
        same = all(torch.equal(getattr(before, name), getattr(scene, name)) for name in shape)
        same = same and before.rendering == scene.rendering
        unstylized = Layer(before, after.rasterizer) if same else layer(before)
    request.out.parent.mkdir(parents=True, exist_ok=True)
    write_to, first, options = encoder if in_place else video_writer, cameras[0], request.options
    with write_to(request.out, first.width, first.height, options.fps, alpha=request.transparent) as write:
        write_frames(
            write,
            after,
            cameras,
            unstylized=unstylized,
            transition=options.transition,
            alpha=request.transparent,
            progress=progress,
        )
    return cameras


def video_cameras(
    scene: Scene,
    source: SceneRequest,
    through: Sequence[Camera] | None,
    options: VideoOptions,
    side: int | None,
    remaining: Tensor | None = None,
    *,
    even: bool,
) -> list[Camera]:
    """Return the cameras of a video, one per frame.

    Args:
        scene: Scene that a turntable surrounds.
        source: Up direction, elevation, radius and near plane of a turntable.
        through: Cameras that the path leads through; None for a turntable.
        side: Longer side in pixels; None for the cameras' own, but at most `DEFAULT_SIDE`.
        remaining: [N] bool, Gaussians of a cropped scene that a turntable surrounds; None for all.
        even: Whether sides must be even.

    Raises:
        SettingsError: If there are no cameras, or an option of the turntable is out of range.
    """
    if through is not None:
        if not through:
            raise CameraError("A camera path needs at least one camera. Give some, or use the path orbit.")
        path = CameraPath(in_path_order(through)).evenly(options.frames)
        side = side or min(DEFAULT_SIDE, max(path[0].width, path[0].height))
        return [framed(camera, side, even=even) for camera in path]
    request = orbit_request(source)
    subject, up = find_upright_subject(scene, request.up, remaining)
    cameras = turntable(
        subject,
        options.frames,
        up=up.direction.tolist(),
        elevation=ELEVATION if request.elevation is None else request.elevation,
        radius=request.radius,
        side=side or DEFAULT_SIDE,
        near=request.near,
    )
    return [framed(camera, None, even=even) for camera in cameras]


def _read_views(request: VideoRequest, file: SceneFile) -> Capture:
    """Read or generate the views that a path leads through, given the scene of the video."""
    job = request.job
    if job is None:
        return read_capture(request.source, file.scene)
    if job.source.cameras is None:  # an orbit depends on the job's scene, whose Gaussians may have been split since
        file, _ = read_requested(job.source)
    return read_job_capture(job, file)
