"""Implementation of the commands `plan`, `check`, `render` and `blend`.

The functions check all inputs, compute, and write the outputs, but print nothing. `stylize` is implemented by
`worker.run`, and `convert` by `worker.derived`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from api.cli.arguments import local_path
from sgsst_core.devices import seconds_left
from sgsst_core.errors import OutputError, SettingsError
from sgsst_core.files.atomic import ensure_writable_folder, write_json
from sgsst_core.files.blending import normalized
from sgsst_core.files.images import load_image, save_png
from sgsst_core.planning.survey import ShowPlanning
from sgsst_core.progress import Decision, warnings_of
from sgsst_core.quality.findings import Finding, findings_of, render_mode_findings
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.report.document import plan_json
from sgsst_core.report.images import write_views
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from worker.derived import blend
from worker.inputs import check_something_seen, read_inputs, read_scene_and_capture
from worker.job import JobSpec, SceneRequest, check_choice
from worker.options import ViewOptions, split_weight
from worker.outputs import check_is_not_input
from worker.prepare import dry_run

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
    job = dry_run(request, inputs, show_planning, left=left)
    out.parent.mkdir(parents=True, exist_ok=True)
    write_json(out, plan := plan_json(job))
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
    rasterizer = make_rasterizer("cpu", scene, background=background, near=source.near, memory=0)
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
    warnings = blend(parts, out)
    return list(zip(paths, fractions, strict=True)), warnings
