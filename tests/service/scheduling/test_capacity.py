"""Tests of how jobs share a machine's GPUs, with a real database and simulated machines."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.scheduling.capacity import Capacity, Grant, Machine
from service.scheduling.dispatcher import lease_next_job
from service.settings import ServiceSettings
from service.store.jobs import NewJob
from service.store.queue import OVERTAKEN_SECONDS
from service.store.tables import JobRow
from tests.stores import new_store

GB = 1_000_000_000
SHA = "a" * 64
#: Parameters of a job of several hours that is worth all GPUs of a machine.
LARGE = {"preset": "paper", "resolution": 5187}


def machine(gpus: int, **more: Any) -> Machine:
    return Machine(tuple(f"gpu{number}" for number in range(gpus)), 16, 100 * GB, **more)


class Queue:
    """Database with jobs, and the capacity of a simulated machine; no job runs."""

    def __init__(self, folder: Path, gpus: int, parallel_jobs: int | None = None) -> None:
        self.now = 1_000_000.0
        settings = ServiceSettings(data=folder)
        self.store = new_store(settings, lambda: self.now)
        self.store.inputs.add_blob(SHA, "aa/blob", 3)
        self.capacity = Capacity(machine(gpus), parallel_jobs)
        self.held: dict[str, Grant] = {}

    def add(self, owner: str = "local", priority: int = 0, **parameters: Any) -> str:
        self.now += 1
        scene = {"role": "scene", "name": "scene.ply", "sha256": SHA, "size": GB}
        parameters = LARGE | parameters
        return self.store.jobs.create(NewJob(owner, "", priority, parameters, [scene]), limit=100)[0].id

    def start(self) -> list[str]:
        """Start the jobs that fit, as the dispatcher does; return their ids in order."""
        started = []
        while (leased := lease_next_job("here", self.store, self.capacity, [*self.held.values()])) is not None:
            lease, grant = leased
            self.held[lease.job_id] = grant
            started.append(lease.job_id)
        taken = [gpu for grant in self.held.values() for gpu in grant.gpus]
        assert len(taken) == len(set(taken)), "a GPU was given to two jobs"
        return started

    def ranks(self) -> list[int]:
        assert all(len(grant.gpus) == grant.ranks for grant in self.held.values())
        return [grant.ranks for grant in self.held.values()]


@pytest.fixture
def eight(tmp_path: Path) -> Iterator[Queue]:
    queue = Queue(tmp_path, gpus=8)
    yield queue
    queue.store.close()


def test_single_job_gets_all_gpus(eight: Queue) -> None:
    big = eight.add()
    assert eight.start() == [big]
    assert eight.ranks() == [8]
    eight.add()
    assert eight.start() == []


@pytest.mark.parametrize(("jobs", "ranks"), [(2, [4, 4]), (3, [2, 3, 3]), (8, [1] * 8), (20, [1] * 8)])
def test_waiting_jobs_share_the_gpus(eight: Queue, jobs: int, ranks: list[int]) -> None:
    added = [eight.add() for _ in range(jobs)]
    assert eight.start() == added[:8]
    assert eight.ranks() == ranks


def test_small_job_gets_only_the_gpus_it_is_worth(eight: Queue) -> None:
    small = [eight.add(preset="preview") for _ in range(2)]
    large = eight.add()
    assert eight.start() == [*small, large]
    assert eight.ranks() == [1, 1, 6]


def test_requested_workers_are_granted(eight: Queue) -> None:
    for workers in (2, 5, 100):
        eight.add(workers=workers)
    eight.start()
    assert eight.ranks() == [2, 5]
    eight.held.clear()
    eight.start()
    assert eight.ranks() == [8], "no more than there are"


def test_large_job_is_overtaken_for_a_limited_time(eight: Queue) -> None:
    running = [eight.add("a", workers=1) for _ in range(7)]
    assert eight.start() == running
    big = eight.add("b", workers=8)
    small = [eight.add(owner, workers=1) for owner in "bc"]
    assert eight.start() == small[1:], "jobs of the same key do not overtake it"
    eight.now += OVERTAKEN_SECONDS
    eight.add("d", workers=1)
    for job_id in [*running, small[1]]:
        assert eight.start() == []
        del eight.held[job_id]
    urgent = eight.add("e", priority=1, workers=1)
    assert eight.start() == [urgent], "only a higher priority comes first"
    eight.held.clear()
    assert eight.start() == [big]


def test_owners_take_turns_regardless_of_granted_gpus(eight: Queue) -> None:
    alice = [eight.add("alice", workers=2) for _ in range(4)]
    bob = [eight.add("bob", workers=2) for _ in range(2)]
    assert eight.start() == [alice[0], bob[0], alice[1], bob[1]]


def test_dispatchers_share_the_queue(eight: Queue) -> None:
    for name in ("here", "there"):
        eight.store.operations.record_heartbeat(name, 8, 8)
    first, _ = eight.add(), eight.add()
    lease = lease_next_job("here", eight.store, eight.capacity, [])
    assert lease is not None
    assert (lease[0].job_id, lease[1].ranks) == (first, 8), "the other job is for the other dispatcher"


def test_number_of_jobs_is_limited_by_parallel_jobs(tmp_path: Path) -> None:
    queue = Queue(tmp_path, gpus=8, parallel_jobs=2)
    for _ in range(5):
        queue.add()
    queue.start()
    assert queue.ranks() == [4, 4]
    queue.store.close()


def test_gpu_jobs_wait_for_host_memory() -> None:
    capacity = Capacity(machine(8), None)
    alone = granted(capacity, job(200 * GB, workers=1), waiting=1)  # were it too big: it may try
    assert alone.host_bytes == 3 * GB + 400 * GB
    first = granted(capacity, job(5 * GB, workers=4))
    assert first.host_bytes == 4 * (3 * GB + 10 * GB)
    assert capacity.grant(job(15 * GB, workers=1), [first], 9) is None, "52 + 33 GB are more than four fifths of 100 GB"
    assert granted(capacity, job(10 * GB, workers=1), [first]).gpus == ("gpu4",)


@given(st.lists(st.tuples(st.integers(1, 60 * GB), st.integers(1, 8)), max_size=12))
def test_gpu_jobs_never_exceed_host_memory(jobs: list[tuple[int, int]]) -> None:
    held: list[Any] = []
    capacity = Capacity(machine(8), None)
    for scene, workers in jobs:
        grant = capacity.grant(job(scene, workers=workers), held, len(jobs))
        if grant is not None:
            held.append(grant)
    assert bool(held) == bool(jobs), "the first one always runs, were it too big"
    assert len(held) < 2 or sum(grant.host_bytes for grant in held) <= 80 * GB


def test_one_job_at_a_time_runs_without_gpus(tmp_path: Path) -> None:
    queue = Queue(tmp_path, gpus=0)
    first = queue.add()
    queue.add()
    assert queue.start() == [first]
    assert queue.held[first] == Grant(1), "and computes as `sgsst stylize` would"
    queue.held.clear()
    queue.add("other", priority=1, workers=2)
    queue.start()
    assert [grant.ranks for grant in queue.held.values()] == [2]
    queue.store.close()


def granted(capacity: Capacity, wanted: JobRow, held: Sequence[Grant] = (), waiting: int = 9) -> Grant:
    grant = capacity.grant(wanted, [*held], waiting)
    assert grant is not None
    return grant


def job(scene: int, **parameters: Any) -> JobRow:
    inputs = [{"role": "scene", "name": "s.ply", "size": scene}, {"role": "style", "size": 10**12}]
    return JobRow(id="job", parameters=parameters, inputs=inputs)


@pytest.mark.parametrize(
    ("parameters", "ranks"),
    [
        ({"preset": "preview"}, 1),
        ({"preset": "paper", "resolution": 5187}, 8),
        ({"resolution": 5187}, 1),
        ({"resolution": 5187, "scale_sampling": 1}, 3),
        ({"resolution": 5187, "precision": "float32"}, 3),
        ({"resolution": 5187, "precision": "float32", "within": 5}, 1),
        ({"preset": "paper", "resolution": 5187, "max_resolution": 64, "steps_sos": 7}, 1),
        ({"steps_sos": "many", "preset": "unknown", "resolution": "large", "bygone": 1}, 1),
    ],
)
def test_larger_jobs_get_more_gpus(parameters: dict[str, Any], ranks: int) -> None:
    assert granted(Capacity(machine(8), None), job(GB, **parameters), waiting=1).ranks == ranks


def test_gpus_do_not_depend_on_the_format() -> None:
    capacity = Capacity(machine(8), None)
    plain = granted(capacity, job(248_000_000, precision="float32"), waiting=1)
    for name, scene in (("s.compressed.ply", 61_000_000), ("s.SPZ", 25_000_000), ("s.splat", 32_000_000)):
        inputs = [{"role": "scene", "name": name, "size": scene}]
        packed = JobRow(id="job", parameters={"precision": "float32"}, inputs=inputs)
        assert granted(capacity, packed, waiting=1).ranks == plain.ranks


def test_memory_limit_of_a_single_job_is_at_most_its_fraction_of_the_machine() -> None:
    capacity = Capacity(machine(0), None)
    assert capacity.grant(job(GB, memory_limit=3 * GB), [], 1) == Grant(1, memory=3 * GB)
    assert capacity.grant(job(GB, memory_limit=1 << 50), [], 1) == Grant(1, memory=40 * GB)
    assert capacity.grant(job(GB), [], 1) == Grant(1)


def test_memory_of_a_cluster_is_not_packed() -> None:
    assert Capacity(machine(0, cluster=True), 4).grant(job(50 * GB, workers=3), [], 1) == Grant(3)


def test_slots_are_fractions_of_cores_and_memory() -> None:
    capacity = Capacity(machine(0), 4)
    small = granted(capacity, job(GB))
    assert (small.slots, small.threads, small.memory) == (1, 4, 20 * GB - 4 * GB)
    large = granted(capacity, job(8 * GB), [small])
    assert (large.slots, large.threads) == (2, 8)
    assert capacity.free([small, large]) == 1
    assert capacity.grant(job(8 * GB), [small, large], 9) is None, "two slots are needed, and one is free"
    asked = granted(capacity, job(GB, memory_limit=3 * GB), [small, large])
    assert (asked.slots, asked.memory) == (1, 3 * GB)
    assert capacity.grant(job(1), [small, large, asked], 9) is None


@given(
    st.integers(1, 9),
    st.lists(st.tuples(st.integers(1, 60 * GB), st.none() | st.integers(1, 200 * GB)), max_size=12),
)
def test_concurrent_cpu_jobs_never_exceed_host_memory(slots: int, jobs: list[tuple[int, int | None]]) -> None:
    held: list[Any] = []
    capacity, planned = Capacity(machine(0), slots), []
    for scene, limit in jobs:
        grant = capacity.grant(job(scene, memory_limit=limit), held, len(jobs))
        if grant is not None:
            held.append(grant)
            planned.append((grant.memory or 0) + 4 * scene)
    assert bool(held) == bool(jobs), "the first one always runs, were it too big"
    assert len(held) < 2 or sum(planned) <= 100 * GB


def test_machine_lists_its_own_gpus_or_those_of_the_cluster(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "4,GPU-1f")
    assert Machine.find(ServiceSettings()).gpus == ("4", "GPU-1f")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")
    assert Machine.find(ServiceSettings()).gpus == ()
    monkeypatch.setenv("RAY_ADDRESS", "head:6379")
    machine = Machine.find(ServiceSettings(cluster_gpus=3))
    assert (len(machine.gpus), machine.cluster) == (3, True)
