"""Files derived from scenes, for the command line and, confined, for the service: scenes, blends, pages, videos."""

import base64
import gzip
import html
import io
import json
import re
import zipfile
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from sgsst_core.errors import OutputError, SceneError, SettingsError
from sgsst_core.files import scene_file
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.formats import format_of_name, read_scene_header, scene_path
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.formats.sog import INDEX_NAME, META_NAME, SOG, STREAMED_SOG
from sgsst_core.files.images import Color, to_image
from sgsst_core.files.library import TrainerCheckpoint, load_scene
from sgsst_core.files.video import check_video_path, encoder, frames_folder, is_encoded, video_writer
from sgsst_core.orbit import ELEVATION, find_upright_subject, turntable
from sgsst_core.progress import Decision, warnings_of
from sgsst_core.quality.measure import CompressionLoss, measure_compression
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.report.images import Layer, write_frames
from sgsst_core.scene.camera import Camera, CameraPath, framed, in_path_order
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import Settings
from worker import inputs
from worker.execute import describe_scene
from worker.job import JobSpec, SceneRequest, check_choice, check_folder, check_is_not_input, result_format
from worker.options import DEFAULT_SIDE, MOST_VIEWPOINT_NAME, VideoOptions, Viewpoint, Viewpoints

#: Number of views of an orbit that a converted scene is compared in.
_COMPARED_VIEWS = 3


@dataclass(frozen=True)
class Converted:
    """Result of a conversion.

    Attributes:
        scene: Text about the scene, with contents that were not read, or not read as stored.
        decisions: Decisions about the scene's axes and the cameras.
        loss: Difference of the written scene; None if it was not measured.
    """

    scene: str
    decisions: tuple[Decision, ...]
    loss: CompressionLoss | None


def convert(
    source: SceneRequest,
    out: Path,
    *,
    compare: bool,
    images: Path | None = None,
    settings: Settings | None = None,
    levels_of: Path | None = None,
    pad_sh: bool = False,
    in_place: bool = False,
) -> Converted:
    """Write a scene in the format that the name of a file determines. Colors and order may change by its rounding.

    Args:
        source: Scene or checkpoint of a trainer, and cameras for the comparison; without cameras, views are those of an
            orbit.
        out: File to write: a scene, the meta.json of an unpacked SOG, the lod-meta.json or archive of a streamed SOG,
            or a USD file, which cannot be compared.
        compare: Whether to read the file back and compare renders.
        images: Folder of photos, for cameras whose file states no sizes.
        settings: Settings of a job, whose views and background the renders have; None for those of the cameras, on
            black.
        levels_of: Streamed SOG that the scene is the finest level of, with other colors; None for the scene itself.
        pad_sh: Whether a PLY has spherical harmonics of degree 3 in any case.
        in_place: Whether to write directly to the existing file, because no temporary file can be created beside it.

    Raises:
        InvalidInputError: If scene, cameras or output cannot be used.
    """
    is_usd = out.suffix.lower() in scene_file.USD_SUFFIXES
    streamed = out.name == INDEX_NAME or format_of_name(out.name) is STREAMED_SOG
    if is_usd:
        scene_file.check_usd(out)
        if compare:
            raise OutputError(f"{out}: USD can only be written, so it cannot be compared. Omit --compare.")
    elif streamed and not levels_of and read_scene_header(source.scene).format is not STREAMED_SOG:
        raise OutputError(
            f"{out}: needs the levels of a streamed SOG. Give the one that the scene is from: --levels-of."
        )
    elif levels_of and not streamed:
        raise OutputError(f"{out}: has no levels of detail. Name a {INDEX_NAME} or a .zip, or omit --levels-of.")
    elif out.name != META_NAME and not streamed:
        result_format(out)
    if pad_sh and format_of_name(out.name) is not PLY:
        raise OutputError(f"{out}: only a PLY can be padded. Name a .ply, or omit --pad-sh.")
    for path in filter(None, (source.scene, levels_of)):
        check_is_not_input(out, scene_path(path))
    if compare and source.cameras is None and source.orbit is None:
        source = source.model_copy(update={"orbit": _COMPARED_VIEWS})
    axes, decisions = inputs.choose_axes(source, images)
    loaded = load_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=axes)
    file = loaded.scene_file() if isinstance(loaded, TrainerCheckpoint) else loaded
    file = file.rendered(source.render_mode, source.eps2d)
    scene, decisions = file.scene, [*inputs.about_notes(file), *decisions, *inputs.about_rendering(file)]
    cameras: list[Camera] = []
    if source.cameras or source.orbit:
        capture = inputs.read_capture(source, scene, images)
        capture = (capture.fitted(settings) if settings else capture).checked(scene, source.near)
        cameras, decisions = capture.cameras, [*decisions, *capture.decisions]
    out.parent.mkdir(parents=True, exist_ok=True)
    size = None
    if streamed:
        size = scene_file.write_levels(out, scene, levels_of or source.scene)
    elif out.name == META_NAME:
        size = scene_file.write_sog_folder(out.parent, scene)
    elif is_usd:
        scene_file.write_usd(out, scene)
    else:
        with _written(out, in_place=in_place) as path, path.open("wb") as stream:
            scene_file.encode_scene(stream, scene, result_format(out), out, pad_sh=pad_sh, axes=file.axes)
    stated = CLASSIC if is_usd else read_scene_header(out).tag.rendering
    if stated != scene.rendering:
        reason = f"its format cannot state {scene.rendering.text}"
        decisions += [Decision("rendering", f"warning: {out.name} will be drawn {stated.text}", reason)]
    decisions += [] if is_usd or compare else about_losses(scene, read_scene_header(out).format, out)
    loss = None
    if compare:
        background = settings.background if settings else (0.0, 0.0, 0.0)
        loss = measure_compression(out, scene, cameras, background=background, near=source.near, axes=file.axes)
        loss = replace(loss, size=size or loss.size)
    return Converted(describe_scene(file), tuple(decisions), loss)


