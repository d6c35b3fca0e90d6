"""Painted views of a scene: an image to paint on, and the job by which the scene follows what was painted."""

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any

from PIL import Image
from PIL.PngImagePlugin import PngInfo

from sgsst_core.errors import CameraError, ImageError
from sgsst_core.files.atomic import atomic_path, write_json
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.images import image_size, load_image, to_image
from sgsst_core.files.library import save
from sgsst_core.files.scene_file import SceneFile, write_colors, write_stylized
from sgsst_core.painting import PASSES, Painted, PaintedView, paint
from sgsst_core.progress import Decision, Progress
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.base import Color
from sgsst_core.report.document import PLAN_VERSION, REPORT_VERSION
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.stylizing.refining import render
from worker.execute import THUMBNAIL_SIDE, Prepared, describe_scene, save_thumbnail
from worker.inputs import (
    STYLE_PIXELS,
    Capture,
    InputLimits,
    check_frames_have_sizes,
    check_something_in_view,
    errors_of,
    read_capture,
    read_requested,
    read_scene_and_capture,
)
from worker.job import JobSpec, Outputs, Result, SceneRequest, check_choice, check_request, check_suffix
from worker.options import CameraParameters, PaintedFile, PaintedOptions
from worker.run import Listener, WorkerOptions

#: Text chunk of a PNG with the view that it shows, as `PaintedOptions`.
_CHUNK = "sgsst-view"
#: Number of other views that tell how well the painted ones show a Gaussian.
_OTHERS = 12
#: Predicted seconds on one core: of a pass for each Gaussian and pixel of a view, and of everything else for each
#: Gaussian. Measured with 48,000 and a million Gaussians at 480 pixels.
_SECONDS_PER_GAUSSIAN, _SECONDS_PER_PIXEL, _OTHER_SECONDS = 1.5e-7, 3.5e-7, 1.2e-5
#: Predicted bytes for each Gaussian and pixel of a view, and besides.
_BYTES_PER_GAUSSIAN, _BYTES_PER_PIXEL, _OTHER_BYTES = 2000, 2000, 600_000_000


