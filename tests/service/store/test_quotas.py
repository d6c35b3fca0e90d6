"""What keys may use: counted exactly, refused before it is too much, and given back."""

from __future__ import annotations

import pytest

from service.errors import QuotaError
from service.settings import ServiceSettings
from service.store import Store
from service.store.leases import Published
from service.store.quotas import NO_QUOTAS, Quotas, Used
from tests.service.store.helpers import LEASE, SHA, Clock, lease, new_job, queue

DAY = 86_400.0


def submit(store: Store, quotas: Quotas, owner: str = "local") -> str:
    return store.jobs.create(new_job(owner), limit=100, quotas=quotas)[0].id


def refusal(store: Store, quotas: Quotas, owner: str = "local") -> dict[str, object]:
    with pytest.raises(QuotaError) as caught:
        submit(store, quotas, owner)
    return caught.value.extra


def test_jobs_of_a_day(store: Store, clock: Clock) -> None:
    clock.now = 100 * DAY + 80_000
    quotas = Quotas(jobs_a_day=2)
    first = submit(store, quotas)
    submit(store, quotas)
    assert refusal(store, quotas) == {"quota": "jobs-a-day", "limit": 2, "retry_after": 6400}
    assert len(store.jobs.page("local")) == store.usage.of("local").jobs == 2, "nothing of it stays"
    submit(store, quotas, "other")
    store.jobs.cancel(first, "local")
    assert refusal(store, quotas)["quota"] == "jobs-a-day", "it was one of today's"
    clock.now += 6400
    submit(store, quotas)


def test_gpu_seconds_are_those_that_were_held(store: Store, clock: Clock) -> None:
    quotas = Quotas(gpu_seconds_a_day=100)
    submit(store, quotas)
    held = lease(store)
    store.leases.hold_gpus(held, 8)
    clock.now += 10
    store.leases.hold_gpus(held, 2)
    assert store.usage.of("local").gpu_seconds == 80
    submit(store, quotas)
    clock.now += 15
    store.leases.succeed(held, [], {})
    assert store.usage.of("local").gpu_seconds == 110
    assert refusal(store, quotas)["quota"] == "gpu-seconds-a-day"
    assert lease(store).job.owner == "local", "what was accepted runs"
    clock.now += DAY
    submit(store, quotas)


@pytest.mark.parametrize("ending", ["fail", "release", "stop"])
def test_every_end_of_an_attempt_counts(store: Store, clock: Clock, ending: str) -> None:
    queue(store)
    held = lease(store)
    store.leases.hold_gpus(held, 3)
    clock.now += 5
    if ending == "fail":
        store.leases.fail(held, {"code": "x", "message": "x"}, permanent=False)
    else:
        getattr(store.leases, ending)(held)
    assert store.usage.of("local").gpu_seconds == 15


def test_a_machine_that_died_is_not_its_users_doing(store: Store, clock: Clock) -> None:
    queue(store)
    store.leases.hold_gpus(lease(store), 8)
    clock.now += LEASE + 1
    lease(store, "two")
    assert store.usage.of("local").gpu_seconds == 0


def test_bytes_are_of_uploads_inputs_and_results(store: Store, clock: Clock) -> None:
    """An input of three bytes counts once, however many jobs have it."""
    quotas = Quotas(stored_bytes=10)
    job_id = submit(store, quotas)
    clock.now += 1  # jobs of the same moment are in any order
    submit(store, quotas)
    assert store.usage.of("local") == Used(2, 0, 3)
    store.inputs.create_upload("local", 5, "x", "", 1000, quotas=quotas)
    with pytest.raises(QuotaError) as caught:
        store.inputs.create_upload("local", 3, "x", "", 1000, quotas=quotas)
    assert caught.value.extra["quota"] == "stored-bytes"
    assert caught.value.extra["retry_after"]
    assert store.usage.of("local").stored_bytes == 8
    held = lease(store)
    store.leases.succeed(held, [Published("stylized.ply", "x/1", 4, SHA)], {})
    assert store.usage.of("local").stored_bytes == 12
    assert refusal(store, quotas)["quota"] == "stored-bytes"
    assert held.job_id == job_id
    store.jobs.delete(job_id, "local")
    submit(store, quotas)


def test_an_upload_that_has_become_an_input_counts_once(store: Store) -> None:
    row = store.inputs.create_upload("local", 3, "scene.ply", "", 1000)
    store.inputs.finish_upload(row.id, SHA, 1000)
    queue(store)
    assert store.usage.of("local").stored_bytes == 3


def test_a_keys_own_quotas_go_before_the_services() -> None:
    settings = ServiceSettings(max_jobs_a_day_per_key=5, max_bytes_per_key=7)
    service = Quotas.of_settings(settings)
    assert service == Quotas(5, None, 7, None)
    assert service.with_own({"jobs_a_day": 9, "of_another_version": 1}) == Quotas(9, None, 7, None)
    assert service.with_own(None) == service


def test_keys_keep_their_quotas(store: Store) -> None:
    quotas = Quotas(jobs_a_day=3, requests_a_second=0.5)
    _, text = store.keys.create("alice", quotas=quotas)
    _, plain = store.keys.create("bob")
    found, other = store.keys.find(text), store.keys.find(plain)
    assert found is not None
    assert other is not None
    assert NO_QUOTAS.with_own(found.quotas) == quotas
    assert NO_QUOTAS.with_own(other.quotas) == NO_QUOTAS
