"""Progress of a job as it is reported, stored, sent and shown; decisions of its plan; texts about both."""

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import rich.progress
from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, ProgressColumn, TextColumn

#: What a step of a stage stands for, if it is not a step of the optimization.
_UNITS = {"planning": "view", "refining": "view", "video": "frame"}


def _fraction(known: dict[str, Any]) -> float:
    """Return the completed fraction, given the fields before it."""
    return known["step"] / known["total"] if known.get("total") else 0.0


class Progress(BaseModel):
    """Progress of a job: a step, or the work before and after the steps.

    Example:
        >>> Progress(stage="sos", step=3, total=12, loss=0.5, eta_s=61.0).text()
        'sos: step 3 of 12, loss 0.5, 1:01 left'
    """

    model_config = ConfigDict(
        frozen=True,
        json_schema_extra={
            "examples": [
                {
                    "stage": "sos",
                    "step": 120,
                    "total": 300,
                    "fraction": 0.4,
                    "eta_s": 310.5,
                    "loss": 23729174.8,
                    "scales": [41029174.8, 19120331.2, 11038018.4],
                    "mean_loss": 24105220.5,
                    "mean_scales": [42105220.5, 19210441.0, 11000000.0],
                    "seconds": 205.1,
                }
            ]
        },
    )

    stage: str = Field(
        description="`reading`, `planning` (surveying the views), `refining` (choosing Gaussians to split), "
        "`starting`, `coarse` (coarsest scale), `sos` (all scales), `measuring` "
        "(checking the quality of some views), `painting` (following painted views) or `video` (frames of the video)."
    )
    step: int = Field(0, description="Completed steps; views while `planning` or `refining`; frames while `video`.")
    total: int = Field(0, description="Maximum number of steps or views; 0 while unknown.")
    fraction: float = Field(default_factory=_fraction, description="Completed fraction of the steps or views, 0 to 1.")
    eta_s: float | None = Field(
        None, description="Estimated remaining seconds, including measurements at the end; null if unknown."
    )
    loss: float | None = Field(None, description="Loss of the step.")
    scales: list[float | None] | None = Field(
        None, description="Loss of each scale, full size first; null for scales that the step skipped."
    )
    mean_loss: float | None = Field(None, description="Loss of the last round of views, comparable over time.")
    mean_scales: list[float | None] | None = Field(None, description="The same for each scale.")
    views_checked: int | None = Field(None, description="While `measuring`: completed views of this check of quality.")
    views_to_check: int | None = Field(None, description="While `measuring`: all views of this check of quality.")
    seconds: float | None = Field(None, description="Seconds of all steps so far.")

    @property
    def is_step(self) -> bool:
        """Whether this is the progress after a step of the optimization."""
        return self.loss is not None

    @property
    def completed(self) -> tuple[str, int, int]:
        """Return the unit of the stage, and the number of completed and of all units."""
        if self.views_to_check is not None:
            return "view", self.views_checked or 0, self.views_to_check
        return _UNITS.get(self.stage, "step"), self.step, self.total

    @property
    def note(self) -> str:
        """Return the loss and the remaining time as text; empty if both are unknown."""
        loss, left = self.mean_loss or self.loss, self.eta_s
        time_left = "" if left is None else f"{clock(left)} left" if left >= 1 else "almost done"
        return ", ".join(filter(None, ("" if loss is None else f"loss {loss:.3g}", time_left)))

    def text(self, title: str | None = None) -> str:
        """Return the progress as a line, which starts with the stage or the `title` of it."""
        unit, done, total = self.completed
        stage = title or self.stage
        return ", ".join(filter(None, (f"{stage}: {unit} {done} of {total}" if total else stage, self.note)))


#: Subject of the decision about views that see nothing.
VIEWS = "views"
#: Cost in accuracy of a decision that changes what is minimized.
ANOTHER_LOSS = "differs from the paper's loss"


@dataclass(frozen=True)
class Decision:
    """One line of a plan.

    Attributes:
        bytes: Memory saved in bytes; None if unknown.
        error: Possible cost in accuracy; "none" if results change only by rounding.
    """

    item: str
    decision: str
    reason: str
    bytes: int | None = None
    error: str = "none"


#: Beginning of decisions that need the user's attention.
_WARNING = "warning: "


def warnings_of(decisions: Sequence[Decision]) -> list[str]:
    """Return decisions that need the user's attention as sentences: warnings, and views that are skipped."""
    return [
        f"{each.item}: {each.decision.removeprefix(_WARNING)}: {each.reason}"
        for each in decisions
        if each.decision.startswith(_WARNING) or each.item == VIEWS
    ]


#: Text for a missing value.
NOTHING = "–"
#: No-break space between a number and its unit.
_GAP = "\u00a0"


def number(value: float | None, digits: int = 3) -> str:
    """Format a number with `digits` significant digits; below 1e9, integer digits are never rounded away."""
    if value is None:
        return NOTHING
    if not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("∞" if value > 0 else "−∞")
    return f"{value:,.0f}" if 10**digits <= abs(value) < 1e9 else f"{value:,.{digits}g}"


def percent(fraction: float | None, digits: int = 2) -> str:
    """Format a fraction in percent, with `digits` significant digits."""
    return NOTHING if fraction is None else f"{number(100 * fraction, digits)}{_GAP}%"


def duration(seconds: float | None, gap: str = _GAP) -> str:
    """Format seconds as seconds, minutes or hours, with `gap` between numbers and units."""
    if seconds is None or not math.isfinite(seconds):
        return NOTHING
    if seconds < 60:
        return f"{number(round(seconds, 4))}{gap}s"
    whole = round(seconds)
    if whole < 3600:
        return gap.join((f"{whole // 60}", "min", f"{whole % 60:02}", "s"))
    minutes = round(seconds / 60)
    return gap.join((f"{minutes // 60}", "h", f"{minutes % 60:02}", "min"))


def byte_count(count: float | None) -> str:
    """Format bytes with the largest unit that gives at least 1."""
    if count is None or not math.isfinite(count):
        return NOTHING
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if abs(count) >= size:
            return f"{number(count / size)}{_GAP}{unit}"
    return f"{count:.0f}{_GAP}bytes"


def clock(seconds: float) -> str:
    """Return a duration as minutes and seconds, or hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


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
        self._bar.tasks[0].total = total or None  # `update` would ignore None
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
        yield JobBar(live)