@dataclass(frozen=True)
class PaintInputs:
    """All inputs of a job with painted views.

    Attributes:
        scene_file: Scene to paint.
        capture: Cameras of the job, which need not be those of the painted views.
        views: Painted views.
        decisions: Decisions about scene, cameras and painted views for the plan.
    """

    scene_file: SceneFile
    capture: Capture
    views: list[PaintedView]
    decisions: tuple[Decision, ...]

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the painted views."""
        return [view.camera for view in self.views]

    @property
    def pixels(self) -> int:
        """Number of pixels of the painted views."""
        return sum(camera.width * camera.height for camera in self.cameras)

    @property
    def seconds(self) -> float:
        """Predicted seconds of the solution on one core."""
        gaussians = len(self.scene_file.scene)
        passes = PASSES * (_SECONDS_PER_GAUSSIAN * gaussians * len(self.views) + _SECONDS_PER_PIXEL * self.pixels)
        return passes + _OTHER_SECONDS * gaussians

    @property
    def peak_bytes(self) -> int:
        """Predicted peak memory in bytes."""
        gaussians = len(self.scene_file.scene)
        return _OTHER_BYTES + _BYTES_PER_GAUSSIAN * gaussians + _BYTES_PER_PIXEL * self.pixels

    @property
    def plan(self) -> dict[str, Any]:
        """Plan in the format of `plan.json`."""
        return {"version": PLAN_VERSION, "decisions": [asdict(decision) for decision in self.decisions]}


def export_view(source: SceneRequest, name: str, background: Color, out: Path) -> Camera:
    """Render a view as a PNG to paint on, which states its view in a text chunk. Return the camera.

    Raises:
        InvalidInputError: If scene or cameras cannot be used, no view has this name, or `out` is not a PNG's name.
    """
    check_suffix(out, "a PNG image", f"{name}.png")
    file, capture = read_scene_and_capture(source)
    camera = camera_named(capture.cameras, name)
    rasterizer = make_rasterizer("cpu", file.scene, background=background, near=source.near)
    image, metadata = render(file.scene, rasterizer, camera), PngInfo()
    metadata.add_text(_CHUNK, PaintedOptions(view=name, camera=_parameters(camera)).model_dump_json())
    with atomic_path(out) as temporary:
        to_image(image).save(temporary, format="PNG", pnginfo=metadata)
    return camera


def read_paintings(request: JobSpec, limits: InputLimits | None = None) -> PaintInputs:
    """Read and check all inputs of a job with painted views.

    Args:
        limits: Limits of a service; None for none.

    Raises:
        InvalidInputError: If an input cannot be used. Its attribute `role` is the input's role.
    """
    source = request.source
    with errors_of("scene"):
        if limits:
            limits.check_count(read_scene_header(source.scene).count, 1.0)
        file, decisions = read_requested(source)
    with errors_of("cameras"):
        check_choice(source)
        if limits and source.cameras is not None:
            check_frames_have_sizes(source.cameras)
        capture = read_capture(source, file.scene).checked(file.scene, source.near)
        if limits:
            limits.check_cameras(capture.cameras)
    with errors_of("painted"):
        cameras = [_camera_of(painted, capture.cameras, limits) for painted in request.paintings]
        _check_together(request.paintings, cameras)
        views = []
        for painted, camera in zip(request.paintings, cameras, strict=True):
            check_something_in_view(file.scene, [camera], source.near)
            views.append(load_painting(painted.path, camera))
    names = ", ".join(f"{camera.name} ({camera.width}x{camera.height})" for camera in cameras)
    about = Decision("painted views", names, "the scene follows them; geometry and view-dependent colors stay")
    return PaintInputs(file, capture, views, (*decisions, *capture.decisions, about))


def load_painting(path: Path, camera: Camera) -> PaintedView:
    """Read a painted view.

    Raises:
        ImageError: If the file is no image, is transparent everywhere, or has another size than the camera's.
    """
    (width, height), wanted = image_size(path), f"the view {camera.name} has {camera.width}x{camera.height}"
    if (width, height) != (camera.width, camera.height):
        same = abs(width / height - camera.width / camera.height) < 1 / min(height, camera.height)
        shape = "" if same else ", which is another aspect ratio: do not crop the image"
        raise ImageError(f"{path}: has {width}x{height} pixels, but {wanted}{shape}. Export and paint in one size.")
    on_black, on_white = (load_image(path, background=(gray,) * 3) for gray in (0.0, 1.0))
    alpha = 1 - (on_white - on_black).mean(dim=2).clamp(0, 1)
    if not bool((alpha > 0).any()):
        raise ImageError(f"{path}: is transparent everywhere, so it says nothing. Paint on it.")
    return PaintedView(camera, (on_black / alpha.clamp_min(1 / 255)[:, :, None]).clamp(0, 1), alpha)


def _camera_of(painted: PaintedFile, cameras: Sequence[Camera], limits: InputLimits | None) -> Camera:
    """Return the camera of a painted view: the given one, the one that its file states, or the named one."""
    path, given = painted.path, painted.options
    image_size(path)
    if limits:
        limits.check_image(path)
    stated = _stated(path)
    if stated and stated.view and given.view and stated.view != given.view:
        raise ImageError(f"{path}: is an image of the view {stated.view}, not of {given.view}. Name that view.")
    known = given if given.camera or not stated else stated
    if (camera := known.camera) is not None:
        intrinsics = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
        name = known.view or path.stem
        return Camera.from_matrix(camera.world_to_camera, intrinsics, camera.width, camera.height, name)
    if known.view is None:
        raise CameraError(f"{path}: does not state its view. Name the view, or export the image again.")
    return camera_named(cameras, known.view)


def _check_together(paintings: Sequence[PaintedFile], cameras: Sequence[Camera]) -> None:
    """Check that no two images are of one view, and the number of pixels of all.

    Raises:
        ImageError: If there are two of one view, or too many pixels.
    """
    for (first, one), (second, other) in combinations(zip(paintings, cameras, strict=True), 2):
        if _parameters(one) == _parameters(other):
            raise ImageError(
                f"{second.path}: shows the view {one.name}, as {first.path.name} does. Merge the two into one image."
            )
    if (pixels := sum(camera.width * camera.height for camera in cameras)) > STYLE_PIXELS:
        raise ImageError(
            f"The painted images have {pixels:,} pixels together. At most {STYLE_PIXELS:,} are allowed: export them "
            "at a lower resolution."
        )


def camera_named(cameras: Sequence[Camera], name: str) -> Camera:
    """Return the camera of a name; given that of a panorama, its front face.

    Raises:
        CameraError: If there is none.
    """
    for camera in cameras:
        if name in (camera.name, camera.panorama):
            return camera
    some = ", ".join(camera.name for camera in cameras[:5])
    raise CameraError(f"No view is called {name}. There are {len(cameras)}: {some}{', ...' * (len(cameras) > 5)}.")


def _parameters(camera: Camera) -> CameraParameters:
    """Return the parameters of a camera, as a file states them."""
    given = {name: getattr(camera, name) for name in CameraParameters.model_fields if name != "world_to_camera"}
    return CameraParameters(**given, world_to_camera=camera.world_to_camera.tolist())


def _stated(path: Path) -> PaintedOptions | None:
    """Return the view that an image states in its text chunk; None if there is none, or it cannot be read."""
    try:
        with Image.open(path) as image:
            return PaintedOptions.model_validate_json(image.info[_CHUNK])
    except (OSError, SyntaxError, KeyError, ValueError):
        return None


def run_painting(request: JobSpec, listener: Listener, options: WorkerOptions) -> Result:
    """Run a job with painted views in this process. It takes seconds, so it is neither interrupted nor resumed.

    It writes the scene and, beside it, report, plan and colors.

    Raises:
        SgsstError: If the job fails; nothing is written then.
    """
    started = time.perf_counter()
    check_request(request)
    inputs = read_paintings(request)
    file = inputs.scene_file
    lines = [(line.item, f"{line.decision}: {line.reason}") for line in inputs.decisions]
    listener.prepared(Prepared([("scene", describe_scene(file)), *lines], 0, PASSES))
    begun = time.perf_counter()

    def show(done: int) -> None:
        left = (time.perf_counter() - begun) / done * (PASSES - done) if done else inputs.seconds
        listener.progress(Progress(stage="painting", step=done, total=PASSES, eta_s=left))

    rasterizer = make_rasterizer("cpu", file.scene, background=request.settings.background, near=request.source.near)
    side = max(camera.side for camera in inputs.cameras)  # their pixels are compared with those of the painted views
    others = [resized(camera, side) for camera in spread(inputs.capture.cameras, _OTHERS)]
    painted = paint(file.scene, inputs.views, rasterizer, others=others, show=show)
    if options.preview_folder:
        camera = inputs.cameras[0]
        camera = resized(camera, min(camera.side, THUMBNAIL_SIDE))
        scenes = file.scene, replace(file.scene, sh_dc=painted.sh_dc)
        save_thumbnail(options.preview_folder, *(render(scene, rasterizer, camera) for scene in scenes))
    _write(request, inputs, painted, time.perf_counter() - started)
    return Result(
        stopped="finished",
        steps=PASSES,
        total=PASSES,
        psnr_before=painted.psnr_before,
        psnr_after=painted.psnr_after,
    )


def _write(request: JobSpec, inputs: PaintInputs, painted: Painted, seconds: float) -> None:
    """Write the painted scene, and beside it report, plan and colors.

    Raises:
        OutputError: If a file cannot be written.
    """
    file, outputs = inputs.scene_file, Outputs.of(request.out)
    if request.pad_sh:
        write_stylized(file, request.out, painted.sh_dc, pad_sh=True)
    else:
        save(request.out, replace(file, scene=replace(file.scene, sh_dc=painted.sh_dc)))
    if request.colors and file.retained is None:
        write_colors(outputs.colors, painted.sh_dc)
    views = [{"name": camera.name, "width": camera.width, "height": camera.height} for camera in inputs.cameras]
    figures = {name: value for name, value in vars(painted).items() if name != "sh_dc"}
    report = {"version": REPORT_VERSION, "gaussians": len(file.scene), "views": views, **figures}
    write_json(outputs.report, {**report, "seconds": round(seconds, 2)})
    write_json(outputs.plan, inputs.plan)