def about_losses(scene: Scene, format: SceneFormat, out: Path) -> list[Decision]:
    """Return warnings about what a format cannot hold of a scene."""
    return [Decision("scene", f"warning: {out.name} loses detail", note) for note in scene_file.losses(scene, format)]


def blend(parts: Sequence[tuple[SceneRequest, float]], out: Path, *, in_place: bool = False) -> list[Decision]:
    """Write the weighted mean of scenes that differ only in color, and return warnings about what is lost.

    Args:
        parts: Scenes with their weights, which are divided by their sum. Cameras are not used.
        out: Scene file to write.
        in_place: See `convert`.

    Raises:
        InvalidInputError: If the weights, a scene or the output cannot be used.
    """
    format = result_format(out)
    for source, _ in parts:
        check_is_not_input(out, source.scene)
    files = [
        scene_file.read_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=source.spz_axes)
        for source, _ in parts
    ]
    blended = scene_file.blend_scenes(files, [weight for _, weight in parts])
    out.parent.mkdir(parents=True, exist_ok=True)
    with _written(out, in_place=in_place) as path, path.open("wb") as stream:
        scene_file.encode_blend(stream, blended, format, out)
    return about_losses(blended.scene, format, out)


def _written(out: Path, *, in_place: bool) -> AbstractContextManager[Path]:
    """Return the context of the path to write to, which replaces `out` at the end unless it is `out` itself."""
    return nullcontext(out) if in_place else atomic_path(out)


#: Largest relative difference of spherical harmonics that are those of the original times a factor.
_TOLERANCE = 1e-3
#: Length of a sum of unit vectors below which it has no direction.
_NO_DIRECTION = 1e-6
#: Longer side of the image of a viewpoint in pixels, and quality of its JPEG.
_POSTER_SIDE, _POSTER_QUALITY = 960, 90


