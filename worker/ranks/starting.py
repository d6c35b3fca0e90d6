"""Startup of an attempt's ranks: reserve resources, start an actor per rank, number the ranks and send their tasks."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sgsst_core.errors import ClusterAwayError
from worker.ranks.failure_policy import Failure
from worker.ranks.placement import NoRoomError, reserve
from worker.ranks.rank import RankPlace, RankProcess, RankTask
from worker.ranks.rank_group import AttemptFailedError, RankGroup, RankHandle

#: Seconds that the process of a rank may take to start.
START_SECONDS = 60.0

#: Function that creates the task of a rank from its number and the "host:port" of rank 0, once all ranks are started.
MakeTask = Callable[[int, str], RankTask]


def start_ranks(group: RankGroup, workers: int, scene: int, actor: type[RankProcess], make_task: MakeTask) -> None:
    """Start as many ranks as the cluster has resources for, and send each its task.

    Args:
        group: Empty group to fill. If an error is raised, it holds the ranks that were started.
        workers: Maximum number of ranks.
        scene: Bytes of the job's scene, for the host memory to reserve on machines with GPUs.
        actor: Class of the Ray actor that runs a rank.
        make_task: Function that creates the task of a rank.

    Raises:
        AttemptFailedError: If there are no free resources.
        RayError: If a process does not start in time.
    """
    import ray

    try:
        group.reservation = reserve(workers, scene)
    except NoRoomError as error:
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
