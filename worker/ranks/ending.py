"""Termination of ranks in any state, including suspended processes, which Ray alone cannot end."""

from __future__ import annotations

import contextlib
from typing import Any

from worker.processes import ProcessId, home, kill
from worker.ranks.cluster import Cluster
from worker.ranks.placement import give_back
from worker.ranks.rank import RankPlace
from worker.ranks.rank_group import RankGroup, RankHandle
from worker.workplace import Workplace

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


def end_rank(rank: RankHandle) -> None:
    """End one rank on any machine, wait until its GPU memory is free, and return its resources to Ray."""
    import ray

    assert rank.place is not None
    ray.kill(rank.actor, no_restart=True)
    if rank.place.process.home == home():
        kill([rank.place.process])
    else:
        ray.wait([_kill_on(rank.place).remote([rank.place.process], None)], timeout=_REMOTE_SECONDS)
    give_back(rank.group)


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
