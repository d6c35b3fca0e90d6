"""Tests that the query for the next job gives the same result as sorting all jobs, without reading all of them."""

from __future__ import annotations

import random

import pytest

from service.states import JobStatus
from service.store import Store
from service.store.queue import OVERTAKEN_SECONDS
from service.store.tables import JobRow
from tests.service.store.helpers import ATTEMPTS, LEASE, Clock, lease, queue


def sorted_queue(jobs: list[JobRow], served: dict[str, int], now: float) -> JobRow | None:
    """Return the next job by the reference algorithm, which sorts all jobs that may start."""
    ready = [job for job in jobs if job.status == JobStatus.QUEUED and job.not_before <= now]
    lost = [job for job in jobs if job.lease_expires_at is not None and job.lease_expires_at < now]
    ready += [job for job in lost if job.failures + 1 < ATTEMPTS]  # the others end when they are examined
    return min(ready, key=lambda job: (-job.priority, served.get(job.owner, 0), job.queued_at, job.id), default=None)


@pytest.mark.parametrize("seed", range(2))
def test_queue_order_equals_a_plain_sort(store: Store, clock: Clock, seed: int) -> None:
    chance = random.Random(seed)
    served: dict[str, int] = {}
    for turn in range(1, 40):
        clock.now += chance.choice([0, 1, LEASE / 4])
        for _ in range(chance.randrange(4)):
            queue(store, chance.choice("abcdef"), chance.choice([0, 0, 0, 1]))
        expected = sorted_queue([job.row for job in store.jobs.page(None, limit=1000)], served, clock.now)
        lease = store.leases.take("one")
        assert (lease and lease.job_id) == (expected and expected.id)
        if lease is None:
            continue
        served[lease.job.owner] = turn
        ending = chance.randrange(4)
        if ending == 0:
            store.leases.fail(lease, {"code": "infrastructure", "message": "x"}, permanent=False)
        elif ending == 1:
            store.leases.release(lease)
        elif ending == 2:
            store.leases.succeed(lease, [], {})  # in the fourth case the job is lost


def test_jobs_of_others_overtake_a_job_that_does_not_fit_for_a_while(store: Store, clock: Clock) -> None:
    big = queue(store, "a")
    small = []
    for owner in "bca":
        clock.now += 1
        small.append(queue(store, owner))

    def full(job: JobRow) -> bool:
        return job.id != big

    taken = [held.job_id for _ in range(3) if (held := store.leases.take("one", full))]
    assert taken == small[:2], "but not its owner's"
    clock.now += OVERTAKEN_SECONDS
    queue(store, "d")
    assert store.leases.take("two", full) is None
    assert lease(store, "one").job_id == big, "wherever it fits first"


def test_waiting_jobs_are_counted_up_to_a_maximum(store: Store, clock: Clock) -> None:
    for _ in range(5):
        queue(store)
    lease(store)
    assert (store.leases.waiting(), store.leases.waiting(3)) == (4, 3)
    clock.now += LEASE + 1
    assert (store.leases.waiting(), store.leases.waiting(3)) == (5, 3)
