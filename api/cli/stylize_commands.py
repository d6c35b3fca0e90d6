"""Commands that stylize a scene in this process or on several ranks: `stylize` and `demo`."""

from __future__ import annotations

import itertools
import shlex
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Annotated

import typer

from api.cli.console import (
    EARLY_ENDS,
    FAILURE,
    Invocation,
    error_console,
    leave_terminal,
    loss_text,
    out_console,
    print_field,
    spinner,
)
from api.cli.machine_commands import fetch
from api.cli.options import JobArguments, file_to_write, folder_to_write, with_arguments, with_options
from sgsst_core.errors import WeightsError
from sgsst_core.files.formats import EXTRA_SUFFIXES
from sgsst_core.progress import clock, job_bar
from worker.job import JobSpec, Outputs, Result, check_request
from worker.options import ESSENTIALS, RunOptions, StylizeOptions
from worker.processes import STOP_SIGNALS
from worker.run import WorkerOptions

if TYPE_CHECKING:  # PyTorch and Numba take seconds to import, so each command imports what it needs
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
    invocation: Invocation = context.obj
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
    with spinner("Building the scene"):
        files = build_demo(out)
    chosen = {"preset": "preview", "resolution": DEMO_RESOLUTION, "steps_sos": DEMO_STEPS, "within": DEMO_SECONDS}
    inputs = JobArguments(str(files.ply), [str(files.style)], str(files.cameras))
    request = inputs.request(StylizeOptions.model_validate(chosen), out / "stylized.ply")
    given = {"style": files.style, "cameras": files.cameras, "out": request.out, **chosen}
    options = [(f"--{name.replace('_', '-')}", str(value)) for name, value in given.items()]
    arguments = ["stylize", str(files.ply), *itertools.chain(*options)]
    print_field("command", shlex.join(["sgsst", *arguments]))
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

    outputs, stop, notify = check_request(request), StopFlag(), error_console.print
    with ExitStack() as stack:
        if workers is not None:  # the processes of ranks are ended in order even before the first step
            stack.enter_context(stop.on_signal(_announce_stop))
        bar = stack.enter_context(job_bar(error_console))
        from sgsst_core.compiled import compilations_reported  # takes seconds to import

        stack.enter_context(compilations_reported(bar.show_compiling))

        def prepared(summary: Prepared) -> None:
            if workers is None:
                stack.enter_context(stop.on_signal(_announce_stop))
            for heading, line in summary.lines:
                print_field(heading, line)

        listener = Listener(prepared, bar.show, warn=notify, stop=stop, happened=notify)
        ended = stylize(request, workers, listener, options or WorkerOptions())
    if ended.interrupted:
        _print_interruption(outputs, ended, command)
        raise typer.Exit(stop.exit_code)
    for attempt in ended.attempts:
        print_field(
            "restarted",
            f"{attempt.reason}, at step {attempt.last_step}; resumed from step {attempt.saved_step} "
            f"after {attempt.seconds_to_resume:.1f} s",
        )
    assert ended.result is not None
    _print_result(outputs, ended.result, command)


def _announce_stop() -> None:
    error_console.print("Stopping after this step. Press Ctrl-C again to abort immediately.")


def _print_interruption(outputs: Outputs, ended: Ended, command: str) -> None:
    if ended.saved is None:
        error_console.print(f"Stopped at step {ended.step}. Nothing was saved.")
        return
    state = "saved" if ended.saved == ended.step else f"step {ended.saved} is saved"
    error_console.print(
        f"Stopped at step {ended.step} of {ended.total}; {state} in {outputs.checkpoint}.\nTo continue, run:\n{command}"
    )


def _print_result(outputs: Outputs, result: Result, command: str) -> None:
    assert result.loss_before is not None
    assert result.loss_after is not None
    print_field("loss", loss_text(result.loss_before, result.loss_after))
    print_field("loss measured", f"before on {result.loss_views} views, after in the steps of the last round of views")
    for line in _loss_over_time(result):
        print_field("loss over time", line)
    if result.loss_over_time and (more := result.loss_over_time["more_time"]):
        print_field("more time", more["text"])
    paths = [("stylized scene", outputs.ply)]
    if outputs.compressed is not None and result.compressed is not None:
        print_field("compressed", result.compressed)
        paths.append(("compressed scene", outputs.compressed))
    paths += [("views", outputs.views)] if outputs.views.exists() else []
    if result.report_error is None:
        paths += [("before and after", outputs.sheet), ("loss curves", outputs.curves), ("report", outputs.page)]
        paths += [("report as JSON", outputs.report)]
    for heading, path in paths:
        print_field(heading, path)
    if result.stopped == "within":
        out_console.print(
            f"The time of --within was used up at step {result.steps} of {result.total}. The checkpoint is kept. To "
            f"continue, with as much time again, run:\n{command}"
        )
    elif result.stopped in EARLY_ENDS:
        out_console.print(f"Stopped at step {result.steps} of {result.total}: {EARLY_ENDS[result.stopped]}.")
    if result.report_error is not None:
        error_console.print(
            f"The stylized scene is complete, but its report could not be written: {result.report_error}"
        )
        raise typer.Exit(FAILURE)


def _loss_over_time(result: Result) -> list[str]:
    """Return when the loss fell to certain fractions of its initial value, and its decrease at the end."""
    loss_over_time = result.loss_over_time
    if loss_over_time is None:
        return []
    lines = [
        f"down to {entry['relative']:.0%} of the initial loss on all scales after {clock(entry['seconds'])}"
        for entry in loss_over_time["reached"]
    ]
    last = loss_over_time["last_tenth"]
    if last:
        lines.append(f"from {last['from']:.2%} to {last['to']:.2%} in the last tenth of the time")
    return lines


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
    def on_signal(self, announce: Callable[[], None]) -> Iterator[None]:
        """Set this flag at the first Ctrl-C, SIGTERM or SIGHUP, and call `announce`. The second has its usual effect.

        SIGHUP arrives when the terminal is closed; like others, it stays ignored if it is, as by `nohup`. Outside the
        main thread, Python allows no signal handlers, so the flag stays unset.
        """
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.getsignal(number) for number in STOP_SIGNALS}
        before = {number: handler for number, handler in before.items() if handler != signal.SIG_IGN}

        def handle(number: int, _frame: FrameType | None) -> None:
            self._signal = number
            for other, handler in before.items():
                signal.signal(other, handler)
            leave_terminal(number)
            announce()

        try:
            for number in before:
                signal.signal(number, handle)
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
