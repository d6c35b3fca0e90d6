"""Progress of a job: a live bar on a terminal and in a notebook, or one line per minute elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import rich.progress
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn

from sgsst_core.progress import Progress

#: Seconds between lines if there is no terminal, such as in a log file.
LOG_SECONDS = 60.0
_TITLES = {
    "planning": "Surveying the views",
    "refining": "Choosing Gaussians to split",
    "coarse": "coarsest scale",
    "sos": "all scales",
    "measuring": "checking quality",
}


def live_bar(console: Console, *columns: ProgressColumn, enabled: bool = True) -> rich.progress.Progress:
    """Return a progress bar that is live on a terminal and in a notebook.

    Elsewhere, or if it is not enabled, it prints nothing.
    """
    live = console.is_terminal or console.is_jupyter
    return rich.progress.Progress(*columns, console=console, transient=True, disable=not (enabled and live))


def set_total(bar: rich.progress.Progress, total: float | None) -> None:
    """Set the total of a bar's only task; None if it is unknown, which `Progress.update` would ignore."""
    bar.tasks[0].total = total


class JobBar:
    """Progress of a job, from reading the scene to the last step; see `job_bar`."""

    def __init__(self, bar: rich.progress.Progress) -> None:
        self._bar = bar
        self._task = bar.add_task("Reading the scene", total=None, note="")
        self._last_line = time.monotonic()
        self._compiled = 0

    def show(self, progress: Progress) -> None:
        """Show the stage, and how many of its views or steps are completed."""
        title = _TITLES.get(progress.stage, progress.stage)
        _, done, total = progress.completed
        set_total(self._bar, total or None)
        self._bar.update(self._task, description=title, completed=done, note=progress.note)
        if self._bar.disable and time.monotonic() - self._last_line >= LOG_SECONDS:
            self._last_line = time.monotonic()
            self._bar.console.print(progress.text(title))

    def show_compiling(self) -> None:
        """Show that a kernel is being compiled. All of them take half a minute in the first job on a machine."""
        self._compiled += 1
        title = "Compiling kernels, once on this machine"
        self._bar.update(self._task, description=f"{title}: {self._compiled}")
        if self._bar.disable and self._compiled == 1:
            self._bar.console.print(title)


@contextmanager
def job_bar(console: Console) -> Iterator[JobBar]:
    """Show the progress of a job as a live bar on a terminal and in a notebook, or elsewhere as a line per minute."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[note]}"),
    )
    with live_bar(console, *columns) as live:
        from sgsst_core.compiled import compilations_reported  # takes seconds to import

        bar = JobBar(live)
        with compilations_reported(bar.show_compiling):
            yield bar
