"""Tests of the decision how an attempt ended, without running a process."""

from __future__ import annotations

import errno
import signal
import subprocess
import sys
from typing import Any

import pytest

from service import problems
from service.scheduling.attempt_process import failure
from service.scheduling.messages import Ending, StopRequest, attempt_ending, cause_of_error, outage
from service.states import AttemptOutcome, Cause
from service.store.queue import cause_of
from sgsst_core.errors import (
    ClusterAwayError,
    ImageError,
    InfrastructureError,
    OutputError,
    RanksFailedError,
    WeightsError,
)
from worker.job import Result

DONE = Ending(AttemptOutcome.SUCCEEDED, Result(stopped="finished", steps=3, total=3))
ERROR = {"code": "diverged", "message": "The loss is not finite."}
FAILED = Ending(AttemptOutcome.FAILED, error=ERROR, permanent=True)
REQUESTS = [None, StopRequest.CANCEL, StopRequest.RELEASE]


def ending(
    requested: StopRequest | None, last: Ending | None, code: int = 0, log: str | None = "the log", **has: bool
) -> Ending:
    return attempt_ending(requested, last, code, log, **{"has_result": True, **has})


@pytest.mark.parametrize("requested", REQUESTS)
def test_finished_attempt_beats_stop_request(requested: StopRequest | None) -> None:
    assert ending(requested, DONE) == DONE


@pytest.mark.parametrize("requested", REQUESTS)
def test_finished_attempt_without_a_result_fails(requested: StopRequest | None) -> None:
    outcome = ending(requested, DONE, has_result=False)
    assert (outcome.outcome, outcome.permanent) == (AttemptOutcome.FAILED, False)
    assert outcome.error == {"code": "internal", "message": "The job ended without a result."}


@pytest.mark.parametrize(
    ("requested", "outcome"), [(StopRequest.CANCEL, "canceled"), (StopRequest.RELEASE, "released")]
)
@pytest.mark.parametrize("last", [FAILED, None])
@pytest.mark.parametrize("code", [0, 1, -signal.SIGKILL])
def test_requested_stop_is_not_a_failure(requested: StopRequest, outcome: str, last: Ending | None, code: int) -> None:
    assert ending(requested, last, code) == Ending(AttemptOutcome(outcome))


def test_process_ended_by_ray_is_an_outage() -> None:
    """When the cluster's head dies, Ray terminates connected processes with exit code 1 and without a message."""
    outcome = ending(None, None, 1, "raylet has died", cluster=True)
    assert (outcome.outcome, outcome.error, outcome.permanent) == (AttemptOutcome.FAILED, outage(Cause.MACHINE), False)
    assert outcome.detail == "The process that ran the job ended with code 1.\nraylet has died"
    for other in (ending(None, None, 1), ending(None, None, -signal.SIGKILL, cluster=True)):
        assert other.error is not None
        assert other.error["code"] == "crashed"
    assert ending(None, FAILED, 1, cluster=True).error == ERROR


@pytest.mark.parametrize("permanent", [False, True])
def test_reported_failure_is_recorded_unchanged(permanent: bool) -> None:
    last = Ending(AttemptOutcome.FAILED, error=ERROR, permanent=permanent)
    assert ending(None, last) == last


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (-signal.SIGKILL, "was killed; the machine may have run out of memory"),
        (-signal.SIGSEGV, "was ended by SIGSEGV"),
        (3, "ended with code 3"),
        (0, "ended with code 0"),
    ],
)
def test_process_without_a_reported_ending_has_crashed(code: int, text: str) -> None:
    outcome = ending(None, None, code)
    assert (outcome.outcome, outcome.permanent) == (AttemptOutcome.FAILED, False)
    error: dict[str, Any] = outcome.error or {}
    assert (error["code"], error["log"]) == ("crashed", "the log")
    assert text in error["message"]
    assert "log" not in (ending(None, None, code, None).error or {})


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (problems.STORE_UNAVAILABLE("The store of files does not answer."), Cause.STORE),
        (problems.DATABASE_BUSY(), Cause.DATABASE),
        (problems.NO_SPACE("The disk is full."), Cause.DISK),
        (OutputError("out/stylized.ply: cannot be written: No space left on device."), Cause.DISK),
        (OSError(errno.ENOSPC, "No space left on device"), Cause.DISK),
        (OSError("24576 requested and 4096 written"), Cause.DISK),
        (RuntimeError("Error while serializing: I/O error: No space left on device (os error 28)"), Cause.DISK),
        (WeightsError("no VGG weights in /root/.cache/sgsst"), Cause.MACHINE),
        (InfrastructureError("The folder is not on this machine."), Cause.MACHINE),
        (ClusterAwayError("The Ray cluster at head:6379 cannot be joined."), Cause.MACHINE),
        (OSError(errno.EINVAL, "Invalid argument"), Cause.JOB),
        (ImageError("style.png: is not an image"), Cause.JOB),
        (MemoryError("out of memory"), Cause.JOB),
        (RanksFailedError("3 attempts in a row came no further than step 0."), Cause.JOB),
    ],
)
def test_cause_of_each_error(error: Exception, cause: Cause) -> None:
    assert cause_of_error(error) == cause
    reported, its_own = failure(error), cause == Cause.JOB
    assert (reported.error == outage(cause)) == (not its_own)
    assert cause_of(reported.error) == cause
    assert (str(error) in (reported.detail or "")) == (not its_own), "for the operator"
    assert reported.outcome == AttemptOutcome.FAILED
    assert its_own or not reported.permanent


def test_process_of_an_attempt_starts_without_libraries_of_the_service() -> None:
    code = (
        "import sys, worker.run, service.scheduling.attempt_process; "
        "print(*{'sqlalchemy', 'httpx2', 'fsspec', 'pydantic_settings', 'torch'} & set(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""
