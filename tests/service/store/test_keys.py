"""Tests of API key quotas: usage is counted exactly, requests beyond a limit are refused, and usage is released."""

from datetime import date

import pytest

from service import problems
from service.problems import NotFoundError, ServiceError
from service.states import Published
from service.store import Store
from service.store.files import GRACE_SECONDS
from service.store.keys import NO_QUOTAS, Quotas
from tests.raised import raises_problem
from tests.service.store.helpers import LEASE, SHA, Clock, Used, at_once, lease, new_job, queue, usage_of

DAY = 86_400.0


def submit(store: Store, quotas: Quotas, owner: str = "local") -> str:
    return store.jobs.create(new_job(owner), limit=100, quotas=quotas)[0].id


def refusal(store: Store, quotas: Quotas, owner: str = "local") -> ServiceError:
    with raises_problem(problems.QUOTA_EXCEEDED) as caught:
        submit(store, quotas, owner)
    return caught.value


def test_daily_jobs_are_limited(store: Store, clock: Clock) -> None:
    clock.now = 100 * DAY + 80_000
    quotas = Quotas(jobs_a_day=2)
    first = submit(store, quotas)
    submit(store, quotas)
    error = refusal(store, quotas)
    assert (error.extra, error.retry_after) == ({"quota": "jobs-a-day", "limit": 2}, 6400)
    assert len(store.jobs.page("local")) == usage_of(store, "local").jobs == 2, "nothing of it stays"
    submit(store, quotas, "other")
    store.jobs.cancel(first, "local")
    assert refusal(store, quotas).extra["quota"] == "jobs-a-day", "it was one of today's"
    clock.now += 6400
    submit(store, quotas)


def test_gpu_seconds_count_held_gpus(store: Store, clock: Clock) -> None:
    quotas = Quotas(gpu_seconds_a_day=100)
    submit(store, quotas)
    held = lease(store)
    store.leases.hold_gpus(held, 8)
    clock.now += 10
    submit(store, quotas)
    clock.now += 5
    store.leases.succeed(held, [], {})
    assert usage_of(store, "local").gpu_seconds == 120
    assert refusal(store, quotas).extra["quota"] == "gpu-seconds-a-day"
    assert lease(store).job.owner == "local", "what was accepted runs"
    clock.now += DAY
    submit(store, quotas)


@pytest.mark.parametrize("ending", ["fail", "release", "stop"])
def test_gpu_seconds_count_for_every_outcome(store: Store, clock: Clock, ending: str) -> None:
    queue(store)
    held = lease(store)
    store.leases.hold_gpus(held, 3)
    clock.now += 5
    if ending == "fail":
        store.leases.fail(held, {"code": "x", "message": "x"}, permanent=False)
    else:
        getattr(store.leases, ending)(held)
    assert usage_of(store, "local").gpu_seconds == 15


def test_lost_attempt_charges_no_gpu_seconds(store: Store, clock: Clock) -> None:
    queue(store)
    store.leases.hold_gpus(lease(store), 8)
    clock.now += LEASE + 1
    lease(store, "two")
    assert usage_of(store, "local").gpu_seconds == 0


def test_usage_is_reported_by_day_and_key(store: Store, clock: Clock) -> None:
    clock.now = 100.5 * DAY  # 1970-04-11
    key, _ = store.keys.create("alice", operator=True)
    job_id = submit(store, NO_QUOTAS, key.id)
    held = lease(store)
    store.leases.hold_gpus(held, 2)
    clock.now += 10
    files = [Published("stylized.ply", "x/1", 4, SHA), Published(".checkpoint", "x/2", 50, SHA)]
    store.leases.succeed(held, files, {})
    clock.now += DAY
    queue(store)
    on_cpu = lease(store)
    clock.now += 7
    store.leases.fail(on_cpu, {"code": "x", "message": "x"}, permanent=True)
    store.jobs.delete(job_id, key.id)  # which changes nothing of what was used
    first = {"day": date(1970, 4, 11), "key": key.id, "name": "alice", "jobs": 1, "gpu_seconds": 20.0}
    first |= {"cpu_seconds": 0.0, "bytes": 7}
    second = {"day": date(1970, 4, 12), "key": "local", "name": "", "jobs": 1, "gpu_seconds": 0.0}
    second |= {"cpu_seconds": 7.0, "bytes": 3}
    assert store.keys.usage(None, None, None) == [first, second]
    assert store.keys.usage(None, None, key.id) == [first]
    assert store.keys.usage(date(1970, 4, 12), None, None) == [second]
    assert store.keys.usage(None, date(1970, 4, 11), None) == [first]
    assert store.keys.usage(date(1970, 4, 1), date(1970, 4, 10), None) == []
    assert store.keys.usage(date.min, date(1, 1, 31), None) == []


