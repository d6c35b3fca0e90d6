"""Implementation of the commands `plan`, `check`, `render`, `convert` and `blend`.

The functions check all inputs, compute, and write the outputs, but print nothing. `stylize` is implemented by
`worker.prepare` and `worker.execute`, on one rank or several.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from api.cli.arguments import local_path
from sgsst_core.decision import Decision, warnings_of
from sgsst_core.errors import OutputError, SettingsError
from sgsst_core.files.atomic import ensure_writable_folder, write_json
from sgsst_core.files.blending import blend_scenes, normalized
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.sog import META_NAME
from sgsst_core.files.formats.spz import SpzAxes
from sgsst_core.files.images import load_image, save_png
from sgsst_core.files.library import load_scene, save
from sgsst_core.files.scene_file import read_scene, write_scene, write_sog_folder
from sgsst_core.files.trainer_checkpoints import TrainerCheckpoint
from sgsst_core.files.usd import USD_SUFFIXES, check_usd, write_usd
from sgsst_core.planning.plan import Plan
from sgsst_core.planning.survey import ShowPlanning
from sgsst_core.quality.findings import Finding, findings_of, render_mode_findings
from sgsst_core.quality.scene_difference import CompressionLoss, measure_compression
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.report.contact_sheet import write_views
from sgsst_core.report.document import plan_json
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from worker.capture import about_notes, about_rendering, choose_axes, read_capture
from worker.inputs import check_something_seen, read_inputs, read_scene_and_capture
from worker.job import JobSpec, SceneRequest, check_choice
from worker.outputs import check_is_not_input, result_format
from worker.prepare import describe_scene, dry_run
from worker.styles import split_weight

#: Number of views of an orbit that a converted scene is compared in.
_COMPARED_VIEWS = 3

# --- plan ----------------------------------------------------------------------------------------------------------


def make_plan(request: JobSpec, show_planning: ShowPlanning | None = None, sheet: Path | None = None) -> Plan:
    """Plan a job as `sgsst stylize` would, without making a step, and write the plan as JSON.

    Args:
        request: Request whose `out` is the file of the plan.
        show_planning: Callback that shows the progress of the survey of the views.
        sheet: JPEG file for images of the views, written before the plan is made; None writes no file.

    Raises:
        InvalidInputError: If an input cannot be used; the first one is reported.
    """
    source, settings, out = request.source, request.settings, request.out
    check_choice(source, request.images)
    if out.suffix.lower() != ".json":  # a mistyped path must not overwrite a scene or its cameras
        raise OutputError(f"{out}: not the name of a JSON file. Give one, such as plan.json.")
    if source.cameras:
        check_is_not_input(out, source.cameras, "camera file")
    if sheet is not None:
        if sheet.suffix.lower() not in (".jpg", ".jpeg"):
            raise OutputError(f"{sheet}: not the name of a JPEG file. Give one, such as views.jpg.")
        for path, description in _input_images(request):
            check_is_not_input(sheet, path, description)
    inputs = read_inputs(request)
    if sheet is not None:
        sheet.parent.mkdir(parents=True, exist_ok=True)
        scene = inputs.scene_file.scene
        write_views(sheet, scene, inputs.cameras, background=settings.background, near=settings.near)
    plan = dry_run(request, inputs, show_planning)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, plan_json(plan))
    return plan


def _input_images(request: JobSpec) -> Iterator[tuple[Path, str]]:
    """Yield the path and the description of each image that a job may read."""
    for style in (*request.styles, *(each for region in request.regions for each in region.styles)):
        yield style.path, "style image"
    for region in request.regions:
        if region.selection and region.selection.kind == "masks" and region.selection.path:
            yield from ((path, "mask") for path in region.selection.path.rglob("*"))
    if request.images:
        yield from ((path, "photo") for path in request.images.rglob("*"))


# --- check ---------------------------------------------------------------------------------------------------------


def look_for_extremes(source: SceneRequest, style: Path | None) -> list[Finding]:
    """Return the extreme values in a scene, its views and its style. Nothing is written.

    Raises:
        InvalidInputError: If scene, cameras or style cannot be used.
    """
    check_choice(source)
    image = load_image(style) if style else None
    file, capture = read_scene_and_capture(source.model_copy(update={"drop_invalid": True}))
    count = len(capture.cameras)
    about = [
        Finding("views", f"{line.item}: {line.decision}", count, count, "", line.reason) for line in capture.decisions
    ]
    modes = render_mode_findings(file, capture.cameras, near=source.near)
    return [*about, *modes, *findings_of(file, capture.cameras, image, near=source.near)]


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
    check_choice(source)
    file, capture = read_scene_and_capture(source)
    scene, cameras = file.scene, capture.cameras
    rasterizer = make_rasterizer("cpu", scene, background=background, near=source.near)
    check_something_seen(scene, cameras, rasterizer)
    for line in warnings_of(capture.decisions):
        warn(line)
    ensure_writable_folder(out)
    paths = [out / name for name in view_file_names(cameras)]
    for index, (camera, path) in enumerate(zip(cameras, paths, strict=True)):
        colors = view_colors(scene.sh_dc, rest_colors(scene.sh_rest, scene.means, camera))
        save_png(path, rasterizer.render(colors, camera))
        progress(index + 1, len(cameras))
    return paths


def view_file_names(cameras: Sequence[Camera]) -> list[str]:
    """Return a file name for each view, from its number and its camera's name.

    The number comes first, so that names sort in the order of the cameras. Folders and characters that file systems may
    refuse become underscores.
    """
    digits = max(4, len(str(len(cameras) - 1)))
    names = []
    for index, camera in enumerate(cameras):
        stem = re.sub(r"\.(png|jpe?g|tiff?|webp|bmp|exr)$", "", camera.name, flags=re.IGNORECASE)
        plain = re.sub(r"[^A-Za-z0-9.-]+", "_", stem).strip("._")[-80:]
        names.append(f"{index:0{digits}d}_{plain}.png" if plain else f"{index:0{digits}d}.png")
    return names


# --- convert -------------------------------------------------------------------------------------------------------


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


def convert_scene(source: SceneRequest, out: Path, compare: bool) -> Converted:
    """Write a scene in the format that the name of a file determines. Colors and order may change by its rounding.

    Args:
        source: Scene or checkpoint of a trainer, and cameras for the comparison; without cameras, views are those of an
            orbit.
        out: File to write: a scene, the meta.json of an unpacked SOG, or a USD file, which cannot be compared.
        compare: Whether to read the file back and compare renders.

    Raises:
        InvalidInputError: If scene, cameras or output cannot be used.
    """
    _check_target(out, compare)
    check_is_not_input(out, source.scene)
    if compare and source.cameras is None:
        source = source.model_copy(update={"orbit": _COMPARED_VIEWS})
    axes, decisions = choose_axes(source)
    loaded = load_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=axes)
    file = loaded.scene_file() if isinstance(loaded, TrainerCheckpoint) else loaded
    file = file.rendered(source.render_mode, source.eps2d)
    scene, decisions = file.scene, [*about_notes(file), *decisions, *about_rendering(file)]
    cameras: list[Camera] = []
    if source.cameras or source.orbit:
        capture = read_capture(source, scene).checked(scene, source.near)
        cameras, decisions = capture.cameras, [*decisions, *capture.decisions]
    out.parent.mkdir(parents=True, exist_ok=True)
    size = _write_as(out, scene)
    decisions += _about_lost_mode(out, scene)
    loss = replace(measure_compression(out, scene, cameras, near=source.near), size=size) if compare else None
    return Converted(describe_scene(file), tuple(decisions), loss)


def _check_target(out: Path, compare: bool) -> None:
    """Check that the name of a file determines a format that can be written and, if requested, compared."""
    if out.suffix.lower() in USD_SUFFIXES:
        check_usd(out)
        if compare:
            raise OutputError(f"{out}: USD can only be written, so it cannot be compared. Omit --compare.")
    elif out.name != META_NAME:
        result_format(out)


def _about_lost_mode(out: Path, scene: Scene) -> list[Decision]:
    """Return a warning if the format of the written file cannot record the scene's render mode."""
    stated = CLASSIC if out.suffix.lower() in USD_SUFFIXES else read_scene_header(out).tag.rendering
    if stated == scene.rendering:
        return []
    reason = f"its format cannot state {scene.rendering.text}"
    return [Decision("rendering", f"warning: {out.name} will be drawn {stated.text}", reason)]


