"""Ranks of one attempt as the driver sees them: their state, and how to start, poll and end them."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from sgsst_core.errors import ClusterAwayError, InfrastructureError
from worker.processes import ProcessId, home, kill
from worker.ranks.cluster import Cluster, NoCapacityError, Reservation, reserve
from worker.ranks.failure_policy import Failure, failure_of, first_line
from worker.ranks.rank import Outcome, RankPlace, RankProcess, RankStatus, RankTask, Workplace


class AttemptFailedError(Exception):
    """Error if an attempt ends before its job is done."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.reason)
        self.failure = failure


@dataclass
class RankHandle:
    """Handle of one rank.

    Attributes:
        group: Ray placement group that the actor runs in.
        place: Location of the rank's process; None until the rank has reported it.
        pending_poll: Ray reference to the response to a pending poll; None if no poll is pending.
        polled_at, answered_at: Times of the last poll and the last response, in monotonic seconds.
        status: Latest status that the rank has returned.
    """

    actor: Any
    group: Any
    place: RankPlace | None = None
    pending_poll: Any = None
    polled_at: float = 0.0
    answered_at: float = field(default_factory=time.monotonic)
    status: RankStatus = field(default_factory=RankStatus)

    @property
    def outcome(self) -> Outcome | None:
        """Return the outcome of the rank; None while it runs."""
        return self.status.outcome

    @property
    def silence(self) -> float:
        """Return the seconds since the last response."""
        return time.monotonic() - self.answered_at


@dataclass
class RankGroup:
    """Ranks of one attempt, ordered by number.

    Attributes:
        handles: Handles of the ranks; empty until they are started.
        reservation: Reserved resources; None before the reservation and after its release.
    """

    handles: list[RankHandle] = field(default_factory=list)
    reservation: Reservation | None = None

    def name_of(self, rank: RankHandle) -> str:
        """Return the name of a rank for messages."""
        where = f" on {rank.place.host}" if rank.place else ""
        return f"Worker {self.handles.index(rank)}{where}"


#: Seconds that the processes of all ranks may take to start; eight at once share the cores of a busy machine.
START_SECONDS = 180.0

#: Function that creates the task of a rank from its number and the "host:port" of rank 0, once all ranks are started.
MakeTask = Callable[[int, str], RankTask]


def start_ranks(group: RankGroup, workers: int, scene: int, actor: type[RankProcess], make_task: MakeTask) -> None:
    """Start as many ranks as the cluster has resources for, and send each its task.

    Args:
        group: Empty group to fill. If an error is raised, it holds the ranks that were started.
        workers: Maximum number of ranks.
        scene: Bytes of the job's scene, for the host memory to reserve on machines with GPUs.
        actor: Class of the Ray actor that runs a rank.

    Raises:
        AttemptFailedError: If there are no free resources.
        RayError: If a process does not start in time.
    """
    import ray

    try:
        group.reservation = reserve(workers, scene)
    except NoCapacityError as error:
        raise AttemptFailedError(Failure("loss", str(error), ClusterAwayError(f"{error}."))) from error
    kind = ray.remote(actor)
    reserved = zip(group.reservation.actor_options(), group.reservation.groups, strict=True)
    group.handles = [RankHandle(kind.options(**options).remote(), place) for options, place in reserved]
    places = _from_all(group, "place")
    for rank, place in zip(group.handles, places, strict=True):
        rank.place = place
    group.handles = _numbered(group.handles, ray.get_runtime_context().get_node_id())
    address = _address(group.handles)
    _from_all(group, "start", [(make_task(number, address),) for number in range(len(group.handles))])
    for rank in group.handles:
        rank.answered_at = time.monotonic()


def _from_all(group: RankGroup, method: str, arguments: list[tuple[Any, ...]] | None = None) -> list[Any]:
    """Call a method of all ranks concurrently, and return the results."""
    import ray

    given = arguments or [()] * len(group.handles)
    calls = [getattr(rank.actor, method).remote(*own) for rank, own in zip(group.handles, given, strict=True)]
    return ray.get(calls, timeout=START_SECONDS)


def _numbered(handles: list[RankHandle], here: str) -> list[RankHandle]:
    """Return the ranks in the order of their numbers.

    Rank 0 writes the files, so it is a rank on the driver's machine if there is one. Ranks of one machine get
    consecutive numbers.
    """

    def order(rank: RankHandle) -> tuple[bool, str]:
        place = _place(rank)
        return place.node != here, place.node

    return sorted(handles, key=order)


def _address(handles: list[RankHandle]) -> str:
    """Make rank 0 listen, and return its "host:port"."""
    import ray

    alone = len({_place(rank).node for rank in handles}) == 1
    host = "127.0.0.1" if alone else _place(handles[0]).address
    return f"{host}:{ray.get(handles[0].actor.listen.remote(host), timeout=START_SECONDS)}"