def test_stored_bytes_count_uploads_inputs_and_results(store: Store, clock: Clock) -> None:
    """An input of three bytes counts once, however many jobs use it."""
    quotas = Quotas(stored_bytes=10)
    job_id = submit(store, quotas)
    clock.now += 1  # jobs of the same moment have no defined order
    submit(store, quotas)
    assert usage_of(store, "local") == Used(2, 0, 3)
    store.inputs.create_upload("local", 5, "x", "", 1000, quotas=quotas)
    with raises_problem(problems.QUOTA_EXCEEDED) as caught:
        store.inputs.create_upload("local", 3, "x", "", 1000, quotas=quotas)
    assert caught.value.extra["quota"] == "stored-bytes"
    assert caught.value.retry_after
    assert usage_of(store, "local").stored_bytes == 8
    held = lease(store)
    store.leases.succeed(held, [Published("stylized.ply", "x/1", 4, SHA)], {})
    assert usage_of(store, "local").stored_bytes == 12
    assert refusal(store, quotas).extra["quota"] == "stored-bytes"
    assert held.job_id == job_id
    store.jobs.delete(job_id, "local")
    submit(store, quotas)


def test_upload_used_as_an_input_counts_once(store: Store) -> None:
    row = store.inputs.create_upload("local", 3, "scene.ply", "", 1000)
    store.inputs.finish_upload(row.id, SHA, 1000)
    queue(store)
    assert usage_of(store, "local").stored_bytes == 3


def test_retry_is_bounded_like_a_new_job(store: Store, clock: Clock) -> None:
    quotas = Quotas(jobs_a_day=2)
    job_id = submit(store, quotas)
    store.jobs.cancel(job_id, "local")
    store.jobs.retry(job_id, "local", limit=10, quotas=quotas)
    store.jobs.cancel(job_id, "local")
    for bound, quota in ((quotas, "jobs-a-day"), (Quotas(stored_bytes=2), "stored-bytes")):
        with raises_problem(problems.QUOTA_EXCEEDED) as caught:
            store.jobs.retry(job_id, "local", limit=10, quotas=bound)
        assert caught.value.extra["quota"] == quota
    assert store.jobs.get(job_id, "local").status == "canceled"
    assert usage_of(store, "local").jobs == 2
    clock.now += DAY
    store.jobs.retry(job_id, "local", limit=10, quotas=quotas)


def test_concurrent_requests_exceed_no_limit(store: Store) -> None:
    """On PostgreSQL, transactions do not see each other's rows, so without a lock, all requests would be accepted."""
    bytes_of_two = Quotas(stored_bytes=10)
    assert at_once(lambda: store.jobs.create(new_job("a"), limit=5), 30) == 5
    assert at_once(lambda: submit(store, Quotas(jobs_a_day=5), "b"), 30) == 5
    assert at_once(lambda: store.inputs.create_upload("c", 4, "x", "", 1000, quotas=bytes_of_two), 30) == 2
    assert at_once(lambda: store.inputs.open_receipt("d", 4, bytes_of_two), 30) == 2
    assert at_once(lambda: store.inputs.create_upload("e", 4, "x", "", 1000, most=3), 30) == 3
    receipt = store.inputs.open_receipt("f", 0, bytes_of_two)
    assert at_once(lambda: store.inputs.grow_receipt(receipt, 4, "f", bytes_of_two), 30) == 2
    canceled = [queue(store, "g") for _ in range(8)]
    for job_id in canceled:
        store.jobs.cancel(job_id, "g")
    assert at_once(lambda: store.jobs.retry(canceled.pop(), "g", limit=3), 8) == 3
    for owner, stored in (("c", 8), ("d", 8), ("f", 8)):
        assert usage_of(store, owner).stored_bytes == stored


