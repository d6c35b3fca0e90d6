"""Data for monitoring, webhooks and housekeeping: dispatchers, counters, secrets, messages, and expired jobs."""

from __future__ import annotations

import base64
import secrets
from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import (
    ColumnElement,
    SQLColumnExpression,
    and_,
    case,
    delete,
    func,
    literal,
    select,
    text,
    update,
)

from service import problems
from service.states import FINISHED, JobStatus, Transition
from service.store.database import IDEMPOTENCY_SECONDS, Database, upsert
from service.store.jobs import forget, holder_name, move, retention_of
from service.store.tables import (
    ArtifactRow,
    BlobUseRow,
    CounterRow,
    DeliveryRow,
    DispatcherRow,
    IdempotencyRow,
    JobRow,
    SecretRow,
)

#: Whether a PostgreSQL server accepts no writes; a standby does not.
_READ_ONLY = text("SHOW transaction_read_only")


@dataclass(frozen=True)
class Delivery:
    """Webhook message that a dispatcher has claimed for sending.

    Attributes:
        owner: Owner of the job; empty if the job is deleted.
        tries: Number of attempts, including this one.
    """

    id: str
    job_id: str
    owner: str
    url: str
    body: dict[str, Any]
    tries: int


def _counted(counts: Mapping[str, int], column: SQLColumnExpression[str]) -> ColumnElement[int]:
    """Return an SQL expression for the count of a column's value; 0 for values without a count."""
    return case(dict(counts), value=column, else_=0) if counts else literal(0)


class Operations:
    """Operations for monitoring and webhooks."""

    def __init__(self, database: Database, lease_seconds: float) -> None:
        self._database = database
        self._lease_seconds = lease_seconds

    def record_heartbeat(self, name: str, slots: int, free: int) -> None:
        """Record a dispatcher's heartbeat with its total and free capacity."""
        now = self._database.clock()
        values = {"seen_at": now, "slots": slots, "free": free}
        with self._database.writing() as session:
            insert = upsert(session)(DispatcherRow).values(name=name, **values)
            session.execute(insert.on_conflict_do_update(index_elements=["name"], set_=values))

    def remove_dispatcher(self, name: str) -> None:
        """Remove a dispatcher that has ended."""
        with self._database.writing() as session:
            session.execute(delete(DispatcherRow).where(DispatcherRow.name == name))

    def dispatchers(self) -> list[DispatcherRow]:
        """Return the live dispatchers: those with a heartbeat within a lease duration."""
        alive = select(DispatcherRow).where(self._is_alive()).order_by(DispatcherRow.name)
        with self._database.reading() as session:
            return list(session.scalars(alive))

    def check(self) -> int:
        """Query the database for a health check, and return the number of live dispatchers.

        Raises:
            DatabaseUnavailableError: If the database does not respond within some seconds, or accepts no writes.
        """
        alive = select(func.count()).select_from(DispatcherRow).where(self._is_alive())
        with self._database.reserved_connection() as connection:
            if not self._database.sqlite and connection.scalar(_READ_ONLY) == "on":
                raise problems.DATABASE_UNAVAILABLE()
            return connection.execute(alive).scalar_one()

    def _is_alive(self) -> ColumnElement[bool]:
        """Return the condition of a heartbeat within a lease duration. One far in the future is of a wrong clock."""
        now = self._database.clock()
        return DispatcherRow.seen_at.between(now - self._lease_seconds, now + self._lease_seconds)

    def counters(self) -> list[tuple[str, str, float]]:
        """Return name, labels and value of every counter."""
        with self._database.reading() as session:
            rows = session.scalars(select(CounterRow).order_by(CounterRow.name, CounterRow.labels)).all()
        return [(row.name, row.labels, row.value) for row in rows]

    def work(self) -> tuple[dict[str, int], float, float]:
        """Return the number of jobs by status, the waiting time of the oldest queued one, and the steps per second.

        Times are in seconds. They are 0 if no job is queued, and if none makes steps.
        """
        counts = select(JobRow.status, func.count()).group_by(JobRow.status)
        with self._database.reading() as session:
            by_status = dict(session.execute(counts).all())
            oldest = session.scalar(select(func.min(JobRow.queued_at)).where(JobRow.status == JobStatus.QUEUED))
            running = session.scalars(select(JobRow.progress).where(JobRow.status == JobStatus.RUNNING)).all()
        waited = 0.0 if oldest is None else max(0.0, self._database.clock() - oldest)
        rates = (each["step"] / each["seconds"] for each in running if each and each.get("seconds"))
        return by_status, waited, sum(rates)

    def webhook_secret(self) -> str:
        """Return the secret that signs webhooks, in the format of Standard Webhooks; it is created on first use."""
        secret = "whsec_" + base64.b64encode(secrets.token_bytes(32)).decode()
        with self._database.writing() as session:
            insert = upsert(session)(SecretRow).values(name="webhooks", value=secret)
            session.execute(insert.on_conflict_do_nothing())
            return session.get_one(SecretRow, "webhooks").value

    def due_deliveries(
        self, hold_seconds: float, sending: Collection[Delivery], *, total: int, per_owner: int, per_url: int
    ) -> list[Delivery]:
        """Claim due messages for sending; no other dispatcher gets them for `hold_seconds`.

        Args:
            sending: Messages that this dispatcher is already sending; they count toward the limits.
            total, per_owner, per_url: Maximum numbers of messages sent at the same time. The latter two keep a receiver
                that does not respond, or an owner with many such receivers, from delaying the messages of others.
        """
        now = self._database.clock()
        owner = func.coalesce(JobRow.owner, "")  # messages of deleted jobs count as those of one owner
        per_url_rank = func.row_number().over(partition_by=DeliveryRow.url, order_by=DeliveryRow.next_at)
        due = (
            select(DeliveryRow.id, DeliveryRow.next_at, owner.label("owner"))
            .add_columns(
                (per_url_rank + _counted(Counter(each.url for each in sending), DeliveryRow.url)).label("rank")
            )
            .outerjoin(JobRow, JobRow.id == DeliveryRow.job_id)
            .where(DeliveryRow.next_at <= now)
            .subquery()
        )
        per_owner_rank = func.row_number().over(partition_by=due.c.owner, order_by=due.c.next_at)
        turns = (
            select(due.c.id, due.c.owner)
            .add_columns(
                (per_owner_rank + _counted(Counter(each.owner for each in sending), due.c.owner)).label("rank")
            )
            .where(due.c.rank <= per_url)
            .subquery()
        )
        query = (
            select(DeliveryRow, turns.c.owner)
            .join(turns, turns.c.id == DeliveryRow.id)
            .where(turns.c.rank <= per_owner, DeliveryRow.next_at <= now)  # checked again once the row is locked
            .order_by(DeliveryRow.next_at)
            .limit(max(0, total - len(sending)))
            .with_for_update(of=DeliveryRow, skip_locked=True)
        )
        with self._database.writing() as session:
            taken = []
            for row, holder in session.execute(query).all():
                row.tries += 1
                row.next_at = now + hold_seconds
                taken.append(Delivery(row.id, row.job_id, holder, row.url, row.body, row.tries))
            return taken

    def settle_delivery(self, delivery_id: str, wait_seconds: float | None) -> None:
        """Make a message due again after `wait_seconds`; if None, delete it because it was delivered or given up."""
        with self._database.writing() as session:
            row = session.get(DeliveryRow, delivery_id, with_for_update=True)
            if row is None:
                return
            if wait_seconds is None:
                session.delete(row)
            else:
                row.next_at = self._database.clock() + wait_seconds