def _place(rank: RankHandle) -> RankPlace:
    assert rank.place is not None  # all ranks report their location before they are numbered
    return rank.place


#: Seconds between two polls of a rank.
POLL_SECONDS = 0.25
#: Seconds to wait for a response that Ray reports as ready.
_FETCH_SECONDS = 60.0
#: Reason of a rank's death with its machine.
_MACHINE_GONE = "its machine is gone"
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
        if rank.pending_poll is None and now - rank.polled_at >= POLL_SECONDS:
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
    except ray.exceptions.ActorUnavailableError:  # may be temporary: the timeout decides
        return
    except ray.exceptions.ActorDiedError as error:
        reason = _reason_of_death(error)
        raise _lost(f"{group.name_of(rank)} was lost: {reason}", machine=reason == _MACHINE_GONE) from error
    except ray.exceptions.RayActorError as error:
        raise _lost(f"{group.name_of(rank)} was lost: {first_line(error)}") from error


def look_for_losses(group: RankGroup, cluster: Cluster, rank_timeout: float) -> None:
    """Raise an error with the root cause if a rank has failed or was lost.

    Args:
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


#: Seconds of waiting for others before the first step that are reported.
LONG_WAIT = 60.0


def long_wait(group: RankGroup) -> str | None:
    """Return a sentence about the ranks that wait long for others, and what these do; None if no rank waits long."""
    waiting = [rank for rank in group.handles if rank.status.waiting > LONG_WAIT]
    if not waiting:
        return None
    others = [rank for rank in group.handles if rank not in waiting and rank.outcome is None]
    doing = [
        f"{group.name_of(rank)} ({rank.status.progress.stage if rank.status.progress else 'reading'})"
        for rank in others
    ]
    names = ", ".join(map(group.name_of, waiting))
    return f"Waiting for more than {LONG_WAIT:.0f} s: {names}. " + (
        f"Still at work: {', '.join(doing)}."
        if others
        else "All wait for each other's messages: check the network between their machines."
    )


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
        raise _lost("Ray's own processes on this machine were lost", machine=True)
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
    remote = rank.place is not None and rank.place.process.home != home()
    return _lost(f"{group.name_of(rank)} was lost: it has not answered for {rank.silence:.0f} s", machine=remote)


def _lost(reason: str, error: Exception | None = None, *, machine: bool = False) -> AttemptFailedError:
    return AttemptFailedError(Failure("machine" if machine else "loss", reason, error))


def _reason_of_death(error: Exception) -> str:
    """Return a short description of Ray's reason for the end of a rank's process."""
    text = " ".join(str(error).split())
    if "memory" in text.lower() and "low on memory" in text.lower():
        return "killed, because its machine had run out of memory"
    if "SIGKILL" in text or "Worker unexpectedly exits" in text or "connection error code" in text:
        return "its process was killed"
    if "node" in text.lower() and ("died" in text or "dead" in text):
        return _MACHINE_GONE
    return first_line(error)


#: Seconds to wait for processes on other machines to end.
_REMOTE_SECONDS = 5.0


def end_ranks(group: RankGroup, cluster: Cluster, workplace: Workplace | None = None) -> None:
    """End all ranks of an attempt, release their resources, and delete the folders that they leave in a workplace."""
    kill([rank.place.process for rank in group.handles if rank.place and rank.place.process.home == home()])
    if cluster.alive():
        # If a rank cannot be reached, the Ray daemon of its node ends it.
        with contextlib.suppress(Exception):
            _end_remote(group, workplace)
    if workplace is not None:
        workplace.tidy()
    group.reservation = None


def _end_remote(group: RankGroup, workplace: Workplace | None) -> None:
    import ray

    for rank in group.handles:
        ray.kill(rank.actor, no_restart=True)
    if group.reservation is not None:
        group.reservation.release()
    places = [rank.place for rank in group.handles if rank.place and rank.place.process.home != home()]
    pending = [_kill_on(place).remote([place.process], workplace) for place in places]
    if pending:
        ray.wait(pending, num_returns=len(pending), timeout=_REMOTE_SECONDS)


def _kill_on(place: RankPlace) -> Any:
    """Return a Ray task that ends processes on the node of a rank."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def end(processes: list[ProcessId], workplace: Workplace | None) -> None:
        kill(processes)
        if workplace is not None:
            workplace.tidy()

    strategy = NodeAffinitySchedulingStrategy(place.node, soft=False)
    return ray.remote(end).options(num_cpus=0, max_retries=0, scheduling_strategy=strategy)
