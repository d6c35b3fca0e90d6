"""Retry policy for jobs whose attempt ended without a result, as pure functions for `service.store.leases`."""

from __future__ import annotations

from dataclasses import dataclass

from service.store.states import AttemptOutcome, JobStatus, Transition

#: Maximum delay between attempts in seconds; the delay doubles up to this limit.
MAX_RETRY_SECONDS = 300.0


@dataclass(frozen=True)
class FailureCount:
    """Count of consecutive failed attempts without progress.

    Attributes:
        failures: Number of failures.
        failed_step: Last saved step at the time of the last failure; None for no step.
    """

    failures: int
    failed_step: int | None

    def with_failure(self, saved_step: int | None) -> FailureCount:
        """Return the count after another failure.

        A failure after progress resets the count. A long job thus survives many sporadic failures, while a job that
        fails at the same step each time does not.

        Args:
            saved_step: Last saved step of the job; None for no step.
        """
        progress = (saved_step or 0) > (self.failed_step or 0)
        return FailureCount(0 if progress else self.failures + 1, saved_step)


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
        *,
        permanent: bool = False,
    ) -> Verdict:
        """Decide whether a job is retried after an attempt that failed, was lost or was released.

        Args:
            outcome: Outcome of the attempt.
            status: Status of the job while the attempt ran.
            count: Count of failures before this attempt.
            saved_step: Last saved step of the job; None for no step.
            permanent: Whether another attempt would fail in the same way.
        """
        if status == JobStatus.CANCELING:
            return Verdict(Transition.STOP, count)
        if outcome == AttemptOutcome.RELEASED:
            return Verdict(Transition.REQUEUE, count)
        count = count.with_failure(saved_step)
        if permanent or count.failures >= self.max_attempts:
            return Verdict(Transition.FAIL, count)
        # a lost attempt has already cost the duration of a lease
        return Verdict(Transition.REQUEUE, count, 0.0 if outcome == AttemptOutcome.LOST else self._wait(count.failures))

    def after_outage(self, status: JobStatus, count: FailureCount, outages: int) -> Verdict:
        """Decide when a job is retried after a machine, the network or the file store failed.

        This does not count as a failure of the job. It is retried with growing delays until it succeeds or is canceled.

        Args:
            status: Status of the job while the attempt ran.
            count: Count of failures before this attempt; it does not change.
            outages: Number of consecutive attempts that ended in an outage, including this one.
        """
        if status == JobStatus.CANCELING:
            return Verdict(Transition.STOP, count)
        return Verdict(Transition.REQUEUE, count, self._wait(outages))

    def _wait(self, times: int) -> float:
        return min(self.retry_seconds * 2.0 ** max(times - 1, 0), MAX_RETRY_SECONDS)
