"""What becomes of a job whose attempt has ended without its result: decided here, carried out by `leases`. Pure."""

from __future__ import annotations

from dataclasses import dataclass

from service.store.states import AttemptOutcome, JobStatus, Transition

#: A wait between attempts doubles, but not beyond this.
MAX_RETRY_SECONDS = 300.0


@dataclass(frozen=True)
class FailureCount:
    """Failed attempts in a row without progress.

    Attributes:
        failures: how many.
        failed_step: the farthest step that was saved when the last one failed; None for no step.
    """

    failures: int
    failed_step: int | None

    def with_failure(self, saved_step: int | None) -> FailureCount:
        """The count after another failure.

        It counts where nothing has been saved since the last one: a long job outlives many accidents, and one that
        breaks at the same step each time does not.

        Args:
            saved_step: the farthest that was saved of the job; None for no step.
        """
        progress = (saved_step or 0) > (self.failed_step or 0)
        return FailureCount(0 if progress else self.failures + 1, saved_step)


@dataclass(frozen=True)
class Verdict:
    """What is to be done with a job.

    Attributes:
        transition: STOP, FAIL or REQUEUE.
        count: what its record says of failures from now on.
        wait: seconds before it may be taken again.
    """

    transition: Transition
    count: FailureCount
    wait: float = 0.0


@dataclass(frozen=True)
class RetryPolicy:
    """How often a job is tried.

    Attributes:
        max_attempts: in a row without progress.
        retry_seconds: wait after the first failure; each further one is twice as long, up to `MAX_RETRY_SECONDS`.
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
        """What to do after an attempt that failed, was lost or was released.

        Args:
            outcome: of the attempt.
            status: of the job while the attempt ran.
            count: before this attempt.
            saved_step: the farthest that was saved of the job; None for no step.
            permanent: another attempt would fail the same way.
        """
        if status == JobStatus.CANCELING:
            return Verdict(Transition.STOP, count)
        if outcome == AttemptOutcome.RELEASED:
            return Verdict(Transition.REQUEUE, count)
        count = count.with_failure(saved_step)
        if permanent or count.failures >= self.max_attempts:
            return Verdict(Transition.FAIL, count)
        # who was lost has been waited for already, for as long as a lease
        return Verdict(Transition.REQUEUE, count, 0.0 if outcome == AttemptOutcome.LOST else self._wait(count.failures))

    def after_outage(self, status: JobStatus, count: FailureCount, outages: int) -> Verdict:
        """What to do after an attempt that failed for a machine, a network or the store of files.

        That is no failure of the job: it is tried again, with longer and longer waits, until it goes or is canceled.

        Args:
            status: of the job while the attempt ran.
            count: before this attempt; it stays.
            outages: attempts in a row that ended so, this one included.
        """
        if status == JobStatus.CANCELING:
            return Verdict(Transition.STOP, count)
        return Verdict(Transition.REQUEUE, count, self._wait(outages))

    def _wait(self, times: int) -> float:
        return min(self.retry_seconds * 2.0 ** max(times - 1, 0), MAX_RETRY_SECONDS)