def write_page(
    out: Path,
    viewer: Mapping[str, str],
    stylized: scene_file.SceneFile,
    original: scene_file.SceneFile | None,
    title: str,
    *,
    background: Color = (0.0, 0.0, 0.0),
    up: list[float] | None = None,
    cameras: Sequence[Camera] = (),
    viewpoints: Viewpoints | None = None,
    in_place: bool = False,
) -> None:
    """Write a scene as an HTML file, atomically.

    Args:
        viewer: Sources of the viewer; see `api.static_files.exported_viewer`.
        original: Scene of the same Gaussians to show beside it, with a wipe and a blend; None for none.
        background: Color behind the scene, in 0..1.
        up: Up direction; None for that of the cameras, or to estimate it.
        cameras: Cameras of the scene. The page opens at the first one, unless `viewpoints` has a start.
        viewpoints: Viewpoints of the page; None for none.
        in_place: Whether to write directly to the existing file, because no temporary file can be created beside it.

    Raises:
        SceneError: If the scenes differ in more than their colors and an SH attenuation.
        OutputError: If the file cannot be written.
    """
    shown = original or stylized
    fade = 0.0 if original is None else _fade(stylized, original)
    data = {name: gzip.compress(viewer[name].encode(), mtime=0) for name in ("page", "worker")}
    data["scene"] = _sog(shown.scene, out)
    data["colors"] = b"" if original is None else gzip.compress(_indexed_colors(stylized.scene, out), mtime=0)
    upright = up or _mean_up(cameras) or find_upright_subject(shown.scene, None)[1].direction.tolist()
    chosen = viewpoints or Viewpoints()
    start = chosen.start or (viewpoint_of(cameras[0]) if cameras else None)
    sizes = {name: len(content) for name, content in data.items()}
    sog = shown.format in (SOG.name, STREAMED_SOG.name)
    facts = {
        "title": title,
        "up": upright,
        "fade": fade,
        "sog": sog,
        "background": background,
        "bytes": sizes,
        "viewpoints": Viewpoints(start=start, named=chosen.named).model_dump(mode="json"),
    }
    about = json.dumps(facts).replace("<", "\\u003c")
    values = {"title": html.escape(title), "style": viewer["style"], "about": about}
    # "<", which would end a script element, becomes a comma.
    values |= {name: base64.b85encode(each, pad=True).decode().replace("<", ",") for name, each in data.items()}
    page = re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], viewer["document"])
    with _written(out, in_place=in_place) as path:
        path.write_text(page, encoding="utf-8")


def _mean_up(cameras: Sequence[Camera]) -> list[float] | None:
    """Return the mean up direction of cameras, as the page's `upOf`; None for fewer than two, or if they cancel out."""
    total = -sum((camera.world_to_camera[1, :3] for camera in cameras), torch.zeros(3, dtype=torch.float64))
    length = float(total.norm())
    return (total / length).tolist() if len(cameras) > 1 and length > _NO_DIRECTION else None


def viewpoint_of(camera: Camera) -> Viewpoint:
    """Return the viewpoint of a camera, without its distortion and the offset of its principal point."""
    name = re.sub(r"[\x00-\x1f\x7f-\x9f]", "_", camera.name)[-MOST_VIEWPOINT_NAME:]
    axes = camera.world_to_camera[:3, :3].tolist()
    intrinsics = {side: getattr(camera, side) for side in ("fx", "fy", "width", "height")}
    return Viewpoint(name=name, position=camera.center.tolist(), axes=axes, **intrinsics)


def write_poster(
    out: Path, original: Scene, stylized: Scene, viewpoint: Viewpoint, *, background: Color, near: float
) -> None:
    """Write a JPEG of a viewpoint, whose left half shows the original scene, directly to the existing file.

    Raises:
        CameraError: If the viewpoint is no camera.
    """
    at, width, height = viewpoint, viewpoint.width, viewpoint.height
    rotation = torch.tensor(at.axes, dtype=torch.float64)
    pose = torch.cat([rotation, -rotation @ torch.tensor(at.position, dtype=torch.float64)[:, None]], dim=1)
    intrinsics = [[at.fx, 0.0, width / 2], [0.0, at.fy, height / 2], [0.0, 0.0, 1.0]]
    camera = framed(Camera.from_matrix(pose, intrinsics, width, height), _POSTER_SIDE, even=False)
    before, after = (
        make_rasterizer("cpu", scene, background=background, near=near, memory=0).render(
            scene_colors(scene, camera), camera
        )
        for scene in (original, stylized)
    )
    middle = camera.width // 2
    image = torch.cat([before[:, :middle], after[:, middle:]], dim=1)
    to_image(image).save(out, format="JPEG", quality=_POSTER_QUALITY)


