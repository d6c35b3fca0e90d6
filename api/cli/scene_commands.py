"""Commands that read scenes: `plan`, `check`, `render`, `convert`, `blend`, `view`, `paint`, `bench` and `study`.

Results are compared by benchmarks on one's own scene and machine (`bench`), and blindly by eye (`study`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.table import Column, Table

from api.cli.console import counting_bar, error_console, out_console, print_field
from api.cli.options import (
    CamerasOption,
    JobArguments,
    OptionalStyleOption,
    PaintedOption,
    SceneArgument,
    StyleOption,
    file_to_write,
    folder_to_write,
    path_to_read,
    source_of,
    with_arguments,
    with_options,
)
from sgsst_core.errors import SettingsError
from sgsst_core.files.formats import RESULT_SUFFIXES
from sgsst_core.progress import duration, job_bar
from worker.job import JobSpec, Outputs, SceneRequest, check_suffix
from worker.options import (
    ESSENTIALS,
    MOST_VIEWPOINTS,
    PaintedFile,
    StylizeOptions,
    VideoOptions,
    ViewOptions,
    Viewpoints,
)

if TYPE_CHECKING:
    from sgsst_core.bench.variants import Curve


@with_options(StylizeOptions, without=("workers",))
@with_arguments(JobArguments)
def plan(
    context: typer.Context,
    inputs: JobArguments,
    out: Annotated[
        Path, typer.Option(help="JSON file to write the plan to.", callback=file_to_write, rich_help_panel=ESSENTIALS)
    ] = Path("plan.json"),
    sheet: Annotated[
        Path | None, typer.Option(help="JPEG file to write with images of the views.", callback=file_to_write)
    ] = None,
    *,
    options: StylizeOptions,
) -> None:
    """Show what a stylization would skip and why, and what a step would cost."""
    from api.cli.scene_tools import make_plan
    from sgsst_core.compiled import compilations_reported

    request = inputs.request(options, out)
    with job_bar(error_console) as bar, compilations_reported(bar.show_compiling):
        plan = make_plan(request, bar.show, sheet, context.obj.started)
    out_console.print(_decisions_table(plan["decisions"]))
    expected = plan["prediction"]
    gpu = f" (GPU: {expected['device_bytes'] / 1e9:.1f} GB)" if expected["device_bytes"] is not None else ""
    whole = f"about {duration(expected['job'], ' ')} for all steps, {duration(expected['seconds'], ' ')} each"
    out_console.print(f"Estimated: {whole}; memory at most {expected['peak_bytes'] / 1e9:.1f} GB{gpu}")
    if sheet is not None:
        print_field("views", sheet)
    print_field("plan", out)


def _decisions_table(decisions: list[dict[str, Any]]) -> Table:
    table = Table(Column("item", no_wrap=True), "decision and reason", Column("saves", no_wrap=True), show_lines=True)
    for each in decisions:
        saved = "" if each["bytes"] is None else f"{each['bytes'] / 1e6:.1f} MB"
        error = "" if each["error"] == "none" else f" Costs: {each['error']}."
        table.add_row(each["item"], f"{each['decision']}: {each['reason']}.{error}", saved)
    return table


@with_options(ViewOptions, without=("drop_invalid",))
def check(
    scene: SceneArgument, cameras: CamerasOption = None, style: OptionalStyleOption = None, *, options: ViewOptions
) -> None:
    """Report extreme values in a scene, its views and its style, and their consequences."""
    from api.cli.scene_tools import look_for_extremes

    source = source_of(scene, cameras, options)
    with error_console.status("Checking the scene and every view"):
        findings = look_for_extremes(source, style)
    if not findings:
        out_console.print("No extreme values were found.")
        return
    table = Table("finding", Column("count", justify="right"), "worst", "consequence", show_lines=True)
    for item in findings:
        table.add_row(f"{item.subject}: {item.what}", f"{item.count:,} of {item.total:,}", item.worst, item.done)
    out_console.print(table)


@with_options(ViewOptions)
@with_options(VideoOptions, "video_options")
@with_options(StylizeOptions, "chosen", only=("background",))
def render(
    scene: SceneArgument,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for a PNG image of each view.", callback=folder_to_write, rich_help_panel=ESSENTIALS),
    ] = None,
    video: Annotated[
        Path | None,
        typer.Option(
            help="Video to write instead: a .mp4 file (H.264), a .webm file (VP9), a folder or a pattern such as "
            "frame_%04d.png for PNG images.",
            rich_help_panel=ESSENTIALS,
        ),
    ] = None,
    panorama: Annotated[
        Path | None,
        typer.Option(
            help="360-degree image to write instead: a level equirectangular PNG from the position of a camera, 4096 "
            "pixels wide, or --resolution.",
            callback=file_to_write,
            rich_help_panel=ESSENTIALS,
        ),
    ] = None,
    cameras: CamerasOption = None,
    position: Annotated[
        str | None,
        typer.Option("--from", metavar="NAME", help="Camera of the 360-degree image. [default: the first one]"),
    ] = None,
    compare: Annotated[
        Path | None,
        path_to_read("Unstylized scene: the video starts with it and ends with SCENE."),
    ] = None,
    transparent: Annotated[
        bool, typer.Option("--transparent", help="Write an alpha channel, to a .webm file or PNG images of a video.")
    ] = False,
    *,
    options: ViewOptions,
    video_options: VideoOptions,
    chosen: StylizeOptions,
) -> None:
    """Render all views of a scene as images, a video along a camera path, or a 360-degree image."""
    background = chosen.settings().background
    given = [*video_options.model_fields_set, *(["compare"] if compare else []), *(["transparent"] * transparent)]
    if [out, video, panorama].count(None) != 2:
        raise SettingsError(
            "Give one of --out FOLDER for images of the views, --video FILE for a video, and --panorama FILE for a "
            "360-degree image."
        )
    if position is not None and panorama is None:
        raise SettingsError("--from requires --panorama. Add it, or omit --from.")
    around = video is not None and video_options.path == "orbit"
    source = (SceneRequest.of if around else source_of)(scene, cameras, options)
    if video is not None:
        from worker.derived import VideoRequest, check_video_request, render_video

        request = VideoRequest(source, video, video_options, background, compare, transparent)
        check_video_request(request)
        with counting_bar("rendering", in_bytes=False) as progress:
            shown = render_video(request, progress, _print_warning)
        fps, size = video_options.fps, f"{shown[0].width}x{shown[0].height}"
        out_console.print(f"{len(shown)} frames of {size}, {len(shown) / fps:.3g} s at {fps} per second, in {video}")
    elif given:
        raise SettingsError(f"--{given[0]} requires --video. Add it, or omit --{given[0]}.")
    elif panorama is not None:
        from api.cli.scene_tools import render_panorama

        with counting_bar("rendering", in_bytes=False) as progress:
            camera = render_panorama(source, background, position, panorama, progress, _print_warning)
        print_field("panorama", f"{panorama}, from the position of {camera.name}")
    elif out is not None:
        from api.cli.scene_tools import render_views

        with counting_bar("rendering", in_bytes=False) as progress:
            paths = render_views(source, background, out, progress, _print_warning)
        out_console.print(f"{len(paths)} view{'s' if len(paths) > 1 else ''} in {out}")


def _print_warning(line: str) -> None:
    error_console.print(f"warning: {line}")


@with_options(ViewOptions, only=("near", "drop_invalid", "spz_axes", "render_mode", "eps2d"))
@with_options(StylizeOptions, "chosen", only=("pad_sh",))
def convert(
    scene: SceneArgument,
    out: Annotated[
        Path,
        typer.Argument(
            metavar="OUT",
            help=f"Scene to write: {RESULT_SUFFIXES}; meta.json for an unpacked SOG, lod-meta.json or .zip for a "
            "streamed SOG, .usdc for OpenUSD.",
            callback=file_to_write,
            show_default=False,
        ),
    ],
    compare: Annotated[
        bool, typer.Option("--compare", help="Report the PSNR of small renders against those of the scene.")
    ] = False,
    cameras: Annotated[
        Path | None,
        path_to_read("Cameras that --compare renders, and that decide the axes of an SPZ. [default: an orbit]"),
    ] = None,
    levels_of: Annotated[
        Path | None,
        path_to_read("Streamed SOG that SCENE was made from: its coarser levels take the nearest changes of color."),
    ] = None,
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Convert a scene to another format, which the name of OUT determines."""
    from worker.derived import convert as convert_scene

    source = SceneRequest.of(scene, cameras, options)
    converted = convert_scene(source, out, compare=compare, levels_of=levels_of, pad_sh=chosen.pad_sh)
    for line in converted.decisions:
        print_field(line.item, f"{line.decision}: {line.reason}")
    if converted.loss is not None:
        print_field("compared", converted.loss.text(scene.name))
    print_field("scene", f"{out}, {converted.scene}")