# --- receipts -----------------------------------------------------------------------------------------------------

OTHER = "b" * 64


def test_receipt_charges_until_its_job_is_created(store: Store) -> None:
    quotas = Quotas(stored_bytes=100)
    receipt = store.inputs.open_receipt("me", 90, quotas)
    assert usage_of(store, "me").stored_bytes == 90
    store.inputs.add_blob(SHA, "aa/again", 60, receipt)
    assert usage_of(store, "me").stored_bytes == 33, "30 bytes are still to come, and the blob was there, with 3"
    job = store.jobs.create(new_job("me"), limit=10, quotas=quotas, receipt=receipt)[0]
    assert usage_of(store, "me").stored_bytes == 3
    assert store.inputs.end_receipt(receipt) == []
    assert store.jobs.delete(store.jobs.cancel(job.id, "me").id, "me") == ["aa/blob"]
    assert usage_of(store, "me").stored_bytes == 0


def test_unused_files_of_an_ended_request_are_deleted(store: Store) -> None:
    mine, others = store.inputs.open_receipt("me", 10, NO_QUOTAS), store.inputs.open_receipt("other", 10, NO_QUOTAS)
    store.inputs.add_blob(OTHER, "bb/blob", 5, mine)
    store.inputs.add_blob(SHA, "aa/again", 3, mine)
    store.inputs.add_blob(SHA, "aa/again", 3, others)
    assert store.inputs.end_receipt(mine) == ["bb/blob"]
    assert usage_of(store, "me").stored_bytes == 0
    job = store.jobs.create(new_job("other"), limit=10, receipt=others)[0]
    assert store.inputs.end_receipt(others) == []
    assert store.inputs.blobs([SHA, OTHER]).keys() == {SHA}
    with pytest.raises(NotFoundError):
        store.inputs.add_blob(OTHER, "bb/late", 5, mine)
    assert store.jobs.get(job.id, "other").status == "queued"


def test_last_of_concurrent_releases_deletes_the_blob(store: Store) -> None:
    for _ in range(5):
        digests = [f"{number:064x}" for number in range(10)]
        receipts = [store.inputs.open_receipt("me", 100, NO_QUOTAS) for _ in range(6)]
        for number, receipt in enumerate(receipts):
            for digest in digests[:: 1 if number % 2 else -1]:
                store.inputs.add_blob(digest, f"aa/{digest}", 10, receipt)
        locations: list[str] = []
        at_once(lambda: locations.extend(store.inputs.end_receipt(receipts.pop())), 6)  # noqa: B023
        assert sorted(locations) == [f"aa/{digest}" for digest in digests]
        assert store.inputs.blobs(digests) == {}


def test_receipt_of_a_dead_process_expires(store: Store, clock: Clock) -> None:
    quotas = Quotas(stored_bytes=10)
    lost, alive = store.inputs.open_receipt("me", 5, quotas), store.inputs.open_receipt("me", 5, quotas)
    store.inputs.add_blob(OTHER, "bb/blob", 5, lost)
    clock.now += GRACE_SECONDS / 2
    store.inputs.renew_receipts([alive])
    clock.now += GRACE_SECONDS / 2 + 1
    assert store.inputs.expire_uploads() == [lost]
    assert "bb/blob" in store.inputs.collect()
    assert usage_of(store, "me").stored_bytes == 5
    store.inputs.create_upload("me", 1, "x", "", 1000, most=1)  # a receipt does not count as an unfinished upload


def test_job_whose_input_was_deleted_meanwhile_is_refused(store: Store) -> None:
    row = store.inputs.create_upload("local", 3, "scene.ply", "", 1000)
    store.inputs.finish_upload(row.id, SHA, 1000)
    store.inputs.hold([SHA])
    assert store.inputs.delete_upload(row.id, "local") == ["aa/blob"]
    with pytest.raises(NotFoundError, match="deleted"):
        queue(store)
    assert store.jobs.page("local") == []
