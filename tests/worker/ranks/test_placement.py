"""Tests of the resources that ranks request from Ray: a GPU and host memory, or only CPU cores."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from worker.job import memory_beside_gpus, scene_bytes
from worker.ranks.cluster import Cluster, NoCapacityError, _bundle, reserve

GB = 1_000_000_000


def test_scene_memory_is_its_decompressed_size() -> None:
    assert scene_bytes("room.ply", GB) == GB
    assert scene_bytes("ROOM.SPZ", 25_000_000) == 248_000_000
    assert scene_bytes("room.compressed.ply", 61_000_000) == 248_000_000
    assert memory_beside_gpus(4, 5 * GB) == 22 * GB, "ranks of a machine share the scene"


def test_ranks_of_a_machine_request_memory_for_a_shared_scene() -> None:
    nodes = [{"CPU": 32.0, "GPU": 4.0, "memory": 100.0 * GB}, {"CPU": 64.0, "memory": 500.0 * GB}]
    assert _bundle(nodes, 1, 8, 5 * GB) == {"CPU": 8, "GPU": 1, "memory": 13 * GB}
    assert _bundle(nodes, 2, 8, 5 * GB) == {"CPU": 8, "GPU": 1, "memory": 8 * GB}
    assert _bundle([*nodes, nodes[0]], 8, 8, 5 * GB)["memory"] == 5.5 * GB, "four on each machine"


def test_oversized_scene_requests_a_whole_machines_memory() -> None:
    nodes = [{"CPU": 32.0, "GPU": 4.0, "memory": 100.0 * GB}]
    assert _bundle(nodes, 1, 8, 200 * GB)["memory"] == 100 * GB
    assert _bundle(nodes, 4, 8, 200 * GB)["memory"] == 25 * GB


def test_only_cores_are_requested_without_gpus() -> None:
    """Without GPUs, plans already limit their memory to a fraction of the machine's, so only cores are requested."""
    assert _bundle([{"CPU": 32.0, "memory": 100.0 * GB}], 2, 8, 5 * GB) == {"CPU": 8}
    assert _bundle([{"CPU": 32.0, "GPU": 4.0}], 2, 8, 5 * GB) == {"CPU": 8, "GPU": 1}, "Ray knows of no memory"


@contextmanager
def taken(memory: int) -> Iterator[None]:
    """Reserve memory of the cluster within the block, as another job would."""
    from ray.util import placement_group, remove_placement_group

    group = placement_group([{"memory": memory}])
    assert group.wait(120)
    yield
    remove_placement_group(group)


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends processes with their parent")
@pytest.mark.usefixtures("joined")
def test_ray_grants_no_gpus_without_free_memory() -> None:
    """The cluster has two GPUs and 10 GB; a scene of 2 GB needs 10 GB with two ranks and 7 GB with one."""
    with Cluster(2):
        reserved = reserve(2, 2 * GB)
        assert len(reserved.groups) == 2
        reserved.release()
        with taken(3 * GB):
            fewer = reserve(2, 2 * GB)
            assert (len(fewer.groups), fewer.gpus) == (1, 1)
            fewer.release()
        with taken(4 * GB), pytest.raises(NoCapacityError, match=r"needs a core, a GPU and 7\.0 GB of memory"):
            reserve(2, 2 * GB)
        again = reserve(2, 2 * GB)
        assert len(again.groups) == 2, "what was waited for in vain is not asked for any more"
        again.release()
