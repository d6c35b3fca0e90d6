"""Policy after a failed attempt: start another one, raise an error, or give up.

An error of the job itself would occur again, so it is raised at once. After any other failure the job is tried again,
as long as attempts make progress. An error that occurs twice at the same step is raised, and the policy gives up after
several attempts in a row without progress.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Literal

from sgsst_core.errors import ClusterAwayError, RanksDriftedError, RanksFailedError, SgsstError

#: Maximum number of attempts in a row without progress.
MOST_ATTEMPTS = 3


@dataclass(frozen=True)
class Failure:
    """Cause of a failed attempt.

    Attributes:
        kind: "job" for an error of the job itself; "machine" for ranks that were lost with their machine, the network
            or Ray; "loss" for ranks that died or failed for another reason.
        reason: Short description without a full stop.
        error: Error that a rank raised; None if it died before it raised.
    """

    kind: Literal["job", "loss", "machine"]
    reason: str
    error: Exception | None = None


@dataclass(frozen=True)
class FailedAttempt:
    """Outcome of a failed attempt, for `check_retry`.

    Attributes:
        last_step: Last completed step, or the step that the attempt started from.
        progressed: Whether the attempt completed a step or saved a checkpoint that no earlier attempt had reached.
    """

    failure: Failure
    last_step: int
    progressed: bool


def failure_of(error: Exception, rank: str) -> Failure:
    """Classify an error that a rank raised."""
    if isinstance(error, SgsstError) and not isinstance(error, RanksDriftedError):
        return Failure("job", str(error), error)
    return Failure("loss", f"{rank} failed: {first_line(error)}", error)


def check_retry(attempts: Sequence[FailedAttempt]) -> str:
    """Return a sentence about the last of these attempts if another one may help.

    Args:
        attempts: All failed attempts of the job in order; at least one.

    Raises:
        Exception: Error that a rank raised, if it is one of the job itself or occurred twice at the same step.
        RanksFailedError: If another attempt is unlikely to help.
        ClusterAwayError: If it is unlikely to help because of a machine, the network or Ray.
    """
    last = attempts[-1]
    failure = last.failure
    give_up = ClusterAwayError if failure.kind == "machine" else RanksFailedError
    if failure.kind == "job" and failure.error is not None:
        raise failure.error
    ends = [(attempt.failure.reason, attempt.last_step) for attempt in attempts[-2:]]
    if failure.error is not None and not last.progressed and len(ends) == 2 and ends[0] == ends[1]:
        if isinstance(failure.error, SgsstError | MemoryError | RuntimeError):
            raise failure.error
        raise give_up(f"{failure.reason}; the same happened twice at step {last.last_step}.") from failure.error
    in_vain = len(list(takewhile(lambda attempt: not attempt.progressed, reversed(attempts))))
    if in_vain >= MOST_ATTEMPTS:
        farthest = max(attempt.last_step for attempt in attempts)
        raise give_up(
            f"{in_vain} attempts in a row came no further than step {farthest}. The last one: {failure.reason}."
        ) from failure.error
    return f"{failure.reason}, after step {last.last_step}."


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message without its full stop, or the error's type if it has no message."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
