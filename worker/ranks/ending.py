"""Ending ranks, whatever state they are in: a stopped process does not listen to Ray."""

from __future__ import annotations

import contextlib
from typing import Any

from worker.processes import ProcessId, home, kill
from worker.ranks.cluster import Cluster
from worker.ranks.rank import RankPlace
from worker.ranks.rank_group import RankGroup, RankHandle

#: Seconds for processes on other machines to end.
_REMOTE_SECONDS = 5.0


def end_ranks(group: RankGroup, cluster: Cluster) -> None:
    """End every rank of an attempt, and give its place back."""
    kill([rank.place.process for rank in group.handles if rank.place and rank.place.process.home == home()])
    if cluster.alive():
        # What cannot be reached any more cannot be ended either, and its own node's daemon does it.
        with contextlib.suppress(Exception):
            _end_remote(group)
    group.reservation = None


def end_rank(rank: RankHandle) -> None:
    """End one rank of this machine, and wait until what it held of a GPU is free."""
    import ray

    assert rank.place is not None
    ray.kill(rank.actor, no_restart=True)
    kill([rank.place.process])


def _end_remote(group: RankGroup) -> None:
    import ray

    for rank in group.handles:
        ray.kill(rank.actor, no_restart=True)
    if group.reservation is not None:
        group.reservation.release()
    places = [rank.place for rank in group.handles if rank.place and rank.place.process.home != home()]
    pending = [_kill_on(place).remote([place.process]) for place in places]
    if pending:
        ray.wait(pending, num_returns=len(pending), timeout=_REMOTE_SECONDS)


def _kill_on(place: RankPlace) -> Any:
    """A Ray task that ends processes on a rank's node."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def end(processes: list[ProcessId]) -> None:
        kill(processes)

    strategy = NodeAffinitySchedulingStrategy(place.node, soft=False)
    return ray.remote(end).options(num_cpus=0, max_retries=0, scheduling_strategy=strategy)
