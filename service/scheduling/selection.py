"""Selection of the next job that a machine starts."""

from __future__ import annotations

from collections.abc import Sequence

from service.scheduling.packing import Capacity, Grant
from service.store import Store
from service.store.leases import Lease
from service.store.tables import JobRow


def lease_next_job(
    dispatcher: str, store: Store, capacity: Capacity, held: Sequence[Grant]
) -> tuple[Lease, Grant] | None:
    """Lease the first job of the queue that fits the free capacity of a machine; None if there is none.

    Args:
        capacity: Total capacity of the dispatcher's machine.
        held: Capacity of its running jobs.
    """
    if capacity.free(held) < 1:
        return None  # without a query, which would lock rows that other dispatchers want
    dispatchers = max(1, len(store.operations.dispatchers()))
    waiting = -(-store.leases.waiting(capacity.size * dispatchers) // dispatchers)  # others take their portion
    grants: dict[str, Grant] = {}

    def fits(job: JobRow) -> bool:
        grant = capacity.grant(job, held, waiting)
        if grant is not None:
            grants[job.id] = grant
        return grant is not None

    lease = store.leases.take(dispatcher, fits) if waiting else None
    return (lease, grants[lease.job_id]) if lease is not None else None
