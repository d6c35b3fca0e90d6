"""Progress of a job: a live bar on a terminal and in a notebook, or one line per minute elsewhere."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, TextColumn

if TYPE_CHECKING:
    from sgsst_core.planning.survey import PlanningProgress
    from sgsst_core.stylizing.loop import Progress as StepProgress

#: Seconds between lines if there is no terminal, such as in a log file.
LOG_SECONDS = 60.0
_PLANNING = {
    "planning": "Surveying the views",
    "refining": "Choosing Gaussians to split",
    "probing": "Measuring the speed",
}
_STAGES = {"coarse": "coarsest scale", "sos": "all scales", "measuring": "checking quality"}


def live_bar(console: Console, *columns: ProgressColumn, enabled: bool = True) -> Progress:
    """Return a progress bar that is live on a terminal and in a notebook.

    Elsewhere, or if it is not enabled, it prints nothing.
    """
    live = console.is_terminal or console.is_jupyter
    return Progress(*columns, console=console, transient=True, disable=not (enabled and live))


def set_total(bar: Progress, total: float | None) -> None:
    """Set the total of a bar's only task; None if it is unknown, which `Progress.update` would ignore."""
    bar.tasks[0].total = total


class JobBar:
    """Progress of a job, from reading the scene to the last step; see `job_bar`."""

    def __init__(self, bar: Progress) -> None:
        self._bar = bar
        self._task = bar.add_task("Reading the scene", total=None, note="")
        self._last_line = time.monotonic()

    def show_planning(self, planning: PlanningProgress) -> None:
        """Show the stage, and how many of its views are completed."""
        stage, left = _PLANNING[planning.stage], time_left(planning.seconds_left)
        self._show(stage, planning.done, planning.total or None, left)
        done = f": {planning.done} of {planning.total}" if planning.total else ""
        self._print_now_and_then(f"{stage}{done}", left)

    def start(self, step: int, total: int) -> None:
        """Show the number of completed steps, before the next one."""
        self._show("starting", step, total, "")

    def show(self, progress: StepProgress) -> None:
        """Show a step, or the views of a quality check."""
        stage, left = _STAGES[progress.stage], time_left(progress.seconds_left)
        loss = f"loss {progress.mean_loss or progress.loss:.3g}"
        done, total = progress.views or (progress.step, progress.total)
        self._show(stage, done, total, f"{loss} {left}")
        self._print_now_and_then(f"{stage}: {'view' if progress.views else 'step'} {done} of {total}", loss, left)

    def show_compiling(self) -> None:
        """Show that kernels are being compiled, which takes half a minute in the first job on a machine."""
        self._bar.update(self._task, description="Compiling kernels, once on this machine")

    def _show(self, description: str, done: int, total: int | None, note: str) -> None:
        set_total(self._bar, total)
        self._bar.update(self._task, description=description, completed=done, note=note)

    def _print_now_and_then(self, *parts: str) -> None:
        if self._bar.disable and time.monotonic() - self._last_line >= LOG_SECONDS:
            self._last_line = time.monotonic()
            self._bar.console.print(", ".join(part for part in parts if part))


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


def time_left(seconds: float | None) -> str:
    """Return the remaining time of a stage as text; empty if it is unknown."""
    if seconds is None:
        return ""
    return f"{clock(seconds)} left" if seconds >= 1 else "almost done"


def clock(seconds: float) -> str:
    """Return a duration as minutes and seconds, or hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
