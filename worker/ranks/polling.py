"""Monitor of the ranks of an attempt: poll each rank, and find out which one is lost and why."""

from __future__ import annotations

import time
from typing import Any

from sgsst_core.errors import InfrastructureError
from worker.ranks.cluster import Cluster
from worker.ranks.failure_policy import Failure, failure_of, first_line
from worker.ranks.rank_group import AttemptFailedError, RankGroup, RankHandle

#: Seconds between two polls of a rank.
POLL_SECONDS = 0.25
#: Seconds to wait for a response that Ray reports as ready.
_FETCH_SECONDS = 60.0
#: Seconds to wait for the root cause after a rank has lost its connection to another rank.
_GRACE = 3.0


def poll_ranks(group: RankGroup) -> None:
    """Poll every rank, and store the responses that have arrived.

    Raises:
        AttemptFailedError: If the process of a rank has ended.
    """
    import ray

    now = time.monotonic()
    for rank in group.handles:
        if rank.pending_poll is None and not rank.left_out and now - rank.polled_at >= POLL_SECONDS:
            rank.pending_poll, rank.polled_at = rank.actor.poll.remote(), now
    polls = {rank.pending_poll: rank for rank in group.handles if rank.pending_poll is not None}
    if not polls:
        time.sleep(POLL_SECONDS / 4)
        return
    ready, _ = ray.wait(list(polls), num_returns=len(polls), timeout=POLL_SECONDS)
    for poll in ready:
        _take_answer(group, polls[poll], poll)


def _take_answer(group: RankGroup, rank: RankHandle, poll: Any) -> None:
    import ray

    rank.pending_poll = None
    try:
        rank.status = ray.get(poll, timeout=_FETCH_SECONDS)
        rank.answered_at = time.monotonic()
        if rank.left_out:
            group.on_left_out(rank)
    except ray.exceptions.ActorUnavailableError:  # may be temporary: the timeout decides
        return
    except ray.exceptions.ActorDiedError as error:
        raise _lost(f"{group.name_of(rank)} was lost: {_reason_of_death(error)}") from error
    except ray.exceptions.RayActorError as error:
        raise _lost(f"{group.name_of(rank)} was lost: {first_line(error)}") from error


def look_for_losses(group: RankGroup, cluster: Cluster, rank_timeout: float) -> None:
    """Raise an error with the root cause if a rank has failed or was lost.

    Args:
        group: Ranks of the attempt.
        cluster: Ray cluster that runs them.
        rank_timeout: Seconds without a response after which a rank counts as lost.

    Raises:
        AttemptFailedError: If a rank has failed or does not respond, or if Ray has ended.
    """
    _look_for_reasons(group, cluster)
    silent = max(group.handles, key=lambda rank: rank.silence)
    if silent.silence > rank_timeout:
        raise _silent(group, silent)
    failed = [rank for rank in group.handles if rank.outcome and rank.outcome.kind == "failed"]
    if failed:
        _wait_for_the_reason(group, cluster, failed[0])


def _wait_for_the_reason(group: RankGroup, cluster: Cluster, failed: RankHandle) -> None:
    """Wait for the cause of a rank's broken connection and raise it.

    A connection breaks when another rank ends, but it takes a moment until the driver knows which one.
    """
    started = time.monotonic()
    while time.monotonic() - started < _GRACE:
        poll_ranks(group)
        _look_for_reasons(group, cluster)
    silent = max(group.handles, key=lambda rank: rank.silence)
    if silent.silence > _GRACE:
        raise _silent(group, silent)
    assert failed.outcome is not None
    assert failed.outcome.error is not None
    error = failed.outcome.error
    raise _lost(f"{group.name_of(failed)} lost its connection: {first_line(error)}", error)


def _look_for_reasons(group: RankGroup, cluster: Cluster) -> None:
    """Raise an error if Ray has ended, or if a rank has failed for a reason other than the loss of another rank."""
    if not cluster.alive():
        raise _lost("Ray's own processes on this machine were lost")
    for rank in group.handles:
        outcome = rank.outcome
        if outcome is None or outcome.kind != "failed" or outcome.echo:
            continue
        assert outcome.error is not None
        failure = failure_of(outcome.error, group.name_of(rank))
        if failure.kind == "loss" or isinstance(outcome.error, InfrastructureError):
            outcome.error.add_note(f"{group.name_of(rank)}:\n{outcome.trace}")
        raise AttemptFailedError(failure)


def _silent(group: RankGroup, rank: RankHandle) -> AttemptFailedError:
    return _lost(f"{group.name_of(rank)} was lost: it has not answered for {rank.silence:.0f} s")


def _lost(reason: str, error: Exception | None = None) -> AttemptFailedError:
    return AttemptFailedError(Failure("loss", reason, error))


def _reason_of_death(error: Exception) -> str:
    """Return a short description of Ray's reason for the end of a rank's process."""
    text = " ".join(str(error).split())
    if "memory" in text.lower() and "low on memory" in text.lower():
        return "killed, because its machine had run out of memory"
    if "SIGKILL" in text or "Worker unexpectedly exits" in text or "connection error code" in text:
        return "its process was killed"
    if "node" in text.lower() and ("died" in text or "dead" in text):
        return "its machine is gone"
    return first_line(error)
