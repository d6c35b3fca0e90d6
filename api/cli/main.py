"""The `sgsst` command."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.console import Console
from rich.progress import BarColumn, DownloadColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.table import Column, Table

from api.cli import client_commands, operator_commands
from api.cli.interrupt import stop_on_signal
from api.cli.options import with_options
from api.cli.progress_bars import clock, job_bar, live_bar
from api.cli.region_options import RegionKeepOption, RegionOption, RegionStyleOption, RegionWeightOption
from sgsst_core.errors import InvalidInputError, SettingsError, SgsstError, WeightsError
from sgsst_core.files.formats import EXTRA_SUFFIXES, RESULT_SUFFIXES, SUFFIXES
from sgsst_core.options import renamed_hint
from sgsst_core.settings import make_settings
from worker.options import RunOptions, StylizeOptions, ViewOptions
from worker.region_requests import region_options, region_requests
from worker.styles import parse_styles

if TYPE_CHECKING:  # PyTorch and Numba take seconds to import, so each command imports what it needs
    from api.cli.bench import VariantsRequest
    from sgsst_core.bench.error_time import Curve
    from worker.description import Prepared
    from worker.execute import Result
    from worker.ranks.attempts import RanksResult, WorkerOptions
    from worker.request import Outputs, StylizeRequest

#: Exit codes for an unusable input or option, and for any other failure.
BAD_INPUT, FAILURE = 2, 1
#: Width in characters of tables that a narrower terminal would truncate.
TABLE_WIDTH = 180
#: Resolution and number of steps of the demo, and seconds after which it stops on a slow machine. The whole demo takes
#: less than five minutes.
DEMO_RESOLUTION, DEMO_STEPS, DEMO_SECONDS = 480, 100, 180

app = typer.Typer(
    help="Style transfer for 3D Gaussian Splatting scenes (SGSST).",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)
weights_app = typer.Typer(help="Weights of the feature network.", no_args_is_help=True)
app.add_typer(weights_app, name="weights")
bench_app = typer.Typer(help="Benchmarks for your own scene and machine.", no_args_is_help=True)
app.add_typer(bench_app, name="bench")
operator_commands.add_to(app)
client_commands.add_to(app)
out_console = Console(highlight=False, markup=False, soft_wrap=True)
error_console = Console(stderr=True, highlight=False, markup=False, soft_wrap=True)

SceneArgument = Annotated[
    Path,
    typer.Argument(metavar="SCENE", help=f"3DGS scene: {SUFFIXES}.", show_default=False),
]
CamerasOption = Annotated[
    Path | None,
    typer.Option(
        help="cameras.json (INRIA), folder of a COLMAP sparse model, or transforms.json (nerfstudio, Blender)."
    ),
]
ImagesOption = Annotated[
    Path | None, typer.Option(help="Folder of photos for the content term. [default: unstylized renders]")
]
StyleOption = Annotated[Path, typer.Option(help="Style image.", show_default=False)]
StylesOption = Annotated[
    list[str],
    typer.Option(
        metavar="FILE[:WEIGHT]",
        help="Style image; may be repeated. Several are mixed in proportion to their weights.",
        show_default=False,
    ),
]


@app.callback(invoke_without_command=True)
def program(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Style transfer for 3D Gaussian Splatting scenes (SGSST)."""
    if version:
        from sgsst_core.report.machine import program_version

        out_console.print(f"sgsst {program_version()}")
        raise typer.Exit()


@app.command()
@with_options(StylizeOptions)
@with_options(RunOptions, "run")
def stylize(
    context: typer.Context,
    scene: SceneArgument,
    style: StylesOption,
    out: Annotated[
        Path,
        typer.Option(
            help="Stylized PLY to write; report and images go beside it. "
            f"A {EXTRA_SUFFIXES} is written in addition to a PLY of the same name."
        ),
    ],
    cameras: CamerasOption = None,
    images: ImagesOption = None,
    region: RegionOption = None,
    region_style: RegionStyleOption = None,
    region_weight: RegionWeightOption = None,
    region_freeze: RegionKeepOption = None,
    *,
    options: StylizeOptions,
    run: RunOptions,
) -> None:
    """Stylize a scene with one or several style images."""
    settings = options.settings()
    from worker.ranks.attempts import WorkerOptions
    from worker.request import SceneRequest, StylizeRequest

    source = SceneRequest.of(scene, cameras, options)
    regions = region_requests(
        region_options(region or (), region_style or (), region_weight or (), region_freeze or ())
    )
    styles = parse_styles(style)
    request = StylizeRequest(
        source,
        styles,
        images,
        out,
        options.backbone,
        run.resume,
        settings,
        regions,
        style_background=options.style_background,
    )
    _stylize(request, context.obj, options.workers, WorkerOptions(run.rank_timeout, run.checkpoint_seconds))


