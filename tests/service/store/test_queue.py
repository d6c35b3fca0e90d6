"""Tests that the query for the next job gives the same result as sorting all jobs, without reading all of them."""

from __future__ import annotations

import random

import pytest

from service.states import JobStatus
from service.store import Store
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


def test_reserving_dispatcher_takes_no_other_job(store: Store, clock: Clock) -> None:
    big = queue(store, "a")
    small = []
    for owner in "bca":
        clock.now += 1
        small.append(queue(store, owner))

    def full(job: JobRow) -> bool:
        return job.id != big

    assert store.leases.take("one", full) is None
    assert [held.job_id for _ in range(2) if (held := store.leases.take("two", full))] == small[:2]
    assert store.leases.take("one", full) is None, "it is kept, however often others were served"
    assert lease(store, "one").job_id == big
    assert lease(store, "one").job_id == small[2]


def test_job_without_a_reservation_is_skipped(store: Store, clock: Clock) -> None:
    big = queue(store, "a")
    clock.now += 1
    small = queue(store, "b")
    clock.now += 1
    lease = store.leases.take("one", lambda job: job.id == small, should_reserve=lambda job: False)
    assert lease is not None
    assert lease.job_id == small
    assert store.leases.take("one", lambda job: False, should_reserve=lambda job: False) is None
    queue(store, "c")
    assert store.leases.take("one", lambda job: job.id != big) is None, "and now it is kept"


def test_harmless_jobs_run_before_the_reserved_job(store: Store, clock: Clock) -> None:
    big = queue(store, "a", priority=1)
    others = []
    for owner in "bcbd":
        clock.now += 1
        others.append(queue(store, owner))

    def full(job: JobRow) -> bool:
        return job.id != big

    def before(job: JobRow) -> bool:
        return job.id != others[1]

    taken = [held.job_id for _ in range(4) if (held := store.leases.take("one", full, backfills=before))]
    assert taken == [others[0], others[3], others[2]], "in turns, but for the one that is in the way"
    leased = store.leases.take("two", full, backfills=before)
    assert leased is not None
    assert leased.job_id == others[1], "only the first dispatcher has a reservation"
    assert store.leases.take("two", full, backfills=before) is None
    assert lease(store, "one").job_id == big


def test_reserved_job_runs_where_it_fits_first(store: Store) -> None:
    big = queue(store)
    assert store.leases.take("one", lambda job: False) is None
    assert lease(store, "two").job_id == big
    other = queue(store)
    assert lease(store, "one").job_id == other, "and nothing is kept any more"


def test_reservation_of_a_dead_dispatcher_expires(store: Store, clock: Clock) -> None:
    big = queue(store, "a")
    clock.now += 1
    small = queue(store, "b")
    clock.now += 1
    queue(store, "b")

    def full(job: JobRow) -> bool:
        return job.id != big

    assert store.leases.take("dead", full) is None
    lease = store.leases.take("two", full)
    assert lease is not None
    assert lease.job_id == small
    clock.now += LEASE + 1
    assert store.leases.take("two", full) is None, "it keeps its own room from now on"
    lease = store.leases.take("three", full)
    assert lease is not None


def test_higher_priority_runs_before_the_reserved_job(store: Store, clock: Clock) -> None:
    big = queue(store)
    assert store.leases.take("one", lambda job: False) is None
    urgent = queue(store, "b", priority=1)
    assert lease(store, "one").job_id == urgent
    assert lease(store, "one").job_id == big


def test_waiting_jobs_are_counted_up_to_a_maximum(store: Store, clock: Clock) -> None:
    for _ in range(5):
        queue(store)
    lease(store)
    assert (store.leases.waiting(), store.leases.waiting(3)) == (4, 3)
    clock.now += LEASE + 1
    assert (store.leases.waiting(), store.leases.waiting(3)) == (5, 3)
