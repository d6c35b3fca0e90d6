"""Consoles of the command line, what is printed there by several commands, and exit codes."""

import errno
import os
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from sgsst_core.scales import ratio
from worker.processes import HANGUP

#: Exit codes: an unusable input or option, and any other failure.
BAD_INPUT, FAILURE = 2, 1
#: Exit codes of client commands: no such job or file, a job whose status does not allow the request, and a job that
#: did not succeed.
NOT_FOUND, CONFLICT, JOB_FAILED = 3, 4, 5
#: Reasons why a job stopped before its last step.
EARLY_ENDS = {
    "within": "its time budget was used up (submit it again with a larger `within` to make more steps)",
    "on-request": "it was asked to finish (submit it again to make all steps)",
    "target-loss": "the loss has reached --target-loss",
    "converged": "the loss no longer falls (use --no-early-stop to run all steps)",
}

#: Characters that are not printed: control characters, which terminals obey, and marks that reorder a line.
_CONTROLS = dict.fromkeys({*range(32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A)} - {9, 10})


@dataclass(frozen=True)
class Invocation:
    """Invocation of the program.

    Attributes:
        started: Start of the process, or of the call of `main` in another program, in seconds since the epoch.
    """

    arguments: list[str]
    started: float


class PlainConsole(Console):
    """Console that prints texts as they are, but without control characters: a service could send any.

    It discards what it cannot print because the terminal is closed. Whether the program stops is decided by the signal,
    which arrives later, or never if it is ignored.
    """

    def __init__(self, *, stderr: bool = False, soft_wrap: bool = False) -> None:
        super().__init__(stderr=stderr, soft_wrap=soft_wrap, highlight=False, markup=False, emoji=False)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
        """Yield the segments of a text, table or progress bar; those with control codes are the console's own."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=segment.text.translate(_CONTROLS))

    def __exit__(self, *exception: Any) -> None:
        """Print what was collected in the block: every text, table and progress bar is printed here."""
        try:
            super().__exit__(*exception)
        except OSError as error:
            if error.errno != errno.EIO or not stat.S_ISCHR(os.fstat(self.file.fileno()).st_mode):
                raise
            leave_terminal(HANGUP)


out_console = PlainConsole(soft_wrap=True)
error_console = PlainConsole(stderr=True, soft_wrap=True)


def loss_text(before: float, after: float) -> str:
    """Return the loss before and after a job, and their ratio; say so if the loss has risen."""
    relative = ratio(after, before)
    text = f"{before:.4g} before, {after:.4g} after" + ("" if relative is None else f" ({relative:.1%})")
    risen = "; it has risen: give more steps, unless the scene already matched the style"
    return text + (risen if after > before else "")


def print_field(name: str, value: object) -> None:
    """Print one line of a command's results; the values of all lines are aligned."""
    out_console.print(f"{name + ':':<22}{value}")


@contextmanager
def counting_bar(description: str, *, in_bytes: bool = True) -> Iterator[Callable[[int, int], None]]:
    """Show the progress of a transfer or of other work; yield a function that receives what is done, and the total."""
    from rich.progress import BarColumn, DownloadColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn

    from sgsst_core.progress import live_bar

    count = DownloadColumn() if in_bytes else MofNCompleteColumn()
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), count, TimeRemainingColumn())
    with live_bar(error_console, *columns) as bar:
        task = bar.add_task(description, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total or None)


def leave_terminal(number: int | None) -> None:
    """Discard what is written to a terminal from now on if it is closed, of which SIGHUP tells: writing would fail."""
    with Path(os.devnull).open("wb") as nowhere:
        for descriptor in (1, 2):
            if number == HANGUP and stat.S_ISCHR(os.fstat(descriptor).st_mode):
                os.dup2(nowhere.fileno(), descriptor)