def _stylize(
    request: StylizeRequest,
    arguments: Sequence[str],
    workers: int | None = None,
    options: WorkerOptions | None = None,
) -> None:
    """Stylize a scene and print the plan and the results.

    Args:
        arguments: Arguments of this command; the command to resume the job is built from them.
    """
    from worker.ranks.attempts import WorkerOptions
    from worker.request import check_request

    outputs = check_request(request)
    command = shlex.join(["sgsst", *arguments, *([] if "--resume" in arguments else ["--resume"])])
    options = options or WorkerOptions()
    if workers is None:
        _stylize_here(request, outputs, command, options.checkpoint_seconds)
    else:
        _stylize_on_ranks(request, outputs, command, workers, options)


def _stylize_here(request: StylizeRequest, outputs: Outputs, command: str, checkpoint_seconds: float) -> None:
    """Stylize on one rank in this process."""
    from worker.description import describe
    from worker.execute import execute
    from worker.prepare import prepare

    with job_bar(error_console) as bar:
        job = prepare(request, warn=error_console.print, show_planning=bar.show_planning)
    with stop_on_signal(_announce_stop) as stop:
        prepared = describe(job)
        _announce(prepared)
        with job_bar(error_console) as bar:
            bar.start(prepared)
            result = execute(
                job, progress=bar.show, stop=stop, warn=error_console.print, checkpoint_seconds=checkpoint_seconds
            )
    if result.stopped == "interrupted":
        _tell_interrupted(outputs, result.step, result.total, result.step, command)
        raise typer.Exit(stop.exit_code)
    _conclude(outputs, result, command)


def _stylize_on_ranks(
    request: StylizeRequest, outputs: Outputs, command: str, workers: int, options: WorkerOptions
) -> None:
    """Stylize on several ranks, each in a process of its own."""
    from worker.ranks.attempts import stylize_on_ranks
    from worker.ranks.listener import Listener

    with stop_on_signal(_announce_stop) as stop, job_bar(error_console) as bar:

        def prepared(found: Prepared) -> None:
            _announce(found)
            bar.start(found)

        tell = error_console.print
        listener = Listener(
            planning=bar.show_planning, prepared=prepared, progress=bar.show, happened=tell, warn=tell, stop=stop
        )
        ended = stylize_on_ranks(request, workers, listener, options=options)
    if ended.interrupted:
        _tell_interrupted(outputs, ended.step, ended.total, ended.saved, command)
        raise typer.Exit(stop.exit_code)
    assert ended.result is not None
    _tell_losses(ended)
    _conclude(outputs, ended.result, command)


def _announce_stop() -> None:
    error_console.print("Stopping after this step. Press Ctrl-C again to abort immediately.")


def _announce(prepared: Prepared) -> None:
    for heading, line in prepared.lines:
        out_console.print(f"{heading + ':':<22}{line}")


def _tell_interrupted(outputs: Outputs, step: int, total: int, saved: int | None, command: str) -> None:
    if saved is None:
        error_console.print(f"Stopped at step {step}. Nothing was saved.")
        return
    there = "saved" if saved == step else f"step {saved} is saved"
    error_console.print(
        f"Stopped at step {step} of {total}; {there} in {outputs.checkpoint}.\nTo continue, run:\n{command}"
    )


def _tell_losses(ended: RanksResult) -> None:
    for attempt in ended.attempts:
        out_console.print(
            f"{'restarted:':<22}{attempt.reason}, at step {attempt.last_step}; resumed from step {attempt.saved_step} "
            f"after {attempt.seconds_to_resume:.1f} s"
        )


