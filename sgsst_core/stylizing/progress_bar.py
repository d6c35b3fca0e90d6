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
_STAGES = {"coarse": "coarsest scale", "sos": "all scales", "measuring": "measuring"}


def live_bar(console: Console, *columns: ProgressColumn, enabled: bool = True) -> Progress:
    """Return a progress bar that is live on a terminal and in a notebook.

    Elsewhere, or if it is not enabled, it prints nothing.
    """
    live = console.is_terminal or console.is_jupyter
    return Progress(*columns, console=console, transient=True, disable=not (enabled and live))


class JobBar:
    """Progress of a job, from reading the scene to the last step; see `job_bar`."""

    def __init__(self, bar: Progress) -> None:
        self._bar = bar
        self._task = bar.add_task("Reading the scene", total=None, note="")
        self._last_line = time.monotonic()

    def show_planning(self, planning: PlanningProgress) -> None:
        """Show how many views have been surveyed."""
        left = "" if planning.seconds_left is None else f"{clock(planning.seconds_left)} left"
        self._show("Surveying the views", planning.done, planning.total, left)
        self._print_now_and_then(f"Surveying the views: {planning.done} of {planning.total}", left)

    def start(self, step: int, total: int) -> None:
        """Show the number of completed steps, before the next one."""
        self._show("starting", step, total, "")

    def show(self, progress: StepProgress) -> None:
        """Show a step."""
        stage = _STAGES[progress.stage]
        loss, left = f"loss {progress.mean_loss or progress.loss:.3g}", f"{clock(progress.seconds_left)} left"
        self._show(stage, progress.step, progress.total, f"{loss} {left}")
        self._print_now_and_then(f"{stage}: step {progress.step} of {progress.total}", loss, left)

    def show_compiling(self) -> None:
        """Show that kernels are being compiled, which takes half a minute in the first job on a machine."""
        self._bar.update(self._task, description="Compiling kernels, once on this machine")

    def _show(self, description: str, done: int, total: int, note: str) -> None:
        self._bar.update(self._task, description=description, completed=done, total=total, note=note)

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


def clock(seconds: float) -> str:
    """Return a duration as minutes and seconds, or hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
