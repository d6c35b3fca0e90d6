"""`sgsst paint`: a picture of a view to paint on, and the scene that follows what was painted."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from api.cli.arguments import CamerasOption, SceneArgument, file_to_write, source_of
from api.cli.console import error_console, out_console, print_field
from api.cli.options import with_options
from sgsst_core.errors import SettingsError
from sgsst_core.stylizing.progress_bar import live_bar
from worker.options import ESSENTIALS, StylizeOptions, ViewOptions


@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=("background",))
def paint(
    scene: SceneArgument,
    out: Annotated[
        Path,
        typer.Option(
            help="Painted PLY to write; with --export, the PNG to paint on.",
            callback=file_to_write,
            show_default=False,
            rich_help_panel=ESSENTIALS,
        ),
    ],
    view: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=FILE",
            help="Painted picture of a view, of the same size as the view; may be repeated. Transparent pixels are "
            "left alone.",
            rich_help_panel=ESSENTIALS,
        ),
    ] = None,
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
    from worker.painting import PaintRequest, export_view, paint_scene, write_painted

    if bool(view) == (export is not None):
        raise SettingsError("Give --export NAME to write a picture, or --view NAME=FILE with a painted one.")
    source, background = source_of(scene, cameras, options), chosen.settings().background
    if export is not None:
        camera = export_view(source, export, background, out)
        print_field("picture", f"{out}, {camera.width}x{camera.height}: paint on it, then use --view {export}={out}")
        return
    request = PaintRequest(source, _paintings(view or []), background)
    with live_bar(error_console) as bar:
        task = bar.add_task("painting", total=None)
        file, painted = paint_scene(request, lambda done, total: bar.update(task, completed=done, total=total))
    report = write_painted(out, file, painted)
    print_field("painted pixels", f"{painted.psnr_before:.1f} dB before, {painted.psnr_after:.1f} dB after")
    print_field("Gaussians", f"{painted.determined:,} of {len(file.scene):,} are determined; the others follow them")
    print_field("scene", out)
    out_console.print(f"report: {report}")


def _paintings(views: list[str]) -> dict[str, Path]:
    paintings: dict[str, Path] = {}
    for text in views:
        name, equals, path = text.partition("=")
        if not (name and equals and path):
            raise SettingsError(f"--view {text}: must be NAME=FILE, such as --view front=front.png.")
        if name in paintings:
            raise SettingsError(f"--view {name} is given twice. Merge the two pictures into one.")
        paintings[name] = Path(path)
    return paintings
