"""What monitoring and webhooks keep in the store: dispatchers, counters, secrets and messages."""

from __future__ import annotations

import base64
import secrets

from sqlalchemy import bindparam, delete, func, select

from service.store.database import Database, upsert
from service.store.states import JobStatus
from service.store.tables import CounterRow, DeliveryRow, DispatcherRow, JobRow, SecretRow

#: Dispatchers that were heard of within a lease's time. A heartbeat of the future is that of a wrong clock.
_IS_ALIVE = DispatcherRow.seen_at.between(bindparam("since"), bindparam("until"))
_ALIVE = select(func.count()).select_from(DispatcherRow).where(_IS_ALIVE)


class Operations:
    """What monitoring and webhooks need."""

    def __init__(self, database: Database, lease_seconds: float) -> None:
        self._database = database
        self._lease_seconds = lease_seconds

    def beat(self, name: str, places: int, free: int) -> None:
        """Record that a dispatcher is alive, and how much room it has."""
        now = self._database.clock()
        values = {"seen_at": now, "places": places, "free": free}
        with self._database.writing() as session:
            insert = upsert(session)(DispatcherRow).values(name=name, **values)
            session.execute(insert.on_conflict_do_update(index_elements=["name"], set_=values))

    def gone(self, name: str) -> None:
        """A dispatcher has ended."""
        with self._database.writing() as session:
            session.execute(delete(DispatcherRow).where(DispatcherRow.name == name))

    def dispatchers(self) -> list[DispatcherRow]:
        """Return those that are alive: heard of within a lease's time."""
        span = self._span()
        with self._database.reading() as session:
            return list(session.scalars(select(DispatcherRow).where(_IS_ALIVE).order_by(DispatcherRow.name), span))

    def alive(self) -> int:
        """Return how many dispatchers are alive."""
        span = self._span()
        with self._database.reading_rows() as connection:
            return connection.execute(_ALIVE, span).scalar_one()

    def check(self) -> int:
        """Prove that the database answers, as health checks do; returns how many dispatchers are alive.

        Raises:
            DatabaseUnavailableError: The database does not answer within some seconds.
        """
        span = self._span()
        with self._database.aside() as connection:
            return connection.execute(_ALIVE, span).scalar_one()

    def heartbeats(self) -> dict[str, float]:
        """Return when each dispatcher was heard of last, by its own clock and whether it is alive or not."""
        with self._database.reading() as session:
            return dict(session.execute(select(DispatcherRow.name, DispatcherRow.seen_at)).tuples().all())

    def _span(self) -> dict[str, float]:
        now = self._database.clock()
        return {"since": now - self._lease_seconds, "until": now + self._lease_seconds}

    def counters(self) -> list[tuple[str, str, float]]:
        """Name, labels and value of every counter."""
        with self._database.reading() as session:
            rows = session.scalars(select(CounterRow).order_by(CounterRow.name, CounterRow.labels)).all()
        return [(row.name, row.labels, row.value) for row in rows]

    def depths(self) -> dict[str, int]:
        """Jobs by status."""
        query = select(JobRow.status, func.count()).group_by(JobRow.status)
        with self._database.reading() as session:
            return dict(session.execute(query).tuples().all())

    def oldest_queued(self) -> float:
        """Seconds that the oldest queued job has waited; 0 where none waits."""
        with self._database.reading() as session:
            oldest = session.scalar(select(func.min(JobRow.queued_at)).where(JobRow.status == JobStatus.QUEUED))
        return 0.0 if oldest is None else max(0.0, self._database.clock() - oldest)

    def steps_and_seconds(self) -> list[tuple[int, float]]:
        """Steps that each running job has made, and the seconds that they took."""
        with self._database.reading() as session:
            found = session.scalars(select(JobRow.progress).where(JobRow.status == JobStatus.RUNNING)).all()
        return [(progress["step"], progress["seconds"]) for progress in found if progress and progress.get("seconds")]

    def webhook_secret(self) -> str:
        """The secret that signs webhooks, in the form of Standard Webhooks; made at first use."""
        made = "whsec_" + base64.b64encode(secrets.token_bytes(32)).decode()
        with self._database.writing() as session:
            insert = upsert(session)(SecretRow).values(name="webhooks", value=made)
            session.execute(insert.on_conflict_do_nothing())
            return session.get_one(SecretRow, "webhooks").value

    def due_deliveries(self, hold_seconds: float) -> list[DeliveryRow]:
        """Messages to be sent now; nobody else gets them for so many seconds."""
        now = self._database.clock()
        with self._database.writing() as session:
            query = select(DeliveryRow).where(DeliveryRow.next_at <= now).order_by(DeliveryRow.next_at).limit(20)
            rows = session.scalars(query.with_for_update(skip_locked=True)).all()
            for row in rows:
                row.tries += 1
                row.next_at = now + hold_seconds
            return list(rows)

    def settle_delivery(self, delivery_id: str, next_at: float | None) -> None:
        """A message was delivered or given up (None), or is to be tried again later."""
        with self._database.writing() as session:
            row = session.get(DeliveryRow, delivery_id, with_for_update=True)
            if row is None:
                return
            if next_at is None:
                session.delete(row)
            else:
                row.next_at = next_at
