"""Implementation of the commands `demo`, `plan`, `check`, `render`, `blend`, `bench` and `study`, which need PyTorch.

The functions check all inputs, compute, and write the outputs, but print nothing. `stylize` is implemented by
`worker.run`, and `convert` by `worker.derived`.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from rich.table import Column, Table
from torch import Tensor

from api.cli.options import local_path, source_of
from api.static_files import FOLDER
from sgsst_core.devices import seconds_left
from sgsst_core.errors import SettingsError
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.files.atomic import atomic_path, ensure_writable_folder, write_json
from sgsst_core.files.images import load_image, save_png
from sgsst_core.files.scene_file import SceneFile, normalized, read_scene, write_scene, write_stylized
from sgsst_core.planning.survey import ShowPlanning
from sgsst_core.progress import Decision, warnings_of
from sgsst_core.quality.findings import Finding, findings_of
from sgsst_core.quality.study import VoteShare, check_names, write_study
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.report.document import machine, plan_json
from sgsst_core.report.images import write_views
from sgsst_core.scene.camera import Camera, faces_to_render, join_faces, level, resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.style import STARRY_NIGHT
from worker.derived import blend
from worker.execute import dry_run
from worker.inputs import check_something_seen, orbit_request, read_inputs, read_scene_and_capture
from worker.job import JobSpec, SceneRequest, check_choice, check_is_not_input, check_suffix
from worker.options import StylizeOptions, ViewOptions, split_weight
from worker.painting import camera_named

if TYPE_CHECKING:  # the second one imports matplotlib, for which the other commands need not wait
    from api.cli.scene_commands import VariantsInputs
    from sgsst_core.bench.variants import Curve, Quality

# --- demo ----------------------------------------------------------------------------------------------------------


def build_demo(folder: Path) -> tuple[Path, Path, Path]:
    """Create a folder, write a 3DGS PLY of SH degree 0, its views as an INRIA cameras.json, and a style image.

    The scene is the example of the page. It was lifted from the stereo pair Motorcycle of the Middlebury 2014 benchmark
    (Scharstein et al., "High-resolution stereo datasets with subpixel-accurate ground truth", GCPR 2014): every pixel
    of the photos became a flat Gaussian. World: meters, the left camera's axes (x right, y down, z forward).

    Raises:
        OutputError: If the folder cannot be written.
    """
    ensure_writable_folder(folder)
    ply, cameras, style = (folder / name for name in ("motorcycle.ply", "cameras.json", "starry_night.jpg"))
    example = FOLDER / "example"
    write_scene(ply, read_scene(example / "motorcycle.sog").scene)
    for source, target in ((example / "cameras.json", cameras), (STARRY_NIGHT, style)):
        with atomic_path(target) as temporary:
            temporary.write_bytes(source.read_bytes())
    return ply, cameras, style


# --- plan ----------------------------------------------------------------------------------------------------------


def make_plan(
    request: JobSpec, show_planning: ShowPlanning | None = None, sheet: Path | None = None, started: float | None = None
) -> dict[str, Any]:
    """Plan a job as `sgsst stylize` would, without making a step, and return the plan that is written as JSON.

    Args:
        request: Request whose `out` is the file of the plan.
        show_planning: Callback that shows the progress of the survey of the views.
        sheet: JPEG file for images of the views, written before the plan is made; None writes no file.
        started: Start of the time budget, in seconds since the epoch; None for now.

    Raises:
        InvalidInputError: If an input cannot be used; the first one is reported.
    """
    source, settings, out = request.source, request.settings, request.out
    left = seconds_left(settings.within, started)
    check_choice(source, request.images)
    check_suffix(out, "a JSON file", "plan.json")
    if source.cameras:
        check_is_not_input(out, source.cameras, "camera file")
    if sheet is not None:
        check_suffix(sheet, "a JPEG file", "views.jpg")
        for style in itertools.chain(request.styles, *(region.styles for region in request.regions)):
            check_is_not_input(sheet, style.path, "style image")
        folders = [request.images, *(each.selection.path for each in request.regions if each.selection)]
        if any(folder and sheet.resolve().is_relative_to(folder.resolve()) for folder in folders):
            raise SettingsError(f"{sheet}: is among the photos or masks. Name another file.")
    inputs = read_inputs(request)
    if sheet is not None:
        sheet.parent.mkdir(parents=True, exist_ok=True)
        write_views(sheet, inputs.scene_file.scene, inputs.cameras, background=settings.background, near=settings.near)
    job = dry_run(request, inputs, show_planning, left=left)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, plan := plan_json(job))
    return plan


# --- check ---------------------------------------------------------------------------------------------------------


def look_for_extremes(source: SceneRequest, style: Path | None) -> list[Finding]:
    """Return the extreme values in a scene, its views and its style. Nothing is written.

    Raises:
        InvalidInputError: If scene, cameras or style cannot be used.
    """
    image = load_image(style) if style else None
    file, capture = read_scene_and_capture(source.model_copy(update={"drop_invalid": True}))
    count = len(capture.cameras)
    about = [
        Finding("views", f"{line.item}: {line.decision}", count, count, "", line.reason) for line in capture.decisions
    ]
    return [*about, *findings_of(file, capture.cameras, image, near=source.near)]


# --- render --------------------------------------------------------------------------------------------------------


def render_views(
    source: SceneRequest,
    background: tuple[float, float, float],
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
    warn: Callable[[str], None] = lambda line: None,
) -> list[Path]:
    """Render every view into a folder as PNG, numbered in the order of the cameras. All inputs are checked first.

    Args:
        background: Background color, in 0..1.
        progress: Callback that receives the numbers of completed and of all images.
        warn: Callback for warnings about scene and cameras.

    Raises:
        InvalidInputError: If scene, cameras or folder cannot be used.
    """
    file, capture = read_scene_and_capture(source)
    cameras = capture.cameras
    images = _renders(file.scene, cameras, background, source.near)
    for line in warnings_of(capture.decisions):
        warn(line)
    ensure_writable_folder(out)
    paths = [out / name for name in view_file_names(cameras)]
    for index, (image, path) in enumerate(zip(images, paths, strict=True)):
        save_png(path, image)
        progress(index + 1, len(cameras))
    return paths


def _renders(
    scene: Scene, cameras: Sequence[Camera], background: tuple[float, float, float], near: float
) -> Iterator[Tensor]:
    """Return an iterator of the image [H, W, 3] of a scene at each camera, after checking that something is seen."""
    rasterizer = make_rasterizer("cpu", scene, background=background, near=near, memory=0)
    check_something_seen(scene, cameras, rasterizer)
    return (rasterizer.render(scene_colors(scene, camera), camera) for camera in cameras)


#: Width in pixels of a panorama, unless the request has a resolution.
PANORAMA_WIDTH = 4096


def render_panorama(
    source: SceneRequest,
    background: tuple[float, float, float],
    name: str | None,
    out: Path,
    progress: Callable[[int, int], None] = lambda done, total: None,
    warn: Callable[[str], None] = lambda line: None,
) -> Camera:
    """Render a level equirectangular PNG from the position of a camera, and return the camera.

    All inputs are checked first. Up is the requested axis, or the mean of the cameras' own up directions.

    Args:
        background: Background color, in 0..1.
        name: Name of the camera, or of the panorama in the camera file; None for the first camera.
        progress: Callback that receives the numbers of completed and of all cube faces.
        warn: Callback for warnings about scene and cameras.

    Raises:
        InvalidInputError: If scene or cameras cannot be used, no camera has this name, or `out` is not a PNG's name.
    """
    check_suffix(out, "a PNG image", "panorama.png")
    file, capture = read_scene_and_capture(source)
    cameras = capture.cameras
    camera = cameras[0] if name is None else camera_named(cameras, name)
    ups = torch.stack([-each.world_to_camera[1, :3] for each in cameras])
    requested = orbit_request(source).up
    up = ups.mean(dim=0) if requested is None else torch.tensor(requested, dtype=torch.float64)
    width = max(2, (source.resolution or PANORAMA_WIDTH) // 2 * 2)
    faces = faces_to_render(level(camera, up), width)
    renders, images = _renders(file.scene, faces, background, source.near), list[Tensor]()
    for line in warnings_of(capture.decisions):
        warn(line)
    for image in renders:
        images.append(image)
        progress(len(images), len(faces))
    out.parent.mkdir(parents=True, exist_ok=True)
    save_png(out, join_faces(images, width))
    return camera


def view_file_names(cameras: Sequence[Camera]) -> list[str]:
    """Return a file name for each view, from its number and its camera's name.

    The number comes first, so that names sort in the order of the cameras. Folders and characters that file systems may
    refuse become underscores.
    """
    digits = max(4, len(str(len(cameras) - 1)))
    stems = (re.sub(r"\.(png|jpe?g|tiff?|webp|bmp|exr)$", "", each.name, flags=re.IGNORECASE) for each in cameras)
    plain = (re.sub(r"[^A-Za-z0-9.-]+", "_", stem).strip("._")[-80:] for stem in stems)
    return [f"{index:0{digits}d}_{stem}".rstrip("_") + ".png" for index, stem in enumerate(plain)]


# --- blend ---------------------------------------------------------------------------------------------------------


def blend_files(
    texts: Sequence[str], out: Path, options: ViewOptions
) -> tuple[list[tuple[Path, float]], list[Decision]]:
    """Write the weighted mean of scenes that differ only in color.

    Returns:
        Each scene with its normalized weight, and warnings about what the format cannot hold.

    Args:
        texts: FILE or FILE:WEIGHT of each scene.

    Raises:
        InvalidInputError: If the weights, a scene or the output cannot be used.
    """
    names, weights = zip(*map(split_weight, texts), strict=True)
    paths = [local_path(name) for name in names]
    if len(paths) < 2:
        raise SettingsError("There is one scene to blend. Give at least two, such as scene.ply:0.3 stylized.ply:0.7.")
    fractions = normalized(weights)
    parts = [(SceneRequest.of(path, None, options), weight) for path, weight in zip(paths, weights, strict=True)]
    return list(zip(paths, fractions, strict=True)), blend(parts, out)


# --- bench -----------------------------------------------------------------------------------------------------------


def _read_variants(
    inputs: VariantsInputs, options: ViewOptions, chosen: StylizeOptions, variants: str, out: Path
) -> tuple[SceneFile, dict[str, Any], dict[str, Any]]:
    """Check and read the files of a comparison of variants; the quick checks come first.

    Args:
        chosen: Options of all variants, on top of the standard preset.
        variants: Names of variants, separated by commas; empty for all.
        out: Folder for plots, JSON and scenes.

    Returns:
        The scene's file, the arguments of `error_time` besides `progress`, and the comparison as a JSON object.
    """
    from sgsst_core.bench.variants import choose_variants

    compared = choose_variants([name.strip() for name in variants.split(",") if name.strip()])
    weights = load_network_weights(chosen.backbone)
    style = load_image(inputs.style)
    file, capture = read_scene_and_capture(source_of(inputs.scene, inputs.cameras, options))
    ensure_writable_folder(out)
    settings = {**chosen.given_settings(), "near": options.near}
    read = {"scene": file.scene, "cameras": capture.cameras, "style": style, "variants": compared, "weights": weights}
    described = {
        "version": 1,
        "scene": "/".join(inputs.scene.absolute().parts[-2:]),
        "style": inputs.style.name,
        "views": len(capture.cameras),
        "sizes": [list(size) for size in sorted({(camera.width, camera.height) for camera in capture.cameras})],
        "budget_seconds": inputs.seconds,
        "settings": settings,
        "backbone": weights.name,
        "machine": machine(torch.device("cuda" if torch.cuda.is_available() else "cpu")),
    }
    return file, {**read, "seconds": inputs.seconds, **settings}, described


def run_error_time(
    inputs: VariantsInputs, options: ViewOptions, chosen: StylizeOptions, variants: str, out: Path, progress: Any
) -> list[Curve]:
    """Run the variants, and write `error_time.json`, `error_time.png` and each variant's scene into the folder.

    The other arguments are those of `_read_variants`.

    Args:
        progress: Callback that receives a curve after each of its evaluations.

    Raises:
        InvalidInputError: If an input cannot be used; the first one is reported.
    """
    from sgsst_core.bench.variants import as_dict, error_time, write_plot

    file, arguments, described = _read_variants(inputs, options, chosen, variants, out)
    curves = error_time(**arguments, progress=progress)
    write_json(out / "error_time.json", {**described, **as_dict(curves)})
    write_plot(out / "error_time.png", curves, f"{described['scene']}, {described['style']}")
    for curve in curves:
        if curve.sh_dc is not None:
            write_stylized(file, out / f"{curve.variant.name}.ply", curve.sh_dc)
    return curves


def run_quality(
    inputs: VariantsInputs, options: ViewOptions, chosen: StylizeOptions, variants: str, out: Path, progress: Any
) -> Quality:
    """Run the variants, measure their quality, and write `quality.json`, plots, `quality.jpg` and scenes.

    Arguments and errors are those of `run_error_time`.
    """
    from sgsst_core.bench.variants import compare_quality, write_plot, write_quality_plot, write_sheet

    file, arguments, described = _read_variants(inputs, options, chosen, variants, out)
    quality = compare_quality(**arguments, progress=progress)
    write_json(out / "quality.json", {**described, **quality.as_dict()})
    write_quality_plot(out / "quality.png", quality, f"{described['scene']}, {described['style']}")
    write_plot(out / "error_time.png", quality.curves, f"{described['scene']}, {described['style']}")
    write_sheet(out / "quality.jpg", quality)
    for outcome in quality.outcomes[1:]:
        write_stylized(file, out / f"{outcome.name}.ply", outcome.sh_dc)
    return quality


def quality_table(quality: Quality) -> Table:
    """Return a table of the quality measures of each variant. A star marks variants on the Pareto front."""
    figures = ("style", "interior style", "sliced features", "color distance", "content", "SSIM")
    ranges = [f"{reach} range {measure}" for reach in ("short", "long") for measure in ("RMSE", "LPIPS")]
    columns = (*figures, "background sensitivity", "saturated", *ranges, "remaining loss", "steps")
    table = Table(
        Column("", no_wrap=True),
        *columns,
        title="distances after the same time, lower is better (SSIM: higher); * = Pareto front of style and content",
    )
    front = quality.front()
    for outcome in quality.outcomes:
        one = outcome.judgment
        drifts = [getattr(pairs, name, None) for pairs in (outcome.short, outcome.long) for name in ("rmse", "lpips")]
        table.add_row(
            outcome.name + (" *" if outcome in front else ""),
            *(_number(value) for value in (one.style, one.interior_style, one.sliced_features)),
            f"{one.color_distance:.0f}",
            *(_number(value) for value in (one.content, one.ssim, one.background_sensitivity)),
            f"{one.saturated:.1%}",
            *(_number(value) for value in drifts),
            _number(outcome.loss),
            str(outcome.steps or "-"),
        )
    return table


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def point_line(curve: Curve) -> str:
    """Return the last evaluation of a curve as a line for a log."""
    name, point = curve.variant.name, curve.points[-1]
    remains = "the initial loss was 0," if point.relative is None else f"{point.relative:.2%} of the loss remains"
    return f"{name}: {remains} after {point.seconds:.1f} s, {point.step} steps"


# --- study -----------------------------------------------------------------------------------------------------------

#: Longer side in pixels of the views on the page, unless the request has another.
STUDY_SIDE = 960


def key_path(page: Path) -> Path:
    """Return the path of the key of a study, given its page."""
    return page.with_suffix(".key.json")


def make_study(
    variants: Sequence[str], source: SceneRequest, style: Path, background: tuple[float, float, float], page: Path
) -> None:
    """Render all variants at the same views, and write the page of a study and its key.

    Args:
        variants: Scenes to compare, each as FILE or NAME=FILE.
        source: Cameras and view options; its scene is replaced by each variant. An orbit is placed around the first.
        page: HTML file to write; the key goes beside it.

    Raises:
        InvalidInputError: If an input cannot be used; the first one is reported.
    """
    scenes = [named(text) for text in variants]
    check_names([name for name, _ in scenes])
    check_suffix(page, "an HTML file", "study.html")
    sources = [source.model_copy(update={"scene": path}) for _, path in scenes]
    image = load_image(style)
    side = source.resolution or STUDY_SIDE
    cameras = [resized(camera, min(side, camera.side)) for camera in read_scene_and_capture(sources[0])[1].cameras]

    def render(index: int) -> list[Tensor]:
        return list(_renders(read_scene_and_capture(sources[index])[0].scene, cameras, background, source.near))

    page.parent.mkdir(parents=True, exist_ok=True)
    write_study(page, key_path(page), [name for name, _ in scenes], image, len(cameras), render)


def named(text: str) -> tuple[str, Path]:
    """Return the name and the path of a variant, given as NAME=FILE, or as FILE, which is its own name."""
    name, equals, path = text.partition("=")
    return (name, local_path(path)) if equals and not Path(text).exists() else (text, local_path(text))


def share_table(shares: Sequence[VoteShare]) -> Table:
    """Return a table with each variant's fraction of the votes and its 95 % interval."""
    table = Table("variant", "votes", "share", "95 % interval", title=f"{shares[0].total} votes")
    for share in shares:
        interval = f"{share.low:.1%} to {share.high:.1%}"
        table.add_row(share.variant, str(share.votes), f"{share.votes / share.total:.1%}", interval)
    return table
