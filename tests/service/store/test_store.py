"""Tests of the store on SQLite and PostgreSQL with a simulated clock, including a comparison with a model."""

import itertools
import shutil
import tempfile
import threading
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from sqlalchemy import event, func, inspect, select

from service import problems
from service.problems import ConflictError, LeaseLostError, NotFoundError, ProblemType
from service.states import ACTIVE, FINISHED, Published
from service.store import Store, open_store
from service.store.database import translated
from service.store.files import GRACE_SECONDS
from service.store.jobs import GROWTH, Idempotency, add_point
from service.store.queue import MAX_LOSSES, MAX_PROGRESS_EVENTS, Lease
from service.store.tables import Base, JobRow, ProgressPointRow, ShareRow
from sgsst_core.progress import Progress
from tests.raised import raises_problem
from tests.service.store.helpers import (
    ATTEMPTS,
    LEASE,
    RETENTION,
    RETRY,
    SHA,
    Clock,
    at_once,
    lease,
    new_job,
    queue,
    store_settings,
)
from tests.stores import new_store


def test_migrations_create_the_tables_of_the_models(store: Store, tmp_path: Path) -> None:
    inspector = inspect(store.database.engine)
    for table in Base.metadata.sorted_tables:
        columns = {column["name"]: column["nullable"] for column in inspector.get_columns(table.name)}
        assert columns == {column.name: column.nullable for column in table.columns}, table.name
        indexes = {index["name"] for index in inspector.get_indexes(table.name) if not index["unique"]}
        assert indexes == {index.name for index in table.indexes}, table.name
    Base.metadata.create_all(store.database.engine)  # finds that all tables exist


def test_sqlite_commits_are_durable(tmp_path: Path) -> None:
    store = open_store(store_settings(tmp_path, None))
    with store.database.reading() as session:
        pragmas = {
            name: session.connection().exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys")
        }
    assert pragmas == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1}
    store.close()


def test_detail_is_one_snapshot(store: Store) -> None:
    """The job is returned to the queue between the statements of the query."""
    queue(store)
    held = lease(store)
    released: list[str] = []

    def release(_connection: object, _cursor: object, statement: str, *_: object) -> None:
        if not released and "FROM jobs" in statement:
            released.append(statement)
            store.leases.release(held)

    event.listen(store.database.engine, "after_cursor_execute", release)
    shown, attempts = store.jobs.detail(held.job_id, None)
    event.remove(store.database.engine, "after_cursor_execute", release)
    assert released
    assert (shown.row.status, shown.position, attempts[0].outcome) == ("starting", None, None)
    shown, attempts = store.jobs.detail(held.job_id, None)
    assert (shown.row.status, shown.position, attempts[0].outcome) == ("queued", 1, "released")


def test_rows_that_vanish_are_conflicts(store: Store) -> None:
    """A row that refers to a missing one, or that is missing itself, is decided in one place."""
    with raises_problem(problems.CHANGED_MEANWHILE), store.database.writing() as session:
        session.add(ShareRow(id="shr_1", job_id="job_1", sha256="0" * 64, created_at=0.0, expires_at=1.0))
    with raises_problem(problems.CHANGED_MEANWHILE), store.database.reading() as session:
        session.get_one(JobRow, "job_1")


@pytest.mark.parametrize(
    ("problem", "codes"),
    [
        (problems.DATABASE_UNAVAILABLE, "08006 0A000 25006 28P01 53200 53300 57P01 57P03 58030 XX000 F00D1"),
        (problems.DATABASE_BUSY, "40001 40P01 55P03"),
        (problems.CHANGED_MEANWHILE, "23503 23505"),
        (None, "22003 23502 42601 42P01 54000"),
    ],
)
def test_codes_of_the_server_decide_what_an_error_means(problem: ProblemType | None, codes: str) -> None:
    """A standby, a server that shuts down, and codes that nobody has foreseen are outages, whatever their class."""
    psycopg = pytest.importorskip("psycopg")
    for code in codes.split():
        error = type("Error", (psycopg.DatabaseError,), {"sqlstate": code})
        with raises_problem(problem) if problem else pytest.raises(error), translated():
            raise error