@with_options(ViewOptions, only=("drop_invalid", "spz_axes", "render_mode", "eps2d"))
def view(
    scene: SceneArgument,
    out: Annotated[
        Path,
        typer.Option(
            help="HTML file to write.", callback=file_to_write, show_default=False, rich_help_panel=ESSENTIALS
        ),
    ],
    original: Annotated[
        Path | None,
        path_to_read("Unstylized scene to compare with, by a wipe and a blend.", rich_help_panel=ESSENTIALS),
    ] = None,
    title: Annotated[str | None, typer.Option(help="Title of the page. [default: the name of the scene]")] = None,
    cameras: Annotated[
        Path | None, path_to_read("Cameras that --start and --views name. [default: the page shows the whole scene]")
    ] = None,
    start: Annotated[
        str | None, typer.Option(metavar="NAME", help="Camera at which the page opens. [default: the first one]")
    ] = None,
    views: Annotated[
        str,
        typer.Option(
            metavar="NAME,...",
            help=f"Up to {MOST_VIEWPOINTS} cameras that the page jumps to, by buttons and the keys 1 to 9.",
        ),
    ] = "",
    *,
    options: ViewOptions,
) -> None:
    """Write a scene as one HTML file, which shows it in 3D in a browser, without a server."""
    from api.static_files import exported_viewer
    from worker.derived import viewpoint_of, write_page
    from worker.inputs import read_capture, read_requested
    from worker.painting import camera_named

    check_suffix(out, "an HTML file", "scene.html")
    names = [name.strip() for name in views.split(",") if name.strip()]
    if (start or names) and cameras is None:
        raise SettingsError("--start and --views name cameras. Add --cameras, or omit them.")
    if len({*names}) < len(names) or len(names) > MOST_VIEWPOINTS:
        raise SettingsError(f"--views {views}: must be at most {MOST_VIEWPOINTS} names, each of them once.")
    source = SceneRequest.of(scene, cameras, options)
    with error_console.status("Compressing the scene"):
        file, _ = read_requested(source)
        before = None if original is None else read_requested(source.model_copy(update={"scene": original}))[0]
        capture = None if cameras is None else read_capture(source, file.scene)
        at, *named = (
            viewpoint_of(camera_named(capture.cameras, name)) if capture and name else None for name in (start, *names)
        )
        viewpoints = Viewpoints(start=at, named=[*filter(None, named)])
        write_page(
            out,
            exported_viewer(),
            file,
            before,
            title or scene.name.partition(".")[0],
            cameras=capture.cameras if capture else (),
            viewpoints=viewpoints,
        )
    print_field("page", f"{out}, {out.stat().st_size / 1e6:.1f} MB: open it in a browser")


