"""Tests of the order of the queue, and of the decision whether a job is retried."""

import random

import pytest

from service.states import TRANSITIONS, AttemptOutcome, Cause, JobStatus, Transition
from service.store import Store
from service.store.queue import (
    MAX_LOSSES,
    MAX_RETRY_SECONDS,
    RetryPolicy,
    cause_of,
)
from service.store.tables import JobRow
from tests.service.store.helpers import ATTEMPTS, LEASE, Clock, lease, queue


def sorted_queue(jobs: list[JobRow], served: dict[str, int], now: float) -> JobRow | None:
    """Return the next job by the reference algorithm, which sorts all jobs that may start."""
    ready = [job for job in jobs if job.status == JobStatus.QUEUED and job.not_before <= now]
    lost = [job for job in jobs if job.lease_expires_at is not None and job.lease_expires_at < now]
    ready += [job for job in lost if job.failures + 1 < ATTEMPTS]  # the others end when they are examined
    return min(ready, key=lambda job: (-job.priority, served.get(job.owner, 0), job.queued_at, job.id), default=None)


@pytest.mark.parametrize("seed", range(2))
def test_queue_order_equals_a_plain_sort(store: Store, clock: Clock, seed: int) -> None:
    chance = random.Random(seed)
    served: dict[str, int] = {}
    for turn in range(1, 40):
        clock.now += chance.choice([0, 1, LEASE / 4])
        for _ in range(chance.randrange(4)):
            queue(store, chance.choice("abcdef"), chance.choice([0, 0, 0, 1]))
        expected = sorted_queue([job.row for job in store.jobs.page(None, limit=1000)], served, clock.now)
        lease = store.leases.take("one")
        assert (lease and lease.job_id) == (expected and expected.id)
        if lease is None:
            continue
        served[lease.job.owner] = turn
        ending = chance.randrange(4)
        if ending == 0:
            store.leases.fail(lease, {"code": "infrastructure", "message": "x"}, permanent=False)
        elif ending == 1:
            store.leases.release(lease)
        elif ending == 2:
            store.leases.succeed(lease, [], {})  # in the fourth case the job is lost


def test_waiting_jobs_are_counted_up_to_a_maximum(store: Store, clock: Clock) -> None:
    for _ in range(5):
        queue(store)
    lease(store)
    assert (store.leases.waiting(), store.leases.waiting(3)) == (4, 3)
    clock.now += LEASE + 1
    assert (store.leases.waiting(), store.leases.waiting(3)) == (5, 3)


POLICY = RetryPolicy(max_attempts=3, retry_seconds=5.0)


def job(
    failures: int = 0, failed_step: int | None = None, saved: int | None = None, status: str = JobStatus.RUNNING
) -> JobRow:
    """Return a job with this status and count of failures."""
    return JobRow(status=status, failures=failures, failed_step=failed_step, saved_step=saved)


@pytest.mark.parametrize(
    ("before", "saved", "after"),
    [
        ((0, None), None, (1, None)),
        ((1, None), None, (2, None)),
        ((1, None), 0, (2, 0)),
        ((2, None), 10, (0, 10)),
        ((2, 10), 10, (3, 10)),
        ((2, 10), 11, (0, 11)),
        ((1, 10), 5, (2, 5)),
    ],
)
def test_failures_count_only_without_progress(
    before: tuple[int, int | None], saved: int | None, after: tuple[int, int | None]
) -> None:
    failed = job(*before, saved)
    POLICY.after_attempt(AttemptOutcome.FAILED, failed)
    assert (failed.failures, failed.failed_step) == after


@pytest.mark.parametrize("outcome", [AttemptOutcome.FAILED, AttemptOutcome.LOST, AttemptOutcome.RELEASED])
@pytest.mark.parametrize("permanent", [False, True])
def test_canceling_job_is_stopped(outcome: AttemptOutcome, permanent: bool) -> None:
    canceled = job(2, 3, 3, JobStatus.CANCELING)
    assert POLICY.after_attempt(outcome, canceled, permanent=permanent) == (Transition.STOP, 0.0)
    assert (canceled.failures, canceled.failed_step) == (2, 3)


def test_retry_delay_doubles_up_to_its_maximum() -> None:
    policy = RetryPolicy(max_attempts=100, retry_seconds=5.0)
    waits = [policy.after_attempt(AttemptOutcome.FAILED, job(failures))[1] for failures in range(9)]
    assert waits == [5, 10, 20, 40, 80, 160, MAX_RETRY_SECONDS, MAX_RETRY_SECONDS, MAX_RETRY_SECONDS]


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
    count, waits = (POLICY.max_attempts - 1, 10), []
    for repeated in range(1, MAX_LOSSES):
        ended = job(*count, 10)
        transition, wait = POLICY.after_attempt(outcome, ended, [cause] * repeated + [Cause.JOB])
        assert (transition, ended.failures, ended.failed_step) == (Transition.REQUEUE, *count)
        waits.append(wait)
    lost = outcome == AttemptOutcome.LOST
    assert waits[:3] == [0.0 if lost else POLICY.retry_seconds * factor for factor in (1, 2, 4)]
    assert waits[-1] == (0.0 if lost else MAX_RETRY_SECONDS)
    assert POLICY.after_attempt(outcome, job(*count, 10, JobStatus.CANCELING), [cause])[0] == Transition.STOP


@pytest.mark.parametrize("cause", OTHERS)
def test_job_that_may_end_its_dispatchers_fails_at_last(cause: Cause) -> None:
    """An outage never fails a job, however often it occurs."""
    transition, _ = POLICY.after_attempt(AttemptOutcome.LOST, job(), [cause] * MAX_LOSSES)
    assert transition == (Transition.FAIL if cause == Cause.DISPATCHER else Transition.REQUEUE)
    mixed = [Cause.DISPATCHER, Cause.DATABASE] * MAX_LOSSES
    assert POLICY.after_attempt(AttemptOutcome.LOST, job(), mixed)[0] == Transition.REQUEUE


@pytest.mark.parametrize("status", [JobStatus.STARTING, JobStatus.RUNNING, JobStatus.CANCELING])
@pytest.mark.parametrize("outcome", [AttemptOutcome.FAILED, AttemptOutcome.LOST, AttemptOutcome.RELEASED])
@pytest.mark.parametrize("permanent", [False, True])
def test_every_verdict_is_an_allowed_transition(status: JobStatus, outcome: AttemptOutcome, permanent: bool) -> None:
    for failures in range(POLICY.max_attempts + 1):
        transition, _ = POLICY.after_attempt(outcome, job(failures, status=status), permanent=permanent)
        assert status in TRANSITIONS[transition]