def _conclude(outputs: Outputs, result: Result, command: str) -> None:
    before, after = result.losses
    out_console.print(f"{'loss:':<22}{before:.4g} before, {after:.4g} after ({after / before:.1%})")
    for line in _time_bought(result):
        out_console.print(f"{'loss over time:':<22}{line}")
    paths = [("stylized scene", outputs.ply)]
    if outputs.packed is not None and result.packed is not None:
        out_console.print(f"{'compressed:':<22}{result.packed.text('the PLY')}")
        paths.append(("compressed scene", outputs.packed))
    paths += [("views", outputs.views)] if outputs.views.exists() else []
    if result.report_error is None:
        paths += [("before and after", outputs.sheet), ("loss curves", outputs.curves), ("report", outputs.page)]
        paths += [("report as JSON", outputs.report)]
    for heading, path in paths:
        out_console.print(f"{heading + ':':<22}{path}")
    if result.stopped in _ENDED:
        out_console.print(f"Stopped at step {result.step} of {result.total}: {_ENDED[result.stopped]}.")
    if result.stopped == "max-seconds":
        out_console.print(
            f"Reached --max-seconds at step {result.step} of {result.total}. The checkpoint is kept. To continue, "
            f"raise --max-seconds, which counts from the first step:\n{command}"
        )
    if result.report_error is not None:
        error_console.print(
            f"The stylized scene is complete, but its report could not be written: {result.report_error}"
        )
        raise typer.Exit(FAILURE)


_ENDED = {
    "target-loss": "the loss has reached --target-loss",
    "converged": "the loss no longer falls (use --no-early-stop to run all steps)",
}


def _time_bought(result: Result) -> list[str]:
    found = result.bought
    if found is None:
        return []
    lines = [
        f"down to {entry['relative']:.0%} of the initial loss on all scales after {clock(entry['seconds'])}"
        for entry in found["reached"]
    ]
    last = found["last_tenth"]
    if last:
        lines.append(f"from {last['from']:.2%} to {last['to']:.2%} in the last tenth of the time")
    return lines


@app.command()
@with_options(StylizeOptions, without=("workers",))
def plan(
    scene: SceneArgument,
    style: StylesOption,
    out: Annotated[Path, typer.Option(help="JSON file to write the plan to.")] = Path("plan.json"),
    cameras: CamerasOption = None,
    images: ImagesOption = None,
    sheet: Annotated[Path | None, typer.Option(help="JPEG file to write with images of the views.")] = None,
    region: RegionOption = None,
    region_style: RegionStyleOption = None,
    region_weight: RegionWeightOption = None,
    region_freeze: RegionKeepOption = None,
    *,
    options: StylizeOptions,
) -> None:
    """Show what a stylization would skip and why, and what a step would cost."""
    from api.cli.scene_tools import make_plan
    from worker.request import SceneRequest, StylizeRequest

    settings = options.settings()
    source = SceneRequest.of(scene, cameras, options)
    regions = region_requests(
        region_options(region or (), region_style or (), region_weight or (), region_freeze or ())
    )
    request = StylizeRequest(
        source,
        parse_styles(style),
        images,
        out,
        options.backbone,
        False,
        settings,
        regions,
        style_background=options.style_background,
    )
    with job_bar(error_console) as bar:
        made = make_plan(request, bar.show_planning, sheet)
    table = Table(Column("item", no_wrap=True), "decision and reason", Column("saves", no_wrap=True), show_lines=True)
    for item in made.decisions:
        saved = [f"{item.seconds:.2g} s per step"] if item.seconds is not None else []
        saved += [f"{item.bytes / 1e6:.1f} MB"] if item.bytes is not None else []
        error = "" if item.error == "none" else f" Costs: {item.error}."
        table.add_row(item.item, f"{item.decision}: {item.reason}.{error}", "\n".join(saved))
    out_console.print(table)
    if made.prediction:
        seconds, peak = made.prediction.seconds, made.prediction.peak_bytes / 1e9
        coarse = f" ({made.prediction.seconds_coarse:.2g} s in phase 1)" if made.steps_coarse else ""
        on_device = made.prediction.device_bytes
        gpu = f" (GPU: {on_device / 1e9:.1f} GB)" if on_device is not None else ""
        expected = f"{seconds:.2g} s per step on all scales{coarse}, peak memory {peak:.1f} GB{gpu}"
        out_console.print(f"Predicted: {expected}")
    if sheet is not None:
        out_console.print(f"{'views:':<22}{sheet}")
    out_console.print(f"{'plan:':<22}{out}")