def _write_as(out: Path, scene: Scene) -> int:
    """Write a scene in the format that the name of a file determines. Return the bytes that it takes."""
    if out.name == META_NAME:
        return write_sog_folder(out.parent, scene)
    if out.suffix.lower() in USD_SUFFIXES:
        write_usd(out, scene)
    else:
        write_scene(out, scene, result_format(out))
    return out.stat().st_size


# --- blend ---------------------------------------------------------------------------------------------------------


def blend_files(texts: Sequence[str], out: Path, *, drop_invalid: bool, spz_axes: SpzAxes) -> list[tuple[Path, float]]:
    """Write the weighted mean of scenes that differ only in color, and return each scene with its normalized weight.

    Args:
        texts: FILE or FILE:WEIGHT of each scene.
        drop_invalid: Whether to drop invalid Gaussians; see `read_scene`.

    Raises:
        InvalidInputError: If the weights, a scene or the output cannot be used.
    """
    names, weights = zip(*map(split_weight, texts), strict=True)
    paths = [local_path(name) for name in names]
    if len(paths) < 2:
        raise SettingsError("There is one scene to blend. Give at least two, such as scene.ply:0.3 stylized.ply:0.7.")
    fractions = normalized(weights)
    result_format(out)
    for path in paths:
        check_is_not_input(out, path)
    files = [read_scene(path, drop_invalid=drop_invalid, spz_axes=spz_axes) for path in paths]
    blend = blend_scenes(files, weights)
    out.parent.mkdir(parents=True, exist_ok=True)
    save(out, blend)
    return list(zip(paths, fractions, strict=True))