def test_queue_positions_match_the_order_of_leases(store: Store, clock: Clock) -> None:
    ids = []
    for number, priority in enumerate([0, 5, 0, 5, -1, 0]):
        clock.now += number % 2  # two jobs at a time
        ids.append(queue(store, priority=priority))
    by_position = {store.jobs.detail(job_id, "local")[0].position: job_id for job_id in ids}
    assert [lease(store).job_id for _ in ids] == [by_position[place] for place in range(1, len(ids) + 1)]
    assert store.jobs.detail(ids[0], "local")[0].position is None


def test_concurrent_requests_with_one_idempotency_key_create_one_job(store: Store) -> None:
    outcomes: list[tuple[str, bool]] = []

    def create() -> None:
        job, created = store.jobs.create(new_job(), limit=100, idempotency=Idempotency("k", "f" * 64))
        outcomes.append((job.id, created))

    at_once(create, 8)
    assert len({job_id for job_id, _ in outcomes}) == 1
    assert sum(created for _, created in outcomes) == 1
    assert [len(store.jobs.events(shown.row.id, 0)) for shown in store.jobs.page(None)] == [1]


def test_job_whose_input_was_deleted_meanwhile_is_not_queued(store: Store, clock: Clock) -> None:
    clock.now += GRACE_SECONDS + 1
    assert store.inputs.collect()
    with raises_problem(problems.NOT_FOUND):
        queue(store)
    assert store.jobs.page(None) == []


def test_concurrent_dispatchers_lease_every_job_once(store: Store) -> None:
    expected = {queue(store) for _ in range(12)}
    leased: list[str] = []

    def work() -> None:
        while (held := store.leases.take(threading.current_thread().name)) is not None:
            leased.append(held.job_id)

    at_once(work, 4)
    # with PostgreSQL, a dispatcher may find nothing while another one holds the next row
    while (held := store.leases.take("last")) is not None:
        leased.append(held.job_id)
    assert sorted(leased) == sorted(expected)


def test_lost_lease_cannot_write(store: Store, clock: Clock) -> None:
    queue(store)
    late = lease(store, "late")
    clock.now += LEASE + 1
    new = lease(store, "new")
    assert new.job_id == late.job_id
    file = Published("stylized.ply", "x/1", 1, SHA)
    for write in (
        lambda: store.leases.start(late),
        lambda: store.leases.report_progress(late, Progress(stage="sos", step=1)),
        lambda: store.leases.publish(late, [file]),
        lambda: store.leases.succeed(late, [file], {}),
        lambda: store.leases.fail(late, {"code": "x", "message": "x"}, permanent=False),
        lambda: store.leases.release(late),
        lambda: store.leases.stop(late),
    ):
        with pytest.raises(LeaseLostError):
            write()
    assert store.leases.renew([late]) == store.leases.statuses([late]) == {late.job_id: None}
    assert store.leases.renew([new]) == store.leases.statuses([new]) == {new.job_id: "starting"}
    assert not store.jobs.artifacts(new.job_id)
    store.leases.succeed(new, [file], {"steps": 1})
    assert [row.name for row in store.jobs.artifacts(new.job_id)] == ["stylized.ply"]
    with pytest.raises(LeaseLostError):
        store.leases.succeed(new, [file], {})


def test_job_that_kills_its_dispatchers_fails(store: Store, clock: Clock) -> None:
    job_id = queue(store)
    for attempt in range(1, MAX_LOSSES + 1):
        assert lease(store, f"dispatcher {attempt}").job.attempt == attempt
        clock.now += LEASE + 1  # the dispatcher died with the attempt
    assert store.leases.take("another") is None
    job = store.jobs.get(job_id, "local")
    assert (job.status, (job.error or {})["code"]) == ("failed", "dispatcher-lost")
    assert [row.outcome for row in store.jobs.detail(job_id, None)[1]] == ["lost"] * MAX_LOSSES


