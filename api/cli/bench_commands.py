"""Benchmarks that users run on their own scene and machine: `bench error-time` and `bench quality`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from api.cli.arguments import CamerasOption, SceneArgument, StyleOption, folder_to_write, source_of
from api.cli.console import error_console, out_console, print_field
from api.cli.options import with_arguments, with_options
from worker.options import StylizeOptions, ViewOptions

if TYPE_CHECKING:
    from api.cli.bench import VariantsRequest
    from sgsst_core.bench.variants import Curve

#: Options of a job that apply to all variants.
_OF_VARIANTS = ("coarsest_side", "background", "backbone", "memory_limit", "seed")
#: Width in characters of tables that a narrower terminal would truncate.
_TABLE_WIDTH = 180

bench_app = typer.Typer(help="Benchmarks for your own scene and machine.", no_args_is_help=True)


@dataclass(frozen=True)
class VariantsInputs:
    """Arguments of a command that compares variants; see `with_arguments`."""

    scene: SceneArgument
    style: StyleOption
    cameras: CamerasOption = None
    seconds: Annotated[float, typer.Option(min=1, max=1e6, help="Seconds of optimization per variant.")] = 300.0

    def request(self, options: ViewOptions, chosen: StylizeOptions, variants: str, out: Path) -> VariantsRequest:
        """Return the request for these variants, which are separated by commas."""
        from api.cli.bench import VariantsRequest

        source = source_of(self.scene, self.cameras, options)
        settings = {**chosen.given_settings(), "near": options.near}
        names = [name.strip() for name in variants.split(",") if name.strip()]
        return VariantsRequest(source, self.style, out, names, self.seconds, chosen.backbone, settings)


@bench_app.command("error-time")
@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=_OF_VARIANTS)
@with_arguments(VariantsInputs)
def error_time(
    inputs: VariantsInputs,
    out: Annotated[
        Path, typer.Option(help="Folder for table, plot, JSON and scenes.", callback=folder_to_write)
    ] = Path("error_time"),
    variants: Annotated[str, typer.Option(help="Names of variants, separated by commas. [default: all]")] = "",
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Run variants of a job for the same time each, and plot the remaining error against time."""
    from api.cli.bench import error_time_table, point_line, run_error_time

    request = inputs.request(options, chosen, variants, out)
    curves = run_error_time(request, lambda curve: error_console.print(point_line(curve)))
    Console(width=_TABLE_WIDTH).print(error_time_table(curves))
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
    from api.cli.bench import point_line, quality_table, run_quality

    request = inputs.request(options, chosen, variants, out)
    quality = run_quality(request, lambda curve: error_console.print(point_line(curve)))
    Console(width=_TABLE_WIDTH).print(quality_table(quality))
    _print_skipped_variants(quality.curves, out)


def _print_skipped_variants(curves: Sequence[Curve], out: Path) -> None:
    """Print which variants were skipped, and where the results are."""
    for curve in curves:
        if curve.left_out:
            out_console.print(f"{curve.variant.name} was skipped: {curve.left_out}")
    print_field("results", out)