#: Time in seconds after which a dispatcher without heartbeat is forgotten.
_FORGET_SECONDS = 86_400.0


class Retention:
    """Housekeeping of the store, which any dispatcher may do.

    Args:
        retention: Most seconds until results expire (`retention_of`); the record of an expired job is deleted after
            another such period.
    """

    def __init__(self, database: Database, retention: float) -> None:
        self._database = database
        self._retention = retention

    def expire(self) -> list[str]:
        """Expire old results, and delete the records of jobs that expired long ago.

        Returns:
            Ids of jobs whose files are to be removed.
        """
        now = self._database.clock()
        with self._database.writing() as session:
            old = select(JobRow).where(JobRow.expires_at < now).order_by(JobRow.id).limit(100)
            due = session.scalars(old.with_for_update(skip_locked=True)).all()
            for job in due:
                if job.status == JobStatus.EXPIRED:
                    forget(session, job)
                    continue
                job.expires_at = now + retention_of(job, self._retention)
                session.execute(delete(ArtifactRow).where(ArtifactRow.job_id == job.id))
                # blobs without other holders are collected later
                session.execute(delete(BlobUseRow).where(BlobUseRow.holder == holder_name(job.id)))
                move(session, job, Transition.EXPIRE, now)
            session.execute(delete(DispatcherRow).where(DispatcherRow.seen_at < now - _FORGET_SECONDS))
            session.execute(delete(IdempotencyRow).where(IdempotencyRow.created_at < now - IDEMPOTENCY_SECONDS))
            return [job.id for job in due]

    def unswept(self, limit: int) -> list[tuple[str, int]]:
        """Return ended jobs that may have files without database rows, each with the epoch of its last lease."""
        query = select(JobRow.id, JobRow.lease_epoch).where(JobRow.swept.is_(False), JobRow.status.in_(FINISHED))
        with self._database.reading() as session:
            return [(job_id, epoch) for job_id, epoch in session.execute(query.limit(limit))]

    def mark_swept(self, job_id: str, epoch: int) -> None:
        """Mark a job as having no files without rows, unless it has been queued again."""
        same = and_(JobRow.id == job_id, JobRow.lease_epoch == epoch, JobRow.status.in_(FINISHED))
        with self._database.writing() as session:
            session.execute(update(JobRow).where(same).values(swept=True))