@pytest.mark.parametrize("next_dispatcher", ["one", "two"])
def test_database_outages_never_fail_a_job(store: Store, clock: Clock, next_dispatcher: str) -> None:
    """The dispatcher survives each outage, but its lease does not; it reports before anybody takes the job."""
    job_id = queue(store)
    held = lease(store, "one")
    for attempt in range(2, 2 * MAX_LOSSES):
        clock.now += LEASE + 15
        store.operations.record_heartbeat(held.dispatcher, 1, 1)
        held = lease(store, next_dispatcher)
        assert held.job.attempt == attempt
        assert held.job.failures == 0
    ends = store.jobs.detail(job_id, None)[1][:-1]
    assert {(row.outcome, (row.error or {})["cause"]) for row in ends} == {("lost", "database")}
    counted = {labels: value for name, labels, value in store.operations.counters() if name == "sgsst_outages_total"}
    assert counted == {'cause="database"': len(ends)}


def test_loss_counts_once_without_free_capacity(store: Store, clock: Clock) -> None:
    """The loss counts once, however often a dispatcher without free capacity examines the job."""
    job_id = queue(store)
    lease(store, "late")
    clock.now += LEASE + 1
    for _ in range(2 * ATTEMPTS):
        assert store.leases.take("full", lambda job: False) is None
    assert (store.jobs.get(job_id, None).status, store.jobs.get(job_id, None).failures) == ("queued", 0)
    assert lease(store, "free").job.attempt == 2
    assert [row.outcome for row in store.jobs.detail(job_id, None)[1]] == ["lost", None]


def fail_at(store: Store, clock: Clock, saved: int | None, *, lost: bool = False) -> bool:
    """Run an attempt that saves a checkpoint and fails; return whether the job will be retried."""
    clock.now += 1000
    held = lease(store)
    if saved is not None:
        store.leases.publish(held, [Published(".checkpoint", f"x/{held.epoch}", 1, SHA, step=saved)])
    if not lost:
        return store.leases.fail(held, {"code": "x", "message": "x"}, permanent=False)
    clock.now += LEASE + 1
    again = store.leases.take("two")
    if again is not None:
        store.leases.release(again)
    return again is not None


@pytest.mark.parametrize("lost", [False, True])
def test_job_with_progress_between_failures_is_retried(store: Store, clock: Clock, lost: bool) -> None:
    queue(store)
    for step in range(10, 100, 10):
        assert fail_at(store, clock, step, lost=lost)


def test_job_that_fails_at_the_same_step_is_given_up(store: Store, clock: Clock) -> None:
    job_id = queue(store)
    assert fail_at(store, clock, None)
    assert fail_at(store, clock, 90), "this one came on"
    # each attempt first republishes the checkpoint that it resumes from, or an older step if it starts over
    assert fail_at(store, clock, 90)
    assert fail_at(store, clock, 10)
    assert not fail_at(store, clock, 90)
    assert store.jobs.get(job_id, "local").status == "failed"
    store.jobs.retry(job_id, "local", limit=1)
    assert [fail_at(store, clock, 90) for _ in range(ATTEMPTS)] == [True, True, False]


def test_old_progress_events_are_deleted_but_not_status_events(store: Store) -> None:
    queue(store)
    held = lease(store)
    for step in range(MAX_PROGRESS_EVENTS + 20):
        store.leases.report_progress(held, Progress(stage="sos", step=step))
    events = store.jobs.events(held.job_id, 0, limit=1000)
    assert [event.data["step"] for event in events if event.kind == "progress"] == list(
        range(20, MAX_PROGRESS_EVENTS + 20)
    )
    assert [event.data["status"] for event in events if event.kind == "status"] == ["queued", "starting"]


def at_step(step: int, seconds: float, stage: str = "sos") -> Progress:
    """Return progress as a dispatcher reports it."""
    return Progress(stage=stage, step=step, total=10_000, seconds=seconds, loss=1e6 / step, scales=[1.0, None])


