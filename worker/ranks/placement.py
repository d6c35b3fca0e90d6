"""Where ranks run: a place for each of them, reserved together, with its share of the machine."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from worker.ranks.host_memory import memory_beside_gpus

#: What Ray calls a machine by, in labels.
NODE_LABEL = "ray.io/node-id"
#: Seconds to wait for places that are taken; what lost ranks held is free again after a moment.
PLACE_SECONDS = 5.0


class NoRoomError(Exception):
    """There is not a single place."""


@dataclass(frozen=True)
class Reservation:
    """Places for ranks, each of which can be given back alone.

    Attributes:
        groups: Ray's placement group of each rank.
        threads: processor cores for each.
        gpus: for each, 0 or 1.
    """

    groups: tuple[Any, ...]
    threads: int
    gpus: int

    def actor_options(self) -> list[dict[str, Any]]:
        """Options of each rank's actor: dies once, and for good."""
        from ray.util.scheduling_strategies import PlacementGroupSchedulingStrategy

        return [
            {
                "num_cpus": self.threads,
                "num_gpus": self.gpus,
                "max_restarts": 0,
                "max_task_retries": 0,
                "max_concurrency": 2,
                "scheduling_strategy": PlacementGroupSchedulingStrategy(group, placement_group_bundle_index=0),
            }
            for group in self.groups
        ]

    def release(self) -> None:
        """Give all places back."""
        for group in self.groups:
            give_back(group)


def give_back(group: Any) -> None:
    """Give one place back; one that was given back before is no error."""
    from ray.util import remove_placement_group

    remove_placement_group(group)


def reserve(workers: int, scene: int = 0) -> Reservation:
    """Places for as many of the ranks as there is room for now.

    GPUs, where the cluster has any, are given out one for each rank, on as few machines as possible, with the memory of
    the machine that the rank takes; otherwise ranks are spread over the machines, and share the cores.

    Args:
        workers: ranks at most.
        scene: bytes of the job's scene once it is read.

    Raises:
        NoRoomError: for none.
    """
    nodes = _nodes()
    gpus = sum(int(node.get("GPU", 0)) for node in nodes)
    wanted = min(workers, gpus) if gpus else workers
    cores = [int(node.get("CPU", 0)) for node in nodes]
    threads = _threads(cores, wanted)
    wanted = min(wanted, sum(count // threads for count in cores))
    deadline = time.monotonic() + PLACE_SECONDS
    while wanted > 0:
        groups = _places(wanted, _bundle(nodes, wanted, threads, scene), deadline)
        if groups:
            return Reservation(groups, threads, 1 if gpus else 0)
        if threads > 1 and not gpus:  # other work may hold a part of the cores
            threads = 1
        else:
            wanted -= 1
    raise NoRoomError(f"Ray has no capacity for a worker, which needs {_told(_bundle(nodes, 1, threads, scene))}")


def _told(bundle: dict[str, int]) -> str:
    """What a place has, in words."""
    parts = [f"{bundle['CPU']} cores" if bundle["CPU"] > 1 else "a core"]
    parts += ["a GPU"] if "GPU" in bundle else []
    parts += [f"{bundle['memory'] / 1e9:.1f} GB of memory"] if "memory" in bundle else []
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if parts[1:] else parts)


def _nodes() -> list[dict[str, float]]:
    """The resources of every machine that is there."""
    import ray

    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def _threads(cores: list[int], ranks: int) -> int:
    """The most cores that each of so many ranks can have on these machines; at least one."""
    return max(
        (each for each in range(1, max(cores, default=1) + 1) if sum(count // each for count in cores) >= ranks),
        default=1,
    )


def _bundle(nodes: list[dict[str, float]], ranks: int, threads: int, scene: int) -> dict[str, int]:
    """What each of so many ranks asks Ray for."""
    with_gpus = [node for node in nodes if node.get("GPU")]
    if not with_gpus:
        return {"CPU": threads}
    sharing = min(ranks, max(int(node["GPU"]) for node in with_gpus))  # on few machines: they share the scene there
    # A job for which no machine has enough may try on one that nobody else is on.
    most = max(int(node.get("memory", 0)) for node in with_gpus)
    memory = min(memory_beside_gpus(sharing, scene), most) // sharing
    return {"CPU": threads, "GPU": 1, **({"memory": memory} if memory else {})}


def _places(ranks: int, bundle: dict[str, int], deadline: float) -> tuple[Any, ...]:
    """A placement group for each rank, once all are there; empty where that takes too long.

    Ray gives the bundles of a group back together only. So it is asked for all of them at once, which it puts where
    they belong together, and then for each alone on the machine that was found. Fewer are there where others were
    faster in between.
    """
    from ray.util import placement_group, placement_group_table

    together = placement_group([bundle] * ranks, strategy="PACK" if "GPU" in bundle else "SPREAD")
    found = together.wait(max(deadline - time.monotonic(), 1.0))
    nodes = dict(placement_group_table(together)["bundles_to_node_id"]) if found else {}
    give_back(together)
    alone = [placement_group([bundle], bundle_label_selector=[{NODE_LABEL: nodes[index]}]) for index in sorted(nodes)]
    there = []
    for group in alone:
        if group.wait(max(deadline - time.monotonic(), 1.0)):
            there.append(group)
        else:
            give_back(group)
    return tuple(there)
