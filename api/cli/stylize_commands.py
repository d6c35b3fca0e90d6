"""Commands that stylize scenes: `stylize` and `demo` in this process or on several ranks, `batch` several scenes in
several styles, on this machine or by a service, with a contact sheet.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import shlex
import signal
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated, Any

import typer

from api.cli import console
from api.cli.machine_commands import fetch
from api.cli.options import (
    JobArguments,
    KeyOption,
    file_to_write,
    folder_to_write,
    local_path,
    path_to_read,
    with_arguments,
    with_options,
)
from sgsst_core.errors import InvalidInputError, SettingsError, SgsstError, WeightsError, is_out_of_memory
from sgsst_core.files.atomic import file_digest, write_json
from sgsst_core.files.formats import EXTRA_SUFFIXES, SUFFIXES, scene_path
from sgsst_core.progress import job_bar
from worker.job import JobSpec, Outputs, Result, check_is_not_input, check_request
from worker.options import ESSENTIALS, RunOptions, StylizeOptions
from worker.processes import HANGUP, STOP_SIGNALS
from worker.run import WorkerOptions

if TYPE_CHECKING:  # PyTorch and Numba take seconds to import, so each command imports what it needs
    from torch import Tensor

    from api.client import Client
    from sgsst_core.scene.gaussians import Scene
    from worker.execute import Prepared
    from worker.run import Ended

#: Resolution and number of steps of the demo, and its time budget, which ends the steps on a slow machine. The whole
#: demo takes less than five minutes.
DEMO_RESOLUTION, DEMO_STEPS, DEMO_SECONDS = 480, 100, 240


@with_options(StylizeOptions)
@with_options(RunOptions, "run")
@with_arguments(JobArguments)
def stylize(
    context: typer.Context,
    inputs: JobArguments,
    out: Annotated[
        Path,
        typer.Option(
            help="Stylized PLY to write; report and images go beside it. "
            f"A {EXTRA_SUFFIXES} is written in addition to a PLY of the same name.",
            callback=file_to_write,
            rich_help_panel=ESSENTIALS,
        ),
    ],
    *,
    options: StylizeOptions,
    run: RunOptions,
) -> None:
    """Stylize a scene with one or several style images."""
    request = inputs.request(options, out, resume=run.resume)
    invocation: console.Invocation = context.obj
    run_options = WorkerOptions(run.rank_timeout, run.checkpoint_seconds, started=invocation.started)
    run_job(request, _resuming(invocation.arguments), options.workers, run_options)


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the scene and the results.", callback=folder_to_write)] = Path(
        "demo"
    ),
) -> None:
    """Stylize a built-in scene, lifted from a stereo photograph, in a few minutes."""
    from api.cli.scene_tools import build_demo
    from sgsst_core.features.network_weights import load_network_weights

    try:
        load_network_weights("auto")
    except WeightsError:
        fetch("vgg16")
    with console.error_console.status("Building the scene"):
        ply, cameras, style = build_demo(out)
    chosen = {"preset": "preview", "resolution": DEMO_RESOLUTION, "steps_sos": DEMO_STEPS, "within": DEMO_SECONDS}
    inputs = JobArguments(str(ply), [str(style)], str(cameras))
    request = inputs.request(StylizeOptions.model_validate(chosen), out / "stylized.ply")
    given = {"style": style, "cameras": cameras, "out": request.out, **chosen}
    options = [(f"--{name.replace('_', '-')}", str(value)) for name, value in given.items()]
    arguments = ["stylize", str(ply), *itertools.chain(*options)]
    console.print_field("command", shlex.join(["sgsst", *arguments]))
    run_job(request, _resuming(arguments))


def _resuming(arguments: Sequence[str]) -> str:
    """Return the command that resumes the job of some arguments."""
    return shlex.join(["sgsst", *arguments, *([] if "--resume" in arguments else ["--resume"])])


def run_job(
    request: JobSpec,
    command: str,
    workers: int | None = None,
    options: WorkerOptions | None = None,
) -> None:
    """Stylize a scene and print the plan and the results.

    Args:
        command: Command that resumes the job, for messages.
    """
    from worker.run import Listener, stylize

    outputs, stop, notify = check_request(request), StopFlag(), console.error_console.print
    with ExitStack() as stack:
        if workers is not None:  # the processes of ranks are ended in order even before the first step
            stack.enter_context(stop.on_signal())
        bar = stack.enter_context(job_bar(console.error_console))
        from sgsst_core.compiled import compilations_reported  # takes seconds to import

        stack.enter_context(compilations_reported(bar.show_compiling))

        def prepared(summary: Prepared) -> None:
            if workers is None:
                stack.enter_context(stop.on_signal())
            for heading, line in summary.lines:
                console.print_field(heading, line)

        listener = Listener(prepared, bar.show, warn=notify, stop=stop, happened=notify)
        ended = stylize(request, workers, listener, options or WorkerOptions())
    if ended.interrupted:
        _print_interruption(outputs, ended, command)
        raise typer.Exit(stop.exit_code)
    for attempt in ended.attempts:
        console.print_field(
            "restarted",
            f"{attempt.reason}, at step {attempt.last_step}; resumed from step {attempt.saved_step} "
            f"after {attempt.seconds_to_resume:.1f} s",
        )
    assert ended.result is not None
    _print_result(outputs, ended.result, command)


def _print_interruption(outputs: Outputs, ended: Ended, command: str) -> None:
    if ended.saved is None:
        console.error_console.print(f"Stopped at step {ended.step}. Nothing was saved.")
        return
    state = "saved" if ended.saved == ended.step else f"step {ended.saved} is saved"
    console.error_console.print(
        f"Stopped at step {ended.step} of {ended.total}; {state} in {outputs.checkpoint}.\nTo continue, run:\n{command}"
    )


def _print_result(outputs: Outputs, result: Result, command: str) -> None:
    assert result.loss_before is not None
    assert result.loss_after is not None
    console.print_field("loss", console.loss_text(result.loss_before, result.loss_after))
    console.print_field(
        "loss measured", f"before on {result.loss_views} views, after in the steps of the last round of views"
    )
    if result.loss_over_time and (more := result.loss_over_time["more_time"]):
        console.print_field("more time", more["text"])
    paths = [("stylized scene", outputs.ply)]
    if outputs.compressed is not None and result.compressed is not None:
        console.print_field("compressed", result.compressed)
        paths.append(("compressed scene", outputs.compressed))
    paths += [("views", outputs.views)] if outputs.views.exists() else []
    if result.report_error is None:
        paths += [("before and after", outputs.sheet), ("loss curves", outputs.curves), ("report", outputs.page)]
        paths += [("report as JSON", outputs.report)]
    for heading, path in paths:
        console.print_field(heading, path)
    if result.stopped == "within":
        console.out_console.print(
            f"The time of --within was used up at step {result.steps} of {result.total}. The checkpoint is kept. To "
            f"continue, with as much time again, run:\n{command}"
        )
    elif result.stopped in console.EARLY_ENDS:
        console.out_console.print(
            f"Stopped at step {result.steps} of {result.total}: {console.EARLY_ENDS[result.stopped]}."
        )
    if result.report_error is not None:
        console.error_console.print(
            f"The stylized scene is complete, but its report could not be written: {result.report_error}"
        )
        raise typer.Exit(console.FAILURE)


class StopFlag:
    """Flag that records whether a signal has asked the program to stop after its step, and which."""

    def __init__(self) -> None:
        self._signal: int | None = None

    def __call__(self) -> bool:
        """Return whether a signal has arrived."""
        return self._signal is not None

    @property
    def exit_code(self) -> int:
        """Exit code of a program that was ended by the signal: 130 for Ctrl-C."""
        return 128 + (self._signal or signal.SIGINT)

    @contextmanager
    def on_signal(self) -> Iterator[None]:
        """Set this flag at the first Ctrl-C, SIGTERM or SIGHUP, and announce that the program stops after its step.

        A second Ctrl-C or SIGTERM has its usual effect. SIGHUP, which arrives when the terminal is closed, never has:
        both the shell and the system send it. Like others, it stays ignored if it is, as by `nohup`. Outside the main
        thread, Python allows no signal handlers, so the flag stays unset. After a SIGHUP, this handler of it stays.
        """
        numbers = STOP_SIGNALS if threading.current_thread() is threading.main_thread() else []
        before = {number: handler for number in numbers if (handler := signal.getsignal(number)) != signal.SIG_IGN}

        def handle(number: int, _frame: FrameType | None) -> None:
            self._signal = number
            for other, handler in before.items():
                signal.signal(other, handle if other == HANGUP else handler)
            console.leave_terminal(number)
            console.error_console.print("Stopping after this step. Press Ctrl-C again to abort immediately.")

        try:
            for number in before:
                signal.signal(number, handle)
            yield
        finally:
            for number, handler in before.items():
                if number != self._signal:  # else a second SIGHUP would still end the program
                    signal.signal(number, handler)


# --- batch ---------------------------------------------------------------------------------------------------------

#: Names of the record of a batch, and of its contact sheet, in the folder of the results.
_RECORD, _SHEET = "batch.json", "batch.jpg"
#: Longer side of the renders in the contact sheet, in pixels.
_SIDE = 480


@dataclass(frozen=True)
class _Entry:
    """Record of a result.

    Attributes:
        inputs: Digest of the files and options that it is made from.
        complete: Whether it has been made.
        job: Job of the service that makes it; empty on this machine.
    """

    inputs: str = ""
    complete: bool = False
    job: str = ""


class _Batch:
    """Results of a batch in a folder, and their record, which is written after each change.

    Attributes:
        failed: Names of results that could not be made.
    """

    def __init__(self, folder: Path) -> None:
        self._folder, self.failed = folder, list[str]()
        try:
            entries = json.loads((folder / _RECORD).read_text(encoding="utf-8"))
            self._entries = {name: _Entry(**entry) for name, entry in entries.items()}
        except FileNotFoundError:
            self._entries = {}
        except (OSError, ValueError, TypeError, AttributeError) as error:
            raise InvalidInputError(f"{folder / _RECORD}: is no record of a batch. Choose another --out.") from error

    def result(self, name: str) -> Path:
        """Return the path of a result."""
        return self._folder / f"{name}.ply"

    def entry(self, name: str, inputs: str) -> _Entry:
        """Return the record of a result, which is empty if it was made from other inputs or is gone."""
        entry = self._entries.get(name, _Entry())
        if entry.inputs != inputs or (entry.complete and not self.result(name).is_file()):
            return _Entry(inputs)
        return entry

    def record(self, name: str, entry: _Entry) -> None:
        """Record a result."""
        self._folder.mkdir(parents=True, exist_ok=True)
        self._entries[name] = entry
        write_json(self._folder / _RECORD, {name: asdict(each) for name, each in self._entries.items()})

    @contextmanager
    def attempt(self, name: str) -> Iterator[None]:
        """Report an error of a result in the block, so that the others go on."""
        try:
            yield
            return
        except typer.Exit as end:
            if end.exit_code not in (console.FAILURE, console.JOB_FAILED):  # interrupted
                raise
        except (SgsstError, OSError, MemoryError, RuntimeError) as error:
            if isinstance(error, RuntimeError) and not is_out_of_memory(error):
                raise
            text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else error
            console.error_console.print(f"error: {name}: {text}")
        self.failed.append(name)


@with_options(StylizeOptions)
@with_options(RunOptions, "run", without=("resume",))
def batch(
    context: typer.Context,
    scenes: Annotated[
        list[Path],
        typer.Argument(parser=local_path, metavar="SCENE...", help=f"3DGS scenes: {SUFFIXES}.", show_default=False),
    ],
    style: Annotated[
        list[Path],
        typer.Option(
            parser=local_path,
            metavar="FILE",
            help="Style image; may be repeated. Each one makes results of its own.",
            show_default=False,
            rich_help_panel=ESSENTIALS,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            help="Folder for the results, which are named after scene and style.",
            callback=folder_to_write,
            rich_help_panel=ESSENTIALS,
        ),
    ],
    cameras: Annotated[
        Path | None,
        path_to_read("Cameras of all scenes. [default: those beside each scene]", rich_help_panel=ESSENTIALS),
    ] = None,
    url: Annotated[
        str | None, typer.Option("--url", help="URL of a service that makes the results. [default: this machine]")
    ] = None,
    key: KeyOption = None,
    *,
    options: StylizeOptions,
    run: RunOptions,
) -> None:
    """Stylize several scenes in each of several styles; what is done already is not repeated.

    With --url, a service makes the results, with a --rank-timeout and --checkpoint-seconds of its own. Exit with 1 if
    any could not be made.
    """
    from api.client.client import different_names

    if url is None and key is not None:
        raise SettingsError("--key requires --url. Add it, or omit --key.")
    results = _Batch(out)
    jobs = {}
    named = (zip(different_names([*map(_namesake, paths)]), paths, strict=True) for paths in (scenes, style))
    pairs = list(itertools.product(*named))
    names = different_names([Path(f"{scene_name}_{style_name}") for (scene_name, _), (style_name, _) in pairs])
    for name, ((_, scene), (_, image)) in zip(names, pairs, strict=True):
        inputs = JobArguments(str(scene), [str(image)], str(cameras) if cameras else None)
        jobs[name] = inputs.request(options, results.result(name))
        for each in scenes:
            check_is_not_input(results.result(name), scene_path(each), "scene of another result")
    if url is not None:
        _make_by_service(results, jobs, options, url, key)
    else:
        for name, request in jobs.items():
            with results.attempt(name):
                _make(results, name, request, options, run, context.obj)
    if any(request.out.is_file() for request in jobs.values()):
        _write_sheet(out / _SHEET, jobs, len(style))
        console.print_field("contact sheet", out / _SHEET)
    if results.failed:
        console.error_console.print(
            f"{len(results.failed)} of {len(jobs)} results could not be made: {', '.join(results.failed)}"
        )
        raise typer.Exit(console.FAILURE)


def _namesake(path: Path) -> Path:
    """Return the path whose name the results of a file have: the folder of an unpacked scene, else without suffix."""
    return scene_path(path).parent if scene_path(path) != path else path.with_suffix("")


def _make(
    results: _Batch,
    name: str,
    request: JobSpec,
    options: StylizeOptions,
    run: RunOptions,
    invocation: console.Invocation,
) -> None:
    """Make a result on this machine, from its checkpoint if there is one."""
    entry = results.entry(name, _inputs(request))
    console.print_field("complete" if entry.complete else "result", request.out)
    if entry.complete:
        return
    resume = Outputs.of(request.out).checkpoint.exists()
    worker_options = WorkerOptions(run.rank_timeout, run.checkpoint_seconds, resume_required=False)
    command = shlex.join(["sgsst", *invocation.arguments])
    run_job(request.model_copy(update={"resume": resume}), command, options.workers, worker_options)
    results.record(name, replace(entry, complete=True))


def _make_by_service(
    results: _Batch, jobs: dict[str, JobSpec], options: StylizeOptions, url: str, key: str | None
) -> None:
    """Submit all results that are not complete, then wait for each and download it."""
    from api.cli.client_commands import conclude, follow, open_client

    waiting: dict[str, _Entry] = {}
    with open_client(url, key) as client:
        for name, request in jobs.items():
            with results.attempt(name):
                entry = results.entry(name, _inputs(request))
                if not entry.complete:
                    waiting[name] = entry = replace(entry, job=_submitted(client, entry.job, name, request, options))
                    results.record(name, entry)
                console.print_field("complete" if entry.complete else "job", entry.job or request.out)
        for name, entry in waiting.items():
            with results.attempt(name):
                conclude(client, follow(client, entry.job, False), results.result(name), False)
                results.record(name, replace(entry, complete=True))


def _submitted(client: Client, job_id: str, name: str, request: JobSpec, options: StylizeOptions) -> str:
    """Return the id of the job that makes a result: that of an earlier run if it can still succeed, or a new one."""
    try:
        if job_id and client.job(job_id).status not in ("failed", "canceled", "expired"):
            return job_id
    except SgsstError as error:  # deleted
        if getattr(error, "status", 0) != 404:
            raise
    source, images = request.source, [image.path for image in request.styles]
    parameters = options.model_dump(mode="json", exclude_unset=True)
    with console.counting_bar(name) as progress:
        return client.submit(source.scene, images, cameras=source.cameras, progress=progress, **parameters).id


def _inputs(request: JobSpec) -> str:
    """Return the digest of everything that a result is made from: the contents of its files, and its options."""
    from api.client.client import camera_files

    source, scene = request.source, scene_path(request.source.scene)
    digests = [file_digest(path) for path in (scene, *(image.path for image in request.styles))]
    names = ("*.webp", "meta.json") if scene.suffix == ".json" else ()  # of an unpacked scene
    files = [path for name in names for path in sorted(scene.parent.rglob(name))]
    files += camera_files(source.cameras) if source.cameras else []
    paths: Any = {"source": {"scene", "cameras"}, "styles": True, "out": True, "resume": True}
    values = [request.model_dump(mode="json", exclude=paths), digests, [file_digest(path) for path in files]]
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _write_sheet(path: Path, jobs: dict[str, JobSpec], styles: int) -> None:
    """Write the contact sheet: a row for each scene with a result, a column for scenes and one for each style."""
    from sgsst_core.report.images import write_grid

    requests = list(jobs.items())
    header = [None, *(_style(request) for _, request in requests[:styles])]
    rows = [requests[start : start + styles] for start in range(0, len(requests), styles)]
    write_grid(path, [header, *(_renders(row) for row in rows if any(each.out.is_file() for _, each in row))])


def _style(request: JobSpec) -> tuple[str, Tensor] | None:
    """Return the style image of a result with its name; None if it cannot be read."""
    from sgsst_core.files.images import load_image

    try:
        return request.styles[0].path.stem, load_image(request.styles[0].path)
    except InvalidInputError:
        return None


def _renders(requests: Sequence[tuple[str, JobSpec]]) -> list[tuple[str, Tensor] | None]:
    """Return a render of a scene and of each of its results, with their names; None for those that are missing."""
    from sgsst_core.files.scene_file import read_scene
    from sgsst_core.report.images import small_renders
    from worker.inputs import read_capture

    source = requests[0][1].source.model_copy(update={"resolution": None})
    scene = read_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=source.spz_axes).scene
    cameras = read_capture(source, scene).cameras[:1]

    def render(name: str, shown: Scene) -> tuple[str, Tensor]:
        return name, next(small_renders(shown, cameras, _SIDE))

    files = [(name, request.out) for name, request in requests]
    return [
        render(source.scene.stem, scene),
        *(render(name, read_scene(out).scene) if out.is_file() else None for name, out in files),
    ]
