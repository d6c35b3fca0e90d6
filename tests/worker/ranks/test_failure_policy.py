"""Tests of the decision whether a failed attempt is repeated, without running processes."""

from __future__ import annotations

import pytest

from sgsst_core.errors import RanksDriftedError, SceneError
from worker.ranks.failure_policy import (
    MOST_ATTEMPTS,
    Decision,
    FailedAttempt,
    Failure,
    GiveUp,
    RaiseError,
    TryAgain,
    decide,
    failure_of,
    first_line,
)

KILLED = Failure("loss", "Worker 1 on here was lost: its process was killed")


def failed(failure: Failure = KILLED, last_step: int = 0, *, progressed: bool = False) -> FailedAttempt:
    return FailedAttempt(failure, last_step, progressed)


def raised(error: Exception) -> Failure:
    return failure_of(error, "Worker 0 on here")


def test_job_error_is_raised_at_once() -> None:
    error = SceneError("scene.ply: is truncated.")
    assert decide([failed(raised(error))]) == RaiseError(error)
    assert decide([failed(), failed(raised(error), 7, progressed=True)]) == RaiseError(error)


def test_drifted_ranks_are_retried() -> None:
    failure = raised(RanksDriftedError("Rank 1 has other colors."))
    assert failure.kind == "loss"
    assert decide([failed(failure, 5)]) == TryAgain("Worker 0 on here failed: Rank 1 has other colors, after step 5.")


@pytest.mark.parametrize("progressed", [True, False])
def test_first_lost_rank_is_retried(progressed: bool) -> None:
    expected = TryAgain("Worker 1 on here was lost: its process was killed, after step 8.")
    assert decide([failed(last_step=8, progressed=progressed)]) == expected


def test_lost_ranks_are_retried_while_attempts_progress() -> None:
    attempts = [failed(last_step=step, progressed=True) for step in range(0, 200, 10)]
    assert isinstance(decide(attempts), TryAgain)
    in_vain = [failed(last_step=190)] * (MOST_ATTEMPTS - 1)
    assert isinstance(decide([*attempts, *in_vain]), TryAgain)
    assert isinstance(decide([*attempts, *in_vain, failed(last_step=200, progressed=True)]), TryAgain)


def test_too_many_attempts_without_progress_give_up() -> None:
    decision = decide([failed(last_step=30, progressed=True), *[failed(last_step=20)] * MOST_ATTEMPTS])
    assert decision == GiveUp(
        "3 attempts in a row came no further than step 30. The last one: Worker 1 on here was lost: its process was "
        "killed."
    )


def twice(error: Exception, second: Exception | None = None, steps: tuple[int, int] = (4, 4)) -> Decision:
    """Return the decision after two attempts that made no progress and ended with these errors."""
    return decide([failed(raised(error), steps[0]), failed(raised(second or error), steps[1])])


@pytest.mark.parametrize(
    "error", [RuntimeError("CUDA error"), MemoryError("can't allocate"), RanksDriftedError("Rank 1 drifted.")]
)
def test_repeated_error_at_same_step_is_raised(error: Exception) -> None:
    assert twice(error) == RaiseError(error)


def test_repeated_error_of_other_type_gives_up_with_a_sentence() -> None:
    assert twice(KeyError("a")) == GiveUp("Worker 0 on here failed: 'a'; the same happened twice at step 4.")


def test_different_error_step_or_progress_is_retried() -> None:
    error = RuntimeError("CUDA error")
    assert isinstance(twice(error, RuntimeError("NCCL error")), TryAgain)
    assert isinstance(twice(error, steps=(4, 5)), TryAgain)
    attempts = [failed(raised(error), 4, progressed=True), failed(raised(error), 4, progressed=True)]
    assert isinstance(decide(attempts), TryAgain)


def test_lost_ranks_without_an_error_are_retried() -> None:
    assert isinstance(decide([failed(), failed()]), TryAgain)


def test_error_summary_is_first_line_or_type() -> None:
    assert first_line(RuntimeError("  It broke.\nAt length.")) == "It broke"
    assert first_line(RuntimeError()) == "RuntimeError"