@with_options(ViewOptions, only=("drop_invalid", "spz_axes"))
def blend(
    scenes: Annotated[
        list[str],
        typer.Argument(
            metavar="SCENE[:WEIGHT]...",
            help="Scenes that differ only in color, such as a scene and its results. Weights are divided by their sum; "
            "scene.ply:-0.5 stylized.ply:1.5 exaggerates the style by half.",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help=f"Scene to write: {RESULT_SUFFIXES}.",
            callback=file_to_write,
            show_default=False,
            rich_help_panel=ESSENTIALS,
        ),
    ],
    *,
    options: ViewOptions,
) -> None:
    """Blend scenes that differ only in color: a scene and its results, or several results."""
    from api.cli.scene_tools import blend_files

    blended, warnings = blend_files(scenes, out, options)
    for line in warnings:
        print_field(line.item, f"{line.decision}: {line.reason}")
    for path, weight in blended:
        print_field("weight", f"{weight:.4g} of {path}")
    print_field("scene", out)


@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=("background",))
def paint(
    scene: SceneArgument,
    out: Annotated[
        Path,
        typer.Option(
            help=f"Scene to write: {RESULT_SUFFIXES}; with --export, the PNG to paint on.",
            callback=file_to_write,
            show_default=False,
            rich_help_panel=ESSENTIALS,
        ),
    ],
    view: PaintedOption = None,
    export: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Write the picture of a view to paint on.", rich_help_panel=ESSENTIALS),
    ] = None,
    cameras: CamerasOption = None,
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Paint one view or several, and the scene follows."""
    from worker.painting import export_view, run_painting
    from worker.run import Listener, WorkerOptions

    if bool(view) == (export is not None):
        raise SettingsError("Give --export NAME to write an image, or --view NAME=FILE with a painted one.")
    source, settings = source_of(scene, cameras, options), chosen.settings()
    if export is not None:
        camera = export_view(source, export, settings.background, out)
        print_field("image", f"{out}, {camera.width}x{camera.height}: paint on it, then use --view {out}")
        return
    paintings = tuple(PaintedFile.parse(text) for text in view or ())
    request = JobSpec(source=source, styles=(), out=out, settings=settings, paintings=paintings)
    with counting_bar("painting", in_bytes=False) as progress:
        result = run_painting(request, Listener(progress=lambda now: progress(now.step, now.total)), WorkerOptions())
    print_field("painted pixels", f"{result.psnr_before:.1f} dB before, {result.psnr_after:.1f} dB after")
    print_field("scene", out)
    print_field("report", Outputs.of(out).report)


#: Options of a job that apply to all variants.
_OF_VARIANTS = ("coarsest_side", "background", "backbone", "memory_limit", "seed")
#: Width in characters of a table that a narrower terminal would truncate.
_TABLE_WIDTH = 180

bench_app = typer.Typer(help="Benchmarks for your own scene and machine.", no_args_is_help=True)


@dataclass(frozen=True)
class VariantsInputs:
    """Arguments of a command that compares variants; see `with_arguments`."""

    scene: SceneArgument
    style: StyleOption
    cameras: CamerasOption = None
    seconds: Annotated[float, typer.Option(min=1, max=1e6, help="Seconds of optimization per variant.")] = 300.0


@bench_app.command("error-time")
@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=_OF_VARIANTS)
@with_arguments(VariantsInputs)
def error_time(
    inputs: VariantsInputs,
    out: Annotated[Path, typer.Option(help="Folder for plot, JSON and scenes.", callback=folder_to_write)] = Path(
        "error_time"
    ),
    variants: Annotated[str, typer.Option(help="Names of variants, separated by commas. [default: all]")] = "",
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Run variants of a job for the same time each, and plot the remaining error against time."""
    from api.cli.scene_tools import point_line, run_error_time

    curves = run_error_time(inputs, options, chosen, variants, out, lambda curve: out_console.print(point_line(curve)))
    _print_skipped_variants(curves, out)