def test_loss_history_covers_the_whole_job(store: Store, clock: Clock) -> None:
    job_id = queue(store)
    held = lease(store)
    store.leases.report_progress(held, Progress(stage="planning", step=1, total=3))
    assert store.jobs.loss_history(store.jobs.get(job_id, None), 10) == []
    with store.database.writing() as session:  # like `report_progress`, without a transaction for each point
        for step in range(1, 5000):
            added = {"attempt": 1, "updated_at": clock.now + step}
            add_point(session, job_id, at_step(step, 0.9 * step).model_dump() | added)
    clock.now += 5000
    store.leases.report_progress(held, at_step(5000, 4500.0, "measuring"))
    job = store.jobs.get(job_id, None)
    points = store.jobs.loss_history(job, 10_000)
    assert [point["step"] for point in points[:5]] == [1, 2, 3, 4, 5]
    assert (points[-1]["step"], points[-1]["stage"], points[-1]["updated_at"]) == (5000, "measuring", clock.now)
    assert (points[9]["loss"], points[9]["scales"], points[9]["seconds"]) == (1e5, [1.0, None], 9.0)
    ratios = [later["seconds"] / point["seconds"] for point, later in itertools.pairwise(points[:-1])]
    assert all(ratio >= GROWTH for ratio in ratios)
    assert all(ratio < GROWTH + 0.01 for ratio in ratios[100:]), "no gaps"
    assert len(points) < 550
    few = store.jobs.loss_history(job, 64)
    assert len(few) == 64
    assert (few[0]["step"], few[-1]["step"]) == (1, 5000)
    assert [point["step"] for point in few] == sorted({point["step"] for point in few})


def test_loss_history_continues_across_attempts(store: Store, clock: Clock) -> None:
    job_id = queue(store)
    held = lease(store)
    for step in (1, 2, 3, 4):
        store.leases.report_progress(held, at_step(step, float(step)))
    store.leases.release(held)
    again = lease(store)
    for step, seconds in ((3, 3.0), (3, 3.0), (2, 2.0), (5, 5.0)):  # from a checkpoint of step 2; ranks were lost once
        store.leases.report_progress(again, at_step(step, seconds))
    points = [(point["attempt"], point["step"]) for point in store.jobs.loss_history(store.jobs.get(job_id, None), 100)]
    assert points == [(1, 1), (1, 2), (1, 3), (1, 4), (2, 3), (2, 5)]
    store.leases.fail(again, {"code": "x", "message": "x"}, permanent=True)
    store.jobs.retry(job_id, None, limit=10)
    job = store.jobs.get(job_id, None)
    assert job.progress is None
    assert len(store.jobs.loss_history(job, 100)) == 6
    store.jobs.cancel(job_id, None)
    store.jobs.delete(job_id, None)
    with store.database.reading_rows() as connection:
        assert connection.execute(select(func.count()).select_from(ProgressPointRow)).scalar() == 0


def test_inputs_are_read_in_pieces(store: Store) -> None:
    """Lists have the scene, styles and cameras, and count photos and masks, whose names are read by page."""
    roles = ["photos", "scene", "photos", "style", "mask", "style", "cameras", "photos"]
    entries = [
        {"role": role, "name": f"{number}\u00e9'.png", "sha256": SHA, "size": 3} for number, role in enumerate(roles)
    ]
    job_id = store.jobs.create(replace(new_job(), inputs=entries), limit=10)[0].id
    (shown,) = store.jobs.page(None)
    assert shown.inputs == store.jobs.detail(job_id, None)[0].inputs
    assert [entries.index(entry) for entry in shown.inputs] == [1, 3, 5, 6]
    assert shown.input_counts == {"scene": 1, "style": 2, "cameras": 1, "photos": 3, "mask": 1}
    assert store.jobs.input_page(job_id, 2, 4) == [(1, entries[2]), (0, entries[3]), (0, entries[4]), (1, entries[5])]
    assert store.jobs.input_page(job_id, 8, 4) == []
    assert store.jobs.input(job_id, "photos", 2) == entries[7]
    assert store.jobs.input(job_id, "photos", 3) is None
    assert store.jobs.inputs(job_id) == lease(store).job.inputs == entries


