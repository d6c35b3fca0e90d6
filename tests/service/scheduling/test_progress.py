"""Tests of progress messages that an attempt's process sends, and of the records that the dispatcher makes of them."""

from __future__ import annotations

import io
import json
from typing import Any

import pytest

from service.scheduling import attempt_process
from service.scheduling.attempt_process import report_planning, report_prepared, report_progress
from service.scheduling.progress import progress_record, progress_seconds
from sgsst_core.planning.survey import PROBING, PlanningProgress
from sgsst_core.stylizing.loop import Progress
from worker.description import Prepared


@pytest.fixture
def channel(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """Return the stream that receives the attempt's messages to the dispatcher."""
    written = io.StringIO()
    monkeypatch.setattr(attempt_process, "_channel", written)
    return written


def records(channel: io.StringIO) -> list[dict[str, Any]]:
    """Return the dispatcher's records of the messages, for a job in its second attempt."""
    return [progress_record(json.loads(line), 2) for line in channel.getvalue().splitlines()]


def test_planning_counts_views_as_steps(channel: io.StringIO) -> None:
    report_planning(PlanningProgress(0, 8))
    report_planning(PlanningProgress(2, 8, 31.5))
    report_planning(PROBING)
    nothing = dict.fromkeys(("loss", "scales", "mean_loss", "mean_scales", "seconds")) | {"attempt": 2}
    nothing |= {"views_checked": None, "views_to_check": None}
    assert records(channel) == [
        {"stage": "planning", "step": 0, "total": 8, "fraction": 0.0, "eta_s": None, **nothing},
        {"stage": "planning", "step": 2, "total": 8, "fraction": 0.25, "eta_s": 31.5, **nothing},
        {"stage": "probing", "step": 0, "total": 0, "fraction": 0.0, "eta_s": None, **nothing},
    ]


def test_checking_quality_counts_its_views(channel: io.StringIO) -> None:
    report_progress(Progress("measuring", 60, 60, 0.5, 20.0, 10.0, views=(3, 8)))
    (checking,) = records(channel)
    assert (checking["views_checked"], checking["views_to_check"]) == (3, 8)
    assert (checking["step"], checking["total"], checking["fraction"]) == (60, 60, 1.0)


def test_progress_starts_at_the_resumed_step(channel: io.StringIO, capsys: pytest.CaptureFixture[str]) -> None:
    report_prepared(Prepared([("scene", "616 Gaussians")], 3, 12))
    report_progress(Progress("sos", 6, 12, 0.5, 20.0, 10.0, (None, 0.5)))
    starting, step = records(channel)
    assert (starting["stage"], starting["step"], starting["fraction"]) == ("starting", 3, 0.25)
    assert (step["stage"], step["fraction"], step["loss"], step["scales"]) == ("sos", 0.5, 0.5, [None, 0.5])
    assert "scene: 616 Gaussians" in capsys.readouterr().err


def test_long_running_job_writes_progress_less_often() -> None:
    assert [progress_seconds(elapsed) for elapsed in (0, 30, 60, 120, 300, 1e6)] == [1, 1, 1, 2, 5, 5]