@bench_app.command()
@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=_OF_VARIANTS)
@with_arguments(VariantsInputs)
def quality(
    inputs: VariantsInputs,
    out: Annotated[
        Path, typer.Option(help="Folder for JSON, plots, images and scenes.", callback=folder_to_write)
    ] = Path("quality"),
    variants: Annotated[
        str, typer.Option(help="Names of variants, separated by commas.")
    ] = "standard,one-scale,cold-start",
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Run variants of a job for the same time each, and judge results with a network that none of them optimizes."""
    from api.cli.scene_tools import point_line, quality_table, run_quality

    quality = run_quality(inputs, options, chosen, variants, out, lambda curve: error_console.print(point_line(curve)))
    Console(width=_TABLE_WIDTH).print(quality_table(quality))
    _print_skipped_variants(quality.curves, out)


def _print_skipped_variants(curves: "Sequence[Curve]", out: Path) -> None:
    """Print which variants were skipped, and where the results are."""
    for curve in curves:
        if curve.left_out:
            out_console.print(f"{curve.variant.name} was skipped: {curve.left_out}")
    print_field("results", out)


#: Number of views of a study, unless --views sets it.
_VIEWS = 12

study_app = typer.Typer(help="Blind comparisons of results by eye.", no_args_is_help=True)


@study_app.command("make")
@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=("background",))
def make(
    variants: Annotated[
        list[str], typer.Argument(metavar="[NAME=]SCENE...", help="Two to four scenes to compare.", show_default=False)
    ],
    style: StyleOption,
    out: Annotated[Path, typer.Option(help="HTML page to write.", callback=file_to_write)] = Path("study.html"),
    cameras: CamerasOption = None,
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Write a page on which people choose the best of two to four results, without seeing which is which.

    The page is one file, works offline and saves the votes as JSON. Keep the key, which is written beside it.
    """
    from api.cli.scene_tools import key_path, make_study, named

    source = source_of(named(variants[0])[1], cameras, options)
    if options.views is None and options.orbit is None:
        source = source.model_copy(update={"views": _VIEWS})
    with error_console.status("Rendering the views"):
        make_study(variants, source, style, chosen.settings().background, out)
    print_field("page", out)
    print_field("key", key_path(out))


@study_app.command("count")
def count(
    key: Annotated[Path, typer.Argument(help="Key of the study.", show_default=False)],
    votes: Annotated[list[Path], typer.Argument(help="Files of votes.", show_default=False)],
) -> None:
    """Print each variant's share of the votes, with 95 % Wilson intervals."""
    from api.cli.scene_tools import share_table
    from sgsst_core.quality.study import count_votes

    out_console.print(share_table(count_votes(key, votes)))