def test_unused_blobs_are_deleted(store: Store, clock: Clock) -> None:
    job_id = queue(store)
    clock.now += 2 * GRACE_SECONDS
    assert store.inputs.collect() == []
    store.jobs.cancel(job_id, "local")
    assert store.jobs.delete(job_id, "local") == ["aa/blob"]
    assert store.inputs.collect() == []
    assert store.inputs.add_blob(SHA, "aa/other", 3) == "aa/other"
    assert store.inputs.add_blob(SHA, "aa/third", 3) == "aa/other"
    assert store.inputs.collect() == []  # just touched


def test_held_blobs_are_not_collected(store: Store, clock: Clock) -> None:
    for wait in (0.0, 0.05 * GRACE_SECONDS, 0.5 * GRACE_SECONDS):
        clock.now += wait
        assert store.inputs.hold([SHA])[SHA].location == "aa/blob"
        clock.now += 0.85 * GRACE_SECONDS
        assert store.inputs.collect() == []
    clock.now += GRACE_SECONDS
    assert store.inputs.collect() == ["aa/blob"]
    with pytest.raises(NotFoundError):
        store.inputs.hold([SHA])


@pytest.mark.parametrize(("requested", "seconds"), [(RETENTION / 4, RETENTION / 4), (3 * RETENTION, RETENTION)])
def test_job_is_kept_as_long_as_requested_at_most_as_the_service_keeps_it(
    store: Store, clock: Clock, requested: float, seconds: float
) -> None:
    new = replace(new_job(), parameters={"retention_days": requested / 86_400})
    job_id = store.jobs.create(new, limit=100)[0].id
    store.leases.succeed(lease(store), [Published("stylized.ply", "x", 1, SHA)], {})
    for status in ("expired", None):
        clock.now += seconds - 1
        assert store.jobs.expire() == []
        clock.now += 2
        assert store.jobs.expire() == [job_id]
        shown = store.jobs.page("local")
        assert [job.row.status for job in shown] == ([status] if status else [])


# --- comparison with a model --------------------------------------------------------------------------------------


