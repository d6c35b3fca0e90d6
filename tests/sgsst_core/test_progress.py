"""Tests of what a job shows: progress, progress bars and numbers."""

import io
from typing import Any

import numba
import pytest
from rich.console import Console

from sgsst_core import progress as module
from sgsst_core.compiled import compilations_reported
from sgsst_core.progress import Progress, clock, duration, job_bar


@pytest.mark.parametrize(
    ("progress", "fraction", "text"),
    [
        (Progress(stage="reading"), 0.0, "reading"),
        (Progress(stage="planning", step=2, total=8, eta_s=31.5), 0.25, "planning: view 2 of 8, 0:32 left"),
        (Progress(stage="starting", step=3, total=12), 0.25, "starting: step 3 of 12"),
        (Progress(stage="sos", step=6, total=12, loss=0.5, mean_loss=0.25), 0.5, "sos: step 6 of 12, loss 0.25"),
        (
            Progress(stage="measuring", step=60, total=60, loss=0.5, eta_s=0.2, views_checked=3, views_to_check=8),
            1.0,
            "measuring: view 3 of 8, loss 0.5, almost done",
        ),
        (Progress(stage="video", step=1, total=4), 0.25, "video: frame 1 of 4"),
    ],
)
def test_text_names_what_the_stage_counts(progress: Progress, fraction: float, text: str) -> None:
    assert (progress.fraction, progress.text()) == (fraction, text)
    assert Progress.model_validate_json(progress.model_dump_json()) == progress


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0.31234, "0.312 s"),
        (59, "59 s"),
        (61, "1 min 01 s"),
        (3599.6, "1 h 00 min"),
        (4900, "1 h 22 min"),
        (75200, "20 h 53 min"),
        (None, "–"),
    ],
)
def test_duration_is_in_seconds_minutes_or_hours(seconds: float | None, text: str) -> None:
    assert (duration(seconds, " "), duration(seconds)) == (text, text.replace(" ", "\u00a0"))


def shown(*, terminal: bool) -> str:
    """Return the progress output of a small job."""
    console = Console(file=io.StringIO(), force_terminal=terminal, width=120, color_system=None)
    with job_bar(console) as bar:
        for done, left in [(0, None), (3, 125.0), (8, 0.0)]:
            bar.show(Progress(stage="planning", step=done, total=8, eta_s=left))
            bar._bar.refresh()  # now, instead of within a tenth of a second
        bar.show(Progress(stage="starting", total=50))
        for step in (1, 2):
            bar.show(Progress(stage="coarse", step=step, total=50, loss=123.4, eta_s=61.0))
            bar._bar.refresh()
        checked = {"views_checked": 3, "views_to_check": 6}
        bar.show(Progress(stage="measuring", step=2, total=50, loss=123.4, eta_s=0.4, **checked))
        bar._bar.refresh()
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_terminal_shows_views_then_steps() -> None:
    output = shown(terminal=True)
    for text in ("Surveying the views", "0/8", "3/8 2:05 left", "8/8", "coarsest scale", "2/50 loss 123, 1:01 left"):
        assert text in output
    assert "8/8" not in output[output.index("coarsest scale") :], "the survey is over"
    assert "3/6 loss 123, almost done" in output[output.index("checking quality") :]


def test_terminal_shows_compilation_of_kernels() -> None:
    add: Any = numba.njit(lambda a, b: a + b)  # type: ignore[call-arg]
    console = Console(file=io.StringIO(), force_terminal=True, width=120, color_system=None)
    with job_bar(console) as bar, compilations_reported(bar.show_compiling):
        for _ in range(2):
            bar.show(Progress(stage="planning", step=0, total=8))
            add(1, 2)
            bar._bar.refresh()
    assert isinstance(console.file, io.StringIO)
    output = console.file.getvalue()
    assert output.index("Compiling kernels") < output.rindex("Surveying the views"), "the second call compiles nothing"


def test_log_prints_a_line_at_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown(terminal=False).strip() == ""
    monkeypatch.setattr(module, "LOG_SECONDS", 0.0)
    assert shown(terminal=False).strip().splitlines() == [
        "Surveying the views: view 0 of 8",
        "Surveying the views: view 3 of 8, 2:05 left",
        "Surveying the views: view 8 of 8, almost done",
        "starting: step 0 of 50",
        "coarsest scale: step 1 of 50, loss 123, 1:01 left",
        "coarsest scale: step 2 of 50, loss 123, 1:01 left",
        "checking quality: view 3 of 6, loss 123, almost done",
    ]


@pytest.mark.parametrize(("seconds", "text"), [(0.4, "0:00"), (59.6, "1:00"), (3599.0, "59:59"), (36610.0, "10:10:10")])
def test_clock_formats_durations(seconds: float, text: str) -> None:
    assert clock(seconds) == text
