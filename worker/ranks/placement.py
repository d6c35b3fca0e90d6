"""Reservation of cores, GPUs and memory for the ranks of a job, as Ray placement groups."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from worker.ranks.host_memory import memory_beside_gpus

#: Label of a Ray node that holds its ID.
NODE_LABEL = "ray.io/node-id"
#: Seconds to wait for resources in use. Those of lost ranks are soon free again.
PLACE_SECONDS = 5.0


class NoRoomError(Exception):
    """Error if the cluster has no free resources even for one rank."""


@dataclass(frozen=True)
class Reservation:
    """Resources for ranks; those of each rank can be released individually.

    Attributes:
        groups: Ray placement group of each rank.
        threads: Processor cores per rank.
        gpus: GPUs per rank, 0 or 1.
    """

    groups: tuple[Any, ...]
    threads: int
    gpus: int

    def actor_options(self) -> list[dict[str, Any]]:
        """Return the options of each rank's actor. Ray must not restart an actor that died."""
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
        """Release all resources."""
        for group in self.groups:
            give_back(group)


def give_back(group: Any) -> None:
    """Release a placement group. Releasing it twice is not an error."""
    from ray.util import remove_placement_group

    remove_placement_group(group)


def reserve(workers: int, scene: int = 0) -> Reservation:
    """Reserve resources for as many ranks as the cluster can run now.

    If the cluster has GPUs, every rank gets one, together with the host memory that it needs, on as few machines as
    possible. Otherwise ranks are spread over the machines, and the cores are divided among them.

    Args:
        workers: Maximum number of ranks.
        scene: Bytes of the job's scene in memory.

    Raises:
        NoRoomError: If there are no free resources even for one rank.
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
        if threads > 1 and not gpus:  # other jobs may use some of the cores
            threads = 1
        else:
            wanted -= 1
    raise NoRoomError(f"Ray has no capacity for a worker, which needs {_told(_bundle(nodes, 1, threads, scene))}")


def _told(bundle: dict[str, int]) -> str:
    """Describe the resources of a rank in words."""
    parts = [f"{bundle['CPU']} cores" if bundle["CPU"] > 1 else "a core"]
    parts += ["a GPU"] if "GPU" in bundle else []
    parts += [f"{bundle['memory'] / 1e9:.1f} GB of memory"] if "memory" in bundle else []
    return " and ".join([", ".join(parts[:-1]), parts[-1]] if parts[1:] else parts)


def _nodes() -> list[dict[str, float]]:
    """Return the resources of every machine of the cluster."""
    import ray

    return [node["Resources"] for node in ray.nodes() if node["Alive"]]


def _threads(cores: list[int], ranks: int) -> int:
    """Return the largest number of cores that each of `ranks` ranks can have on these machines; at least one."""
    return max(
        (each for each in range(1, max(cores, default=1) + 1) if sum(count // each for count in cores) >= ranks),
        default=1,
    )


def _bundle(nodes: list[dict[str, float]], ranks: int, threads: int, scene: int) -> dict[str, int]:
    """Return the Ray resources of each of `ranks` ranks."""
    with_gpus = [node for node in nodes if node.get("GPU")]
    if not with_gpus:
        return {"CPU": threads}
    sharing = min(ranks, max(int(node["GPU"]) for node in with_gpus))  # ranks of a machine share the scene
    # A job that needs more memory than any machine has gets all of the largest machine's, and may still succeed there.
    most = max(int(node.get("memory", 0)) for node in with_gpus)
    memory = min(memory_beside_gpus(sharing, scene), most) // sharing
    return {"CPU": threads, "GPU": 1, **({"memory": memory} if memory else {})}


def _places(ranks: int, bundle: dict[str, int], deadline: float) -> tuple[Any, ...]:
    """Return a placement group for each rank; empty if the resources are not free before the deadline.

    Ray can only release all bundles of a placement group together. Therefore one group for all ranks is created first,
    to choose the machines, and is then replaced by one group per rank on the same machines. Other jobs may take
    resources in between, so there may be fewer groups than ranks.
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