class StoreMachine(RuleBasedStateMachine):
    """Random operations of users and dispatchers, with a model of each job's status and current lease holder."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = Path(tempfile.mkdtemp(prefix="sgsst-store-"))
        self.clock = Clock()
        self.store = new_store(store_settings(self.folder, None), self.clock)
        self.store.inputs.add_blob(SHA, "aa/blob", 3)
        self.status: dict[str, str] = {}
        self.held: dict[str, tuple[Lease, float]] = {}
        self.old: list[Lease] = []
        self.published: dict[str, int] = {}
        self.finished_early: set[str] = set()

    def teardown(self) -> None:
        self.store.close()
        shutil.rmtree(self.folder)

    @initialize()
    def first(self) -> None:
        self.create("a", 0)

    @rule(owner=st.sampled_from("ab"), priority=st.integers(0, 1))
    def create(self, owner: str, priority: int) -> None:
        self.clock.now += 1e-3  # ids sort by time and then randomly, which would make a run irreproducible
        self.store.inputs.add_blob(SHA, "aa/blob", 3)  # deleted with the last job
        job_id = queue(self.store, owner, priority)
        self.status[job_id] = "queued"

    @rule(seconds=st.sampled_from([1.0, RETRY, LEASE / 2, LEASE + 1]))
    def wait(self, seconds: float) -> None:
        self.clock.now += seconds

    @rule(dispatcher=st.sampled_from(["one", "two"]))
    def take(self, dispatcher: str) -> None:
        live = {job_id for job_id, (_, until) in self.held.items() if until >= self.clock.now}
        lease = self.store.leases.take(dispatcher)
        self._see_settled()
        if lease is None:
            return
        assert lease.job_id not in live
        if lease.job_id in self.held:
            self.old.append(self.held.pop(lease.job_id)[0])
        self.held[lease.job_id] = (lease, self.clock.now + LEASE)
        self.status[lease.job_id] = "starting"

    def _see_settled(self) -> None:
        """Update the model for jobs that may have ended because their leases had expired."""
        for job_id, (held, until) in list(self.held.items()):
            status = self.store.jobs.get(job_id, None).status
            if until < self.clock.now and status in ("failed", "canceled"):
                self.old.append(held)
                del self.held[job_id]
                self.status[job_id] = status

    @precondition(lambda self: self.held)
    @rule(data=st.data())
    def renew(self, data: st.DataObject) -> None:
        held, _ = self._some(data)
        assert self.store.leases.renew([held]) == {held.job_id: self.status[held.job_id]}
        self.held[held.job_id] = (held, self.clock.now + LEASE)

    @precondition(lambda self: self.held)
    @rule(data=st.data(), how=st.sampled_from(["running", "succeed", "fail", "break", "release", "canceled"]))
    def write(self, data: st.DataObject, how: str) -> None:
        held, _ = self._some(data)
        job_id, leases = held.job_id, self.store.leases
        canceling = self.status[job_id] == "canceling"
        if how == "running":
            leases.start(held)
            running = "finishing" if job_id in self.finished_early else "running"
            self.status[job_id] = "canceling" if canceling else running
            return
        if how == "succeed":
            leases.succeed(held, [Published("stylized.ply", f"{held.epoch}", 1, SHA)], {})
            self.published[job_id] = self.published.get(job_id, 0) + 1
            self.status[job_id] = "succeeded"
        elif how in ("fail", "break"):
            again = leases.fail(held, {"code": "x", "message": "x"}, permanent=how == "break")
            assert not (again and (how == "break" or canceling))
            self.status[job_id] = "canceled" if canceling else "queued" if again else "failed"
        elif how == "release":
            leases.release(held)
            self.status[job_id] = "canceled" if canceling else "queued"
        else:
            leases.stop(held)
            self.status[job_id] = "canceled"
        self.old.append(self.held.pop(job_id)[0])

    def _some(self, data: st.DataObject) -> tuple[Lease, float]:
        return self.held[data.draw(st.sampled_from(sorted(self.held)))]

    @precondition(lambda self: self.old)
    @rule(data=st.data())
    def late_write(self, data: st.DataObject) -> None:
        late = data.draw(st.sampled_from(self.old))
        with pytest.raises(LeaseLostError):
            self.store.leases.succeed(late, [Published("stylized.ply", "late", 1, SHA)], {})

    @precondition(lambda self: self.status)
    @rule(data=st.data(), what=st.sampled_from(["finish", "cancel", "retry", "delete"]))
    def ask(self, data: st.DataObject, what: str) -> None:
        job_id = data.draw(st.sampled_from(sorted(self.status)))
        before = self.status[job_id]
        jobs = self.store.jobs
        try:
            if what == "finish":
                jobs.finish(job_id, None)
                assert before in ("running", "finishing")
                self.status[job_id] = "finishing"
                self.finished_early.add(job_id)
            elif what == "cancel":
                jobs.cancel(job_id, None)
                self.status[job_id] = {"queued": "canceled", "canceled": "canceled"}.get(before, "canceling")
                assert before in ("queued", *ACTIVE, "canceled")
            elif what == "retry":
                jobs.retry(job_id, None, limit=1000)
                assert before in ("failed", "canceled")
                self.status[job_id] = "queued"
                self.finished_early.discard(job_id)
            else:
                jobs.delete(job_id, None)
                assert before in FINISHED
                del self.status[job_id]
                self.old = [lease for lease in self.old if lease.job_id != job_id]
                self.published.pop(job_id, None)
        except ConflictError:
            wrong = {
                "finish": ("queued", "starting", "canceling", *FINISHED),
                "cancel": ("succeeded", "failed"),
                "delete": ("queued", *ACTIVE),
            }
            assert before in wrong.get(what, ("queued", "succeeded", *ACTIVE))

    @invariant()
    def as_the_model_says(self) -> None:
        assert {job.row.id: job.row.status for job in self.store.jobs.page(None, limit=1000)} == self.status
        assert all(count == 1 for count in self.published.values())
        for job_id, status in self.status.items():
            names = [row.name for row in self.store.jobs.artifacts(job_id)]
            assert (names == ["stylized.ply"]) == (status == "succeeded")


TestStoreMachine = StoreMachine.TestCase
TestStoreMachine.settings = settings(
    max_examples=10,
    stateful_step_count=30,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large],
)
