"""What to do when an attempt at a job has failed: a pure function of what has happened so far.

Errors of the job itself would come again, and are raised at once. Whatever else ends an attempt is tried again, as long
as attempts come further: an error that comes twice at the same step is raised, and too many attempts in vain are given
up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sgsst_core.errors import RanksDriftedError, SgsstError

#: Attempts in a row that come no further than those before them.
MOST_ATTEMPTS = 3


@dataclass(frozen=True)
class Failure:
    """What ended an attempt.

    Attributes:
        kind: "job" for an error of the job itself; "loss" for ranks that died, fell silent or failed for a reason of
            their own.
        reason: in a few words, without full stop.
        error: that a rank raised; None where it had no time for one.
    """

    kind: Literal["job", "loss"]
    reason: str
    error: Exception | None = None


@dataclass(frozen=True)
class FailedAttempt:
    """An attempt that has failed.

    Attributes:
        failure: that ended it.
        last_step: that it made, or went on from.
        progressed: whether it made a step, or saved a checkpoint, beyond those of all attempts before.
    """

    failure: Failure
    last_step: int
    progressed: bool


@dataclass(frozen=True)
class TryAgain:
    """Start another attempt; `sentence` tells what has happened."""

    sentence: str


@dataclass(frozen=True)
class RaiseError:
    """End the job with an error as a rank raised it."""

    error: Exception


@dataclass(frozen=True)
class GiveUp:
    """End the job, because nothing is gained by another attempt; `sentence` tells why."""

    sentence: str


Decision = TryAgain | RaiseError | GiveUp


def failure_of(error: Exception, rank: str) -> Failure:
    """What an error that a rank raised means for the attempt.

    Args:
        rank: its name, for the reason.
    """
    if isinstance(error, SgsstError) and not isinstance(error, RanksDriftedError):
        return Failure("job", str(error), error)
    return Failure("loss", f"{rank} failed: {first_line(error)}", error)


def decide(attempts: Sequence[FailedAttempt]) -> Decision:
    """What to do after the last of these attempts.

    Args:
        attempts: all of the job, in their order; at least one.
    """
    last = attempts[-1]
    failure = last.failure
    if failure.kind == "job" and failure.error is not None:
        return RaiseError(failure.error)
    if failure.error is not None and not last.progressed and _came_again(attempts):
        if isinstance(failure.error, SgsstError | MemoryError | RuntimeError):
            return RaiseError(failure.error)
        return GiveUp(f"{failure.reason}; the same happened twice at step {last.last_step}.")
    in_vain = _in_vain(attempts)
    if in_vain >= MOST_ATTEMPTS:
        farthest = max(attempt.last_step for attempt in attempts)
        return GiveUp(
            f"{in_vain} attempts in a row came no further than step {farthest}. The last one: {failure.reason}."
        )
    return TryAgain(f"{failure.reason}, after step {last.last_step}.")


def _came_again(attempts: Sequence[FailedAttempt]) -> bool:
    """Whether the last two attempts ended at the same step for the same reason."""
    ends = [(attempt.failure.reason, attempt.last_step) for attempt in attempts[-2:]]
    return len(ends) == 2 and ends[0] == ends[1]


def _in_vain(attempts: Sequence[FailedAttempt]) -> int:
    """Attempts without progress since the last one that made some."""
    count = 0
    for attempt in reversed(attempts):
        if attempt.progressed:
            break
        count += 1
    return count


def first_line(error: BaseException) -> str:
    """An error in a few words, without full stop."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