def _fade(stylized: scene_file.SceneFile, original: scene_file.SceneFile) -> float:
    """Return the fraction by which the harmonics of the stylized scene are smaller than those of the original."""
    scene_file.check_same_shape(original, stylized)
    before, after = scene_file.common_rests([original.scene, stylized.scene])
    if torch.equal(before, after):
        return 0.0
    factor = float((before.double() * after.double()).sum() / before.double().square().sum())
    if not torch.allclose(after, factor * before, rtol=0, atol=_TOLERANCE * float(before.abs().max())):
        raise SceneError(
            f"{stylized.path}: its view-dependent colors are not those of {original.path}. Give the scene that was "
            "stylized, in the same format."
        )
    return 1 - factor


def _sog(scene: Scene, out: Path) -> bytes:
    stream = io.BytesIO()
    scene_file.encode_scene(stream, scene, SOG, out)
    return stream.getvalue()


def _indexed_colors(scene: Scene, out: Path) -> bytes:
    """Return the codebook of a scene's colors as 256 halves, and 3 bytes for each Gaussian, in the order of its SOG."""
    flat = replace(scene, sh_rest=torch.zeros(len(scene), 0, 3))  # harmonics would only take time
    with zipfile.ZipFile(io.BytesIO(_sog(flat, out))) as archive:
        meta: dict[str, Any] = json.loads(archive.read(META_NAME))
        with Image.open(archive.open(meta["sh0"]["files"][0])) as image:
            indices = np.asarray(image.convert("RGBA")).reshape(-1, 4)[: meta["count"], :3]
    return np.array(meta["sh0"]["codebook"], "<f2").tobytes() + indices.tobytes()


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
    file, decisions = inputs.read_requested(source)
    scene, before = file.scene, None
    if request.unstylized is not None:
        before = inputs.read_requested(source.model_copy(update={"scene": request.unstylized}))[0].scene
    through = remaining = None
    if request.along_cameras:
        capture = _read_views(request, file).checked(scene, source.near)
        through, decisions = capture.cameras, [*decisions, *capture.decisions]
    elif request.job is not None and request.job.regions:
        file, _ = inputs.read_requested(
            request.job.source
        )  # regions select its Gaussians, which may have been split since
        remaining = inputs.cropped(request.job.regions, file, source.near)
    even, side = is_encoded(request.out), source.resolution
    cameras = video_cameras(file.scene, source, through, request.options, side, remaining, even=even)
    inputs.check_something_in_view(scene, cameras, source.near)
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
        through: Cameras that the path leads through, of panoramas only the front faces; None for a turntable.
        side: Longer side in pixels; None for the cameras' own, but at most `DEFAULT_SIDE`.
        remaining: [N] bool, Gaussians of a cropped scene that a turntable surrounds; None for all.
        even: Whether sides must be even.

    Raises:
        CameraError: If there are no cameras to lead through.
        SettingsError: If an option of the turntable is out of range.
    """
    if through is not None:
        ahead = [camera for camera in through if camera.name == f"{camera.panorama}.front" or camera.panorama is None]
        path = CameraPath(in_path_order(ahead or through)).evenly(options.frames)
        side = side or min(DEFAULT_SIDE, max(path[0].width, path[0].height))
        return [framed(camera, side, even=even) for camera in path]
    request = inputs.orbit_request(source)
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


def _read_views(request: VideoRequest, file: scene_file.SceneFile) -> inputs.Capture:
    """Read or generate the views that a path leads through, given the scene of the video."""
    job = request.job
    if job is None:
        return inputs.read_capture(request.source, file.scene)
    if job.source.cameras is None:  # an orbit depends on the job's scene, whose Gaussians may have been split since
        file, _ = inputs.read_requested(job.source)
    return inputs.read_job_capture(job, file)
