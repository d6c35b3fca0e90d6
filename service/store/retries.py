"""Retry policy for jobs whose attempt ended without a result, as pure functions for `service.store.leases`.

Only the job's own failures count against it. An attempt that a machine, the network, the database, the disk or the file
store has ended is repeated until it succeeds.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from service.states import AttemptOutcome, Cause, JobStatus, Transition
from sgsst_core.errors import InfrastructureError

#: Maximum delay between attempts in seconds; the delay doubles up to this limit.
MAX_RETRY_SECONDS = 300.0
#: Number of attempts in a row without a step that were lost with their dispatcher, after which a job fails. The
#: dispatcher may have died of the job itself: some container runtimes end all processes of a container that has run out
#: of memory.
MAX_LOSSES = 10
#: Code of the error of an attempt that was lost with its dispatcher.
DISPATCHER_LOST = "dispatcher-lost"


def cause_of(error: Mapping[str, Any] | None) -> Cause:
    """Return the cause of an attempt's end from its recorded error."""
    code = (error or {}).get("code")
    if code == DISPATCHER_LOST:
        return Cause.DISPATCHER
    return Cause((error or {}).get("cause", Cause.MACHINE)) if code == InfrastructureError.code else Cause.JOB


@dataclass(frozen=True)
class FailureCount:
    """Count of consecutive failed attempts without progress.

    Attributes:
        failed_step: Last saved step at the time of the last failure; None for no step.
    """

    failures: int
    failed_step: int | None


@dataclass(frozen=True)
class Verdict:
    """Decision about a job.

    Attributes:
        transition: STOP, FAIL or REQUEUE.
        count: New count of failures for the job's record.
        wait: Delay in seconds before the job may be taken again.
    """

    transition: Transition
    count: FailureCount
    wait: float = 0.0


@dataclass(frozen=True)
class RetryPolicy:
    """Policy for retrying jobs.

    Attributes:
        max_attempts: Consecutive attempts without progress after which a job fails.
        retry_seconds: Delay after the first failure in seconds; it doubles with each further one, up to
            `MAX_RETRY_SECONDS`.
    """

    max_attempts: int
    retry_seconds: float

    def after_attempt(
        self,
        outcome: AttemptOutcome,
        status: JobStatus,
        count: FailureCount,
        saved_step: int | None,
        causes: Sequence[Cause] = (Cause.JOB,),
        *,
        permanent: bool = False,
    ) -> Verdict:
        """Decide whether a job is retried after an attempt that failed, was lost or was released.

        Args:
            causes: Cause of the attempt's end, then those of earlier attempts back to the last one that made a step.
            status: Status of the job while the attempt ran.
            count: Count of failures before this attempt.
            saved_step: Last saved step of the job; None for no step.
            permanent: Whether another attempt would fail in the same way.
        """
        if status == JobStatus.CANCELING:
            return Verdict(Transition.STOP, count)
        if outcome == AttemptOutcome.RELEASED:
            return Verdict(Transition.REQUEUE, count)
        if causes[0] == Cause.JOB:
            # progress resets the count: a long job survives many sporadic failures, but not one at the same step again
            progress = (saved_step or 0) > (count.failed_step or 0)
            count = FailureCount(0 if progress else count.failures + 1, saved_step)
            failed, repeated = permanent or count.failures >= self.max_attempts, count.failures
        else:
            failed = list(causes[:MAX_LOSSES]) == [Cause.DISPATCHER] * MAX_LOSSES
            repeated = next((number for number, cause in enumerate(causes) if cause == Cause.JOB), len(causes))
        if failed:
            return Verdict(Transition.FAIL, count)
        wait = min(self.retry_seconds * 2.0 ** max(repeated - 1, 0), MAX_RETRY_SECONDS)
        # a lost attempt has already cost the duration of a lease
        return Verdict(Transition.REQUEUE, count, 0.0 if outcome == AttemptOutcome.LOST else wait)
