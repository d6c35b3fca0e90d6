"""Tests of the decision whether a job is retried after an attempt, without a database."""

from __future__ import annotations

import pytest

from service.states import TRANSITIONS, AttemptOutcome, Cause, JobStatus, Transition
from service.store.queue import MAX_LOSSES, MAX_RETRY_SECONDS, FailureCount, RetryPolicy, Verdict, cause_of

POLICY = RetryPolicy(max_attempts=3, retry_seconds=5.0)
FRESH = FailureCount(0, None)


@pytest.mark.parametrize(
    ("before", "saved", "after"),
    [
        (FailureCount(0, None), None, FailureCount(1, None)),
        (FailureCount(1, None), None, FailureCount(2, None)),
        (FailureCount(1, None), 0, FailureCount(2, 0)),
        (FailureCount(2, None), 10, FailureCount(0, 10)),
        (FailureCount(2, 10), 10, FailureCount(3, 10)),
        (FailureCount(2, 10), 11, FailureCount(0, 11)),
        (FailureCount(1, 10), 5, FailureCount(2, 5)),
    ],
)
def test_failures_count_only_without_progress(before: FailureCount, saved: int | None, after: FailureCount) -> None:
    assert POLICY.after_attempt(AttemptOutcome.FAILED, JobStatus.RUNNING, before, saved).count == after


@pytest.mark.parametrize("outcome", [AttemptOutcome.FAILED, AttemptOutcome.LOST, AttemptOutcome.RELEASED])
@pytest.mark.parametrize("permanent", [False, True])
def test_canceling_job_is_stopped(outcome: AttemptOutcome, permanent: bool) -> None:
    decision = POLICY.after_attempt(outcome, JobStatus.CANCELING, FailureCount(2, 3), 3, permanent=permanent)
    assert decision == Verdict(Transition.STOP, FailureCount(2, 3))


@pytest.mark.parametrize("status", [JobStatus.STARTING, JobStatus.RUNNING])
def test_released_job_is_requeued_without_a_failure(status: JobStatus) -> None:
    decision = POLICY.after_attempt(AttemptOutcome.RELEASED, status, FailureCount(2, 3), 9)
    assert decision == Verdict(Transition.REQUEUE, FailureCount(2, 3), 0.0)


def test_retry_delay_doubles_up_to_its_maximum() -> None:
    policy = RetryPolicy(max_attempts=100, retry_seconds=5.0)
    count, waits = FRESH, []
    for _ in range(9):
        verdict = policy.after_attempt(AttemptOutcome.FAILED, JobStatus.RUNNING, count, None)
        assert verdict.transition == Transition.REQUEUE
        count = verdict.count
        waits.append(verdict.wait)
    assert waits == [5, 10, 20, 40, 80, 160, MAX_RETRY_SECONDS, MAX_RETRY_SECONDS, MAX_RETRY_SECONDS]


def test_progress_resets_the_retry_delay() -> None:
    decision = POLICY.after_attempt(AttemptOutcome.FAILED, JobStatus.RUNNING, FailureCount(2, 10), 20)
    assert decision == Verdict(Transition.REQUEUE, FailureCount(0, 20), POLICY.retry_seconds)


#: Causes that never count against a job.
OTHERS = [cause for cause in Cause if cause != Cause.JOB]


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (None, Cause.JOB),
        ({"code": "crashed"}, Cause.JOB),
        ({"code": "out-of-memory"}, Cause.JOB),
        ({"code": "invalid-scene"}, Cause.JOB),
        ({"code": "workers-failed"}, Cause.JOB),
        ({"code": "infrastructure"}, Cause.MACHINE),
        ({"code": "infrastructure", "cause": "disk"}, Cause.DISK),
        ({"code": "infrastructure", "cause": "store"}, Cause.STORE),
        ({"code": "infrastructure", "cause": "database"}, Cause.DATABASE),
        ({"code": "dispatcher-lost"}, Cause.DISPATCHER),
    ],
)
def test_cause_of_recorded_error(error: dict[str, str] | None, cause: Cause) -> None:
    assert cause_of(error) == cause


@pytest.mark.parametrize("cause", OTHERS)
@pytest.mark.parametrize("outcome", [AttemptOutcome.FAILED, AttemptOutcome.LOST])
def test_only_own_failures_count(cause: Cause, outcome: AttemptOutcome) -> None:
    count, waits = FailureCount(POLICY.max_attempts - 1, 10), []
    for repeated in range(1, MAX_LOSSES):
        verdict = POLICY.after_attempt(outcome, JobStatus.RUNNING, count, 10, [cause] * repeated + [Cause.JOB])
        assert (verdict.transition, verdict.count) == (Transition.REQUEUE, count)
        waits.append(verdict.wait)
    lost = outcome == AttemptOutcome.LOST
    assert waits[:3] == [0.0 if lost else POLICY.retry_seconds * factor for factor in (1, 2, 4)]
    assert waits[-1] == (0.0 if lost else MAX_RETRY_SECONDS)
    assert POLICY.after_attempt(outcome, JobStatus.CANCELING, count, 10, [cause]).transition == Transition.STOP


@pytest.mark.parametrize("cause", OTHERS)
def test_job_that_may_end_its_dispatchers_fails_at_last(cause: Cause) -> None:
    """An outage never fails a job, however often it occurs."""
    verdict = POLICY.after_attempt(AttemptOutcome.LOST, JobStatus.STARTING, FRESH, None, [cause] * MAX_LOSSES)
    assert verdict.transition == (Transition.FAIL if cause == Cause.DISPATCHER else Transition.REQUEUE)
    mixed = [Cause.DISPATCHER, Cause.DATABASE] * MAX_LOSSES
    assert POLICY.after_attempt(AttemptOutcome.LOST, JobStatus.STARTING, FRESH, None, mixed).transition == (
        Transition.REQUEUE
    )


def test_own_failures_without_progress_are_limited() -> None:
    count, decisions = FRESH, []
    for _ in range(POLICY.max_attempts):
        verdict = POLICY.after_attempt(AttemptOutcome.FAILED, JobStatus.STARTING, count, None)
        decisions.append(verdict.transition)
        count = verdict.count
    assert decisions == [Transition.REQUEUE, Transition.REQUEUE, Transition.FAIL]


def test_permanent_failure_is_not_retried() -> None:
    decision = POLICY.after_attempt(AttemptOutcome.FAILED, JobStatus.RUNNING, FRESH, 50, permanent=True)
    assert decision.transition == Transition.FAIL


@pytest.mark.parametrize("status", [JobStatus.STARTING, JobStatus.RUNNING, JobStatus.CANCELING])
@pytest.mark.parametrize("outcome", [AttemptOutcome.FAILED, AttemptOutcome.LOST, AttemptOutcome.RELEASED])
@pytest.mark.parametrize("permanent", [False, True])
def test_every_verdict_is_an_allowed_transition(status: JobStatus, outcome: AttemptOutcome, permanent: bool) -> None:
    for failures in range(POLICY.max_attempts + 1):
        count = FailureCount(failures, None)
        verdict = POLICY.after_attempt(outcome, status, count, None, permanent=permanent)
        assert status in TRANSITIONS[verdict.transition]
