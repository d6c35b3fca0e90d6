"""Policy after a failed attempt: start another one, raise an error, or give up.

An error of the job itself would occur again, so it is raised at once. After any other failure the job is tried again,
as long as attempts make progress. An error that occurs twice at the same step is raised, and the policy gives up after
several attempts in a row without progress.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from sgsst_core.errors import RanksDriftedError, SgsstError

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
    """Outcome of a failed attempt, for `decide`.

    Attributes:
        failure: Cause of the failure.
        last_step: Last completed step, or the step that the attempt started from.
        progressed: Whether the attempt completed a step or saved a checkpoint that no earlier attempt had reached.
    """

    failure: Failure
    last_step: int
    progressed: bool


@dataclass(frozen=True)
class TryAgain:
    """Decision to start another attempt; `sentence` describes the failure."""

    sentence: str


@dataclass(frozen=True)
class RaiseError:
    """Decision to end the job with the error that a rank raised."""

    error: Exception


@dataclass(frozen=True)
class GiveUp:
    """Decision to end the job because another attempt is unlikely to help; `sentence` states the reason.

    The job is not to blame (`outage`) if a machine, the network or Ray has failed.
    """

    sentence: str
    outage: bool = False


Decision = TryAgain | RaiseError | GiveUp


def failure_of(error: Exception, rank: str) -> Failure:
    """Classify an error that a rank raised.

    Args:
        error: Error of the rank.
        rank: Name of the rank, for the reason.
    """
    if isinstance(error, SgsstError) and not isinstance(error, RanksDriftedError):
        return Failure("job", str(error), error)
    return Failure("loss", f"{rank} failed: {first_line(error)}", error)


def decide(attempts: Sequence[FailedAttempt]) -> Decision:
    """Decide how to continue after the last of these attempts.

    Args:
        attempts: All failed attempts of the job in order; at least one.
    """
    last = attempts[-1]
    failure = last.failure
    if failure.kind == "job" and failure.error is not None:
        return RaiseError(failure.error)
    if failure.error is not None and not last.progressed and _came_again(attempts):
        if isinstance(failure.error, SgsstError | MemoryError | RuntimeError):
            return RaiseError(failure.error)
        sentence = f"{failure.reason}; the same happened twice at step {last.last_step}."
        return GiveUp(sentence, failure.kind == "machine")
    in_vain = _in_vain(attempts)
    if in_vain >= MOST_ATTEMPTS:
        farthest = max(attempt.last_step for attempt in attempts)
        return GiveUp(
            f"{in_vain} attempts in a row came no further than step {farthest}. The last one: {failure.reason}.",
            failure.kind == "machine",
        )
    return TryAgain(f"{failure.reason}, after step {last.last_step}.")


def _came_again(attempts: Sequence[FailedAttempt]) -> bool:
    """Return whether the last two attempts ended at the same step for the same reason."""
    ends = [(attempt.failure.reason, attempt.last_step) for attempt in attempts[-2:]]
    return len(ends) == 2 and ends[0] == ends[1]


def _in_vain(attempts: Sequence[FailedAttempt]) -> int:
    """Count the attempts since the last one that made progress."""
    count = 0
    for attempt in reversed(attempts):
        if attempt.progressed:
            break
        count += 1
    return count


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message without its full stop, or the error's type if it has no message."""
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__
