"""Tests of the decision whether a failed attempt is repeated, without running processes."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import pytest

from sgsst_core.errors import ClusterAwayError, RanksDriftedError, RanksFailedError, SceneError
from worker.ranks.driver import MOST_ATTEMPTS, FailedAttempt, Failure, check_retry, failure_of, first_line

KILLED = Failure("loss", "Worker 1 on here was lost: its process was killed")


def failed(failure: Failure = KILLED, last_step: int = 0, *, progressed: bool = False) -> FailedAttempt:
    return FailedAttempt(failure, last_step, progressed)


def raised(error: Exception) -> Failure:
    return failure_of(error, "Worker 0 on here")


def test_job_error_is_raised_at_once() -> None:
    error = SceneError("scene.ply: is truncated.")
    for attempts in ([failed(raised(error))], [failed(), failed(raised(error), 7, progressed=True)]):
        with pytest.raises(SceneError) as info:
            check_retry(attempts)
        assert info.value is error


def test_drifted_ranks_are_retried() -> None:
    failure = raised(RanksDriftedError("Rank 1 has other colors."))
    assert failure.kind == "loss"
    assert check_retry([failed(failure, 5)]) == "Worker 0 on here failed: Rank 1 has other colors, after step 5."


@pytest.mark.parametrize("progressed", [True, False])
def test_first_lost_rank_is_retried(progressed: bool) -> None:
    expected = "Worker 1 on here was lost: its process was killed, after step 8."
    assert check_retry([failed(last_step=8, progressed=progressed)]) == expected


def test_lost_ranks_are_retried_while_attempts_progress() -> None:
    attempts = [failed(last_step=step, progressed=True) for step in range(0, 200, 10)]
    in_vain = [failed(last_step=190)] * (MOST_ATTEMPTS - 1)
    for more in ([], in_vain, [*in_vain, failed(last_step=200, progressed=True)]):
        assert check_retry([*attempts, *more])


@pytest.mark.parametrize(("kind", "error"), [("loss", RanksFailedError), ("machine", ClusterAwayError)])
def test_too_many_attempts_without_progress_give_up(kind: Literal["loss", "machine"], error: type[Exception]) -> None:
    attempts = [failed(last_step=30, progressed=True), *[failed(replace(KILLED, kind=kind), 20)] * MOST_ATTEMPTS]
    with pytest.raises(error) as info:
        check_retry(attempts)
    assert str(info.value) == (
        "3 attempts in a row came no further than step 30. The last one: Worker 1 on here was lost: its process was "
        "killed."
    )


def twice(error: Exception, second: Exception | None = None, steps: tuple[int, int] = (4, 4)) -> str:
    """Check two attempts that made no progress and ended with these errors."""
    return check_retry([failed(raised(error), steps[0]), failed(raised(second or error), steps[1])])


@pytest.mark.parametrize(
    "error", [RuntimeError("CUDA error"), MemoryError("can't allocate"), RanksDriftedError("Rank 1 drifted.")]
)
def test_repeated_error_at_same_step_is_raised(error: Exception) -> None:
    with pytest.raises(type(error)) as info:
        twice(error)
    assert info.value is error


def test_repeated_error_of_other_type_gives_up_with_a_sentence() -> None:
    with pytest.raises(RanksFailedError) as info:
        twice(KeyError("a"))
    assert str(info.value) == "Worker 0 on here failed: 'a'; the same happened twice at step 4."


def test_different_error_step_or_progress_is_retried() -> None:
    error = RuntimeError("CUDA error")
    assert twice(error, RuntimeError("NCCL error"))
    assert twice(error, steps=(4, 5))
    assert check_retry([failed(raised(error), 4, progressed=True)] * 2)


def test_lost_ranks_without_an_error_are_retried() -> None:
    assert check_retry([failed(), failed()])


def test_error_summary_is_first_line_or_type() -> None:
    assert first_line(RuntimeError("  It broke.\nAt length.")) == "It broke"
    assert first_line(RuntimeError()) == "RuntimeError"