@app.command()
@with_options(ViewOptions, without=("drop_invalid",))
def check(
    scene: SceneArgument,
    cameras: CamerasOption = None,
    style: Annotated[Path | None, typer.Option(help="Style image.")] = None,
    *,
    options: ViewOptions,
) -> None:
    """Report extreme values in a scene, its views and its style, and their consequences."""
    from api.cli.scene_tools import look_for_extremes
    from worker.request import SceneRequest

    source = SceneRequest.of(scene, cameras, options)
    with _status("Checking the scene and every view"):
        found = look_for_extremes(source, style)
    if not found:
        out_console.print("No extreme values were found.")
        return
    table = Table("finding", Column("count", justify="right"), "worst", "consequence", show_lines=True)
    for item in found:
        table.add_row(f"{item.subject}: {item.what}", f"{item.count:,} of {item.total:,}", item.worst, item.done)
    out_console.print(table)


@app.command()
@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=("background",))
def render(
    scene: SceneArgument,
    out: Annotated[Path, typer.Option(help="Folder for the PNG images.", show_default=False)],
    cameras: CamerasOption = None,
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Render all views of a scene."""
    from api.cli.scene_tools import render_views
    from worker.request import SceneRequest

    source = SceneRequest.of(scene, cameras, options)
    background = chosen.settings().background
    columns = (TextColumn("rendering"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with live_bar(error_console, *columns) as bar:
        task = bar.add_task("", total=None)
        paths = render_views(source, background, out, lambda done, total: bar.update(task, completed=done, total=total))
    out_console.print(f"{len(paths)} view{'s' if len(paths) > 1 else ''} in {out}")


@app.command()
@with_options(ViewOptions, only=("near", "drop_invalid", "spz_axes"))
def convert(
    scene: SceneArgument,
    out: Annotated[Path, typer.Argument(metavar="OUT", help=f"Scene to write: {RESULT_SUFFIXES}.", show_default=False)],
    compare: Annotated[
        bool, typer.Option("--compare", help="Report the PSNR of small renders against those of the scene.")
    ] = False,
    cameras: Annotated[
        Path | None,
        typer.Option(help="Cameras that --compare renders, and that decide the axes of an SPZ. [default: an orbit]"),
    ] = None,
    *,
    options: ViewOptions,
) -> None:
    """Convert a scene to another format, which the name of OUT determines."""
    from api.cli.scene_tools import convert_scene
    from worker.request import SceneRequest

    converted = convert_scene(SceneRequest.of(scene, cameras, options), out, compare)
    for line in converted.decisions:
        out_console.print(f"{line.item + ':':<22}{line.decision}: {line.reason}")
    if converted.loss is not None:
        out_console.print(f"{'compared:':<22}{converted.loss.text(scene.name)}")
    out_console.print(f"{'scene:':<22}{out}, {converted.count:,} Gaussians")


@app.command()
def demo(
    out: Annotated[Path, typer.Option(help="Folder for the scene and the results.")] = Path("demo"),
) -> None:
    """Stylize a built-in scene, lifted from a stereo photograph, in a few minutes."""
    from api.cli.demo_scene import build_demo
    from sgsst_core.features.network_weights import load_network_weights
    from worker.request import SceneRequest, StylizeRequest, check_folder
    from worker.styles import StyleFile

    check_folder(out)
    try:
        load_network_weights("auto")
    except WeightsError:
        fetch("vgg16")
    with _status("Building the scene"):
        files = build_demo(out)
    source = SceneRequest(scene=files.ply, cameras=files.cameras, resolution=DEMO_RESOLUTION)
    settings = make_settings("preview", max_resolution=DEMO_RESOLUTION, steps_sos=DEMO_STEPS, max_seconds=DEMO_SECONDS)
    request = StylizeRequest(source, (StyleFile(files.style),), None, out / "stylized.ply", "auto", False, settings)
    options: dict[str, object] = {"--style": files.style, "--cameras": files.cameras, "--out": request.out}
    options |= {"--preset": "preview", "--resolution": DEMO_RESOLUTION}
    options |= {"--steps-sos": DEMO_STEPS, "--max-seconds": DEMO_SECONDS}
    arguments = ["stylize", str(files.ply), *(str(part) for option in options.items() for part in option)]
    out_console.print(f"{'command:':<22}{shlex.join(['sgsst', *arguments])}")
    _stylize(request, arguments)


#: Options of a job that `sgsst bench` accepts and applies to all variants.
_OF_VARIANTS = ("coarsest_side", "background", "backbone", "memory_limit", "seed")
BenchSeconds = Annotated[float, typer.Option(min=1, help="Seconds of optimization per variant.")]


@bench_app.command("error-time")
@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=_OF_VARIANTS)
def bench_error_time(
    scene: SceneArgument,
    style: StyleOption,
    out: Annotated[Path, typer.Option(help="Folder for table, plot, JSON and scenes.")] = Path("error_time"),
    cameras: CamerasOption = None,
    variants: Annotated[str, typer.Option(help="Names of variants, separated by commas. [default: all]")] = "",
    seconds: BenchSeconds = 300.0,
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Run variants of a job for the same time each, and plot the remaining error against time."""
    from api.cli.bench import error_time_table, point_line, run_error_time

    request = _variants_request(scene, style, out, cameras, variants, seconds, options, chosen)
    curves = run_error_time(request, lambda variant, point: error_console.print(point_line(variant, point)))
    Console(width=TABLE_WIDTH).print(error_time_table(curves))
    _tell_what_was_left_out(curves, out)


@bench_app.command("quality")
@with_options(ViewOptions)
@with_options(StylizeOptions, "chosen", only=_OF_VARIANTS)
def bench_quality(
    scene: SceneArgument,
    style: StyleOption,
    out: Annotated[Path, typer.Option(help="Folder for JSON, plots, images and scenes.")] = Path("quality"),
    cameras: CamerasOption = None,
    variants: Annotated[
        str, typer.Option(help="Names of variants, separated by commas.")
    ] = "standard,one-scale,cold-start",
    seconds: BenchSeconds = 300.0,
    *,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> None:
    """Run variants of a job for the same time each, and judge results with a network that none of them optimizes."""
    from api.cli.bench import point_line, quality_table, run_quality

    request = _variants_request(scene, style, out, cameras, variants, seconds, options, chosen)
    quality = run_quality(request, lambda variant, point: error_console.print(point_line(variant, point)))
    Console(width=TABLE_WIDTH).print(quality_table(quality))
    _tell_what_was_left_out(quality.curves, out)


def _tell_what_was_left_out(curves: Sequence[Curve], out: Path) -> None:
    """Print which variants were left out, and where the results are."""
    for curve in curves:
        if curve.left_out:
            out_console.print(f"{curve.variant.name} was skipped: {curve.left_out}")
    out_console.print(f"{'results:':<22}{out}")


def _variants_request(
    scene: Path,
    style: Path,
    out: Path,
    cameras: Path | None,
    variants: str,
    seconds: float,
    options: ViewOptions,
    chosen: StylizeOptions,
) -> VariantsRequest:
    """Return the request of a command that runs variants."""
    from api.cli.bench import VariantsRequest
    from worker.request import SceneRequest

    source = SceneRequest.of(scene, cameras, options)
    settings = {**chosen.given_settings(), "near": options.near}
    names = [name.strip() for name in variants.split(",") if name.strip()]
    return VariantsRequest(source, style, out, names, seconds, chosen.backbone, settings)


@bench_app.command("stability")
def bench_stability(
    only: Annotated[
        str, typer.Option(metavar="TEXT", help="Run only cases whose name contains TEXT, or the group TEXT.")
    ] = "",
    quick: Annotated[bool, typer.Option("--quick", help="Use smaller sizes; minutes faster.")] = False,
    out: Annotated[Path | None, typer.Option(help="JSON file to write.")] = None,
) -> None:
    """Compare hard cases with float64 references; exit with 1 if one exceeds its bound."""
    from api.cli.bench import run_stability, stability_table

    found = run_stability(only, quick, out, lambda case: error_console.print(f"{case.group}: {case.name}"))
    Console(width=TABLE_WIDTH).print(stability_table(found))
    if not all(measured.result.passed for _, measured in found):
        raise typer.Exit(FAILURE)


@weights_app.command("list")
def list_() -> None:
    """Show installed weights, and the source of the others; exit with 1 if some are damaged."""
    from sgsst_core.features.network_weights import list_network_weights
    from sgsst_core.features.weight_files import damage_of

    damaged = []
    for entry in list_network_weights():
        if entry.path is not None and (damage := damage_of(entry.path, entry.name)):
            damaged.append(damage)
            state = f"DAMAGED     {entry.path}"
        else:
            state = f"installed   {entry.path}" if entry.path else f"to download from {entry.source}"
        out_console.print(f"{entry.name:<12}{entry.size / 1e6:>6.0f} MB  {state}")
    for damage in damaged:
        error_console.print(f"error: {damage}")
    if damaged:
        raise typer.Exit(FAILURE)


@weights_app.command()
def fetch(
    name: Annotated[Literal["vgg19", "vgg16"], typer.Argument(help="Network to install.")],
    from_: Annotated[
        Path | None,
        typer.Option("--from", help="Convert this file (.pth of torchvision or Gatys et al.) instead of downloading."),
    ] = None,
) -> None:
    """Download and convert weights into the cache folder; do nothing if they are installed."""
    from sgsst_core.features.network_weights import fetch_network_weights

    columns = (TextColumn("{task.description}"), BarColumn(), DownloadColumn(), TimeRemainingColumn())
    with live_bar(error_console, *columns) as bar:
        task = bar.add_task(name, total=None)
        path = fetch_network_weights(
            name, source=from_, progress=lambda done, total: bar.update(task, completed=done, total=total or None)
        )
    out_console.print(f"{name}: {path}")


@weights_app.command()
def path() -> None:
    """Print the cache folder for weights; set SGSST_CACHE to change it."""
    from sgsst_core.features.network_weights import cache_folder

    out_console.print(str(cache_folder()))


@contextmanager
def _status(text: str) -> Iterator[None]:
    """Show a spinner on a terminal, and nothing elsewhere."""
    with error_console.status(text) if error_console.is_terminal else _nothing():
        yield


@contextmanager
def _nothing() -> Iterator[None]:
    yield


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line. Expected errors become one message on stderr and an exit code, without a traceback."""
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    try:
        _check_names(arguments)
        app(args=arguments, prog_name="sgsst", obj=arguments)
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except SgsstError as error:
        error_console.print(f"error: {error}")
        return BAD_INPUT if isinstance(error, InvalidInputError) else FAILURE
    except KeyboardInterrupt:
        error_console.print("Aborted.")
        return 130
    except BrokenPipeError:  # for example `sgsst weights list | head`
        return FAILURE
    except (MemoryError, RuntimeError) as error:
        if not _out_of_memory(error):
            raise
        error_console.print("error: out of memory. Use a smaller --resolution, fewer --views or a --memory-limit.")
        return FAILURE
    return 0


def _check_names(arguments: Sequence[str]) -> None:
    """Raise a SettingsError if an option is given by a former name."""
    for argument in arguments:
        flag = argument.partition("=")[0]
        if flag.startswith("--") and (hint := renamed_hint(flag)):
            raise SettingsError(f"{flag}: {hint}.")


def _out_of_memory(error: Exception) -> bool:
    """Return whether an error reports a lack of memory.

    PyTorch raises a plain RuntimeError on the CPU, and a subclass of it on GPUs.
    """
    text = str(error)
    return isinstance(error, MemoryError) or "can't allocate memory" in text or "out of memory" in text


if __name__ == "__main__":
    sys.exit(main())
