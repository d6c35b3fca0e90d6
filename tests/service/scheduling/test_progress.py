"""Tests of the progress that an attempt's process reports, and of how often the dispatcher stores it."""

from __future__ import annotations

import io

import pytest

from service.scheduling import attempt_process
from service.scheduling.attempt_process import report_prepared, report_progress
from service.scheduling.attempts import progress_seconds
from service.scheduling.messages import Report
from sgsst_core.progress import Progress
from worker.prepare import Prepared


@pytest.fixture
def channel(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """Return the stream that receives the attempt's reports to the dispatcher."""
    written = io.StringIO()
    monkeypatch.setattr(attempt_process, "_channel", written)
    return written


def reports(channel: io.StringIO) -> list[Report]:
    """Return the reports as the dispatcher reads them."""
    return [Report.model_validate_json(line) for line in channel.getvalue().splitlines()]


def test_dispatcher_gets_progress_unchanged(channel: io.StringIO) -> None:
    sent = [
        Progress(stage="planning", step=0, total=8),
        Progress(stage="sos", step=6, total=12, loss=0.5, scales=[None, 0.5], seconds=20.0, eta_s=10.0),
        Progress(stage="measuring", step=60, total=60, loss=0.5, views_checked=3, views_to_check=8),
    ]
    for each in sent:
        report_progress(each)
    assert [report.progress for report in reports(channel)] == sent


def test_plan_is_logged_before_the_first_step(channel: io.StringIO, capsys: pytest.CaptureFixture[str]) -> None:
    report_prepared(Prepared([("scene", "616 Gaussians")], 3, 12))
    assert reports(channel) == [Report(prepared=True)]
    assert "scene: 616 Gaussians" in capsys.readouterr().err


def test_long_running_job_writes_progress_less_often() -> None:
    assert [progress_seconds(elapsed) for elapsed in (0, 30, 60, 120, 300, 1e6)] == [1, 1, 1, 2, 5, 5]
