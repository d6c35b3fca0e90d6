"""Hosts under a simulated clock, with the service's own queue, fairness, leases and packing.

Each host has a dispatcher. If it has free GPUs and there may be a job for them, it polls for work within half a second,
as a real one does. Polls that find nothing are not simulated; `benchmarks.fleet_parts.database` measures their load.
Leases are renewed less often than by real dispatchers, but those of a failed host expire as late as they really would.
Likewise, only the last checkpoint before a failure is published.
"""

from __future__ import annotations

import heapq
import math
import random
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sqlalchemy import event

from benchmarks.fleet_parts.demand import SimulatedJob
from service.inputs import CHECKPOINT
from service.scheduling.capacity import Capacity, Grant, Machine
from service.scheduling.dispatcher import lease_next_job
from service.settings import ServiceSettings
from service.states import Published
from service.store import Store, open_store
from service.store.jobs import NewJob
from service.store.queue import Lease

LEASE_SECONDS, CHECKPOINT_SECONDS, POLL_SECONDS = 30.0, 60.0, 0.5
#: Seconds after which a host polls again if none of the waiting jobs fits its free GPUs (a real host uses
#: `POLL_SECONDS`).
_LOOK_AGAIN = 10.0
#: Interval in seconds between renewals of a host's leases. Real dispatchers renew leases more often.
_RENEWAL_SECONDS = 900.0
#: Minimum and maximum seconds until a failed host is back.
_REPAIR_SECONDS = (600.0, 3600.0)
_EPOCH = 1_700_000_000.0
_SHA = "a" * 64


@dataclass
class Record:
    """Simulation record of a job.

    Attributes:
        started: Start time of the first attempt.
        offered, planned: Number of GPUs offered to the last attempt, and number used by its plan.
        held: GPU seconds of all attempts.
        lost: GPU seconds of lost work.
        done: Fraction of the steps that is saved in a checkpoint.
    """

    job: SimulatedJob
    started: float | None = None
    ended: float | None = None
    attempts: int = 0
    offered: int = 0
    planned: int = 0
    held: float = 0.0
    lost: float = 0.0
    done: float = 0.0


@dataclass
class Attempt:
    """Attempt of a job, which occupies GPUs of a host."""

    record: Record
    lease: Lease
    grant: Grant
    begun: float
    since: float
    stepping_since: float | None = None
    ends: float | None = None


@dataclass
class Host:
    """Machine with its dispatcher. `life` counts restarts, so that events from before a restart are ignored."""

    name: str
    capacity: Capacity
    gpus: int
    running: dict[str, Attempt] = field(default_factory=dict)
    life: int = 0
    up: bool = True
    looks_again: bool = False

    @property
    def held(self) -> list[Grant]:
        """Resources in use by the host's attempts."""
        return [attempt.grant for attempt in self.running.values()]

    @property
    def free(self) -> int:
        """Number of unoccupied GPUs."""
        return self.gpus - sum(len(attempt.grant.gpus) for attempt in self.running.values()) if self.up else 0


class Fleet:
    """Simulated hosts, their database and their clock.

    Args:
        folder: Folder of the database, preferably in memory.
        hosts: Number of hosts.
        gpus_each: GPUs per host.
        host_days: Mean days between failures of a host.
        seed: Seed of the random choices.
    """

    def __init__(self, folder: Path, hosts: int, gpus_each: int, host_days: float, seed: int) -> None:
        self.now = 0.0
        self.records: dict[str, Record] = {}
        self.statements: Counter[str] = Counter()
        self.calls: Counter[str] = Counter()
        self.queue_seconds: list[tuple[float, int]] = []
        self.failures = 0
        self._host_days = host_days
        self._chance = random.Random(seed)
        self._events: list[tuple[float, int, Callable[[], None]]] = []
        self._number = 0
        self._doing = ""
        self._waiting = 0
        # Leases are long, so that few renewals are simulated; `_run_out` ends leases of failed hosts in time.
        settings = ServiceSettings(data=folder, lease_seconds=2 * _RENEWAL_SECONDS, log_format="text")
        self.store: Store = open_store(settings, lambda: _EPOCH + self.now)
        self._prepare_store()
        names = tuple(str(number) for number in range(gpus_each))
        self.hosts = []
        for number in range(hosts):
            capacity = Capacity(Machine(names, 64, 1 << 40), settings.parallel_jobs)
            self.hosts.append(Host(f"host-{number}", capacity, gpus_each))
            self.store.operations.record_heartbeat(f"host-{number}", gpus_each, gpus_each)

    def _prepare_store(self) -> None:
        engine = self.store.database.engine
        engine.dispose()
        event.listen(engine, "connect", _trust_the_memory)
        event.listen(engine, "before_cursor_execute", self._count)
        self.store.inputs.add_blob(_SHA, "aa/blob", 3)

    def _count(self, *args: Any) -> None:
        self.statements[self._doing] += 1

    def run(self, jobs: list[SimulatedJob], seconds: float, warm_up: float, patience: float = math.inf) -> float:
        """Run the simulation. GPU seconds count from the end of the warm-up.

        Args:
            jobs: Jobs with their arrival times.
            seconds: Simulated seconds.
            warm_up: Simulated seconds of the warm-up.
            patience: Maximum wall-clock seconds, after which the simulation stops early.

        Returns:
            Number of seconds that were simulated.
        """
        started = time.perf_counter()
        self._at(warm_up, self._forget_held)
        for job in jobs:
            self._at(job.at, lambda job=job: self._arrive(job))  # type: ignore[misc]
        for host in self.hosts:
            self._fail_some_day(host)
            self._at(_RENEWAL_SECONDS, lambda host=host: self._renew(host))  # type: ignore[misc]
        while self._events and self._events[0][0] <= seconds:
            if time.perf_counter() - started > patience:
                seconds = self.now
                break
            self.now, _, happen = heapq.heappop(self._events)
            happen()
        self.now = seconds
        self._account_all()
        return seconds

    def _account_all(self) -> None:
        for host in self.hosts:
            for attempt in host.running.values():
                self._account(attempt)

    def _forget_held(self) -> None:
        self._account_all()
        for record in self.records.values():
            record.held = 0.0

    # --- what happens ----------------------------------------------------------------------------------------------

    def _at(self, moment: float, happen: Callable[[], None]) -> None:
        self._number += 1
        heapq.heappush(self._events, (moment, self._number, happen))

    def _soon(self) -> float:
        return self.now + self._chance.uniform(0, POLL_SECONDS)

    def _do(self, what: str) -> None:
        """Count subsequent SQL statements under the name `what`."""
        self._doing = what
        self.calls[what] += 1

    def _arrive(self, job: SimulatedJob) -> None:
        self._do("submit")
        new = NewJob(job.owner, "", 0, job.parameters, job.inputs)
        row, _ = self.store.jobs.create(new, limit=10**9)
        self.records[row.id] = Record(job)
        self._waiting += 1
        self._at(self._soon(), self._schedule_polls)

    def _schedule_polls(self) -> None:
        """Schedule polls of all hosts with free GPUs, in random order."""
        hosts = [host for host in self.hosts if host.free]
        self._chance.shuffle(hosts)
        for host in hosts:
            if not self._waiting:
                break
            self._look(host)

    def _look(self, host: Host) -> None:
        """Lease all jobs that fit a host, as a real dispatcher does in each poll."""
        while host.free and self._waiting:
            self._do("lease")
            lease = lease_next_job(host.name, self.store, host.capacity, host.held)
            if lease is None:
                self._do("look")
                if not host.looks_again:
                    host.looks_again = True
                    self._at(self.now + _LOOK_AGAIN, lambda: self._look_again(host))
                return
            self._start(host, *lease)

    def _look_again(self, host: Host) -> None:
        host.looks_again = False
        self._look(host)

    def _start(self, host: Host, lease: Lease, grant: Grant) -> None:
        record = self.records[lease.job_id]
        self._waiting -= 1
        self.queue_seconds.append((self.now, self._waiting))
        record.started = self.now if record.started is None else record.started
        record.attempts += 1
        record.offered = grant.ranks
        attempt = Attempt(record, lease, grant, self.now, self.now)
        host.running[lease.job_id] = attempt
        life = host.life
        self._at(self.now + record.job.start_seconds(), lambda: self._planned(host, life, attempt))

    def _planned(self, host: Host, life: int, attempt: Attempt) -> None:
        if host.life != life:
            return
        self._do("begin")
        self.store.leases.start(attempt.lease)
        record = attempt.record
        self._account(attempt)
        record.planned = record.job.planned(attempt.grant.ranks)
        if record.planned < attempt.grant.ranks:
            attempt.grant = Grant(record.planned, attempt.grant.gpus[: record.planned])
            self._at(self._soon(), lambda: self._look(host))
        attempt.stepping_since = self.now
        attempt.ends = self.now + (1 - record.done) * record.job.seconds(record.planned)
        self._at(attempt.ends, lambda: self._done(host, life, attempt))

    def _done(self, host: Host, life: int, attempt: Attempt) -> None:
        if host.life != life:
            return
        self._do("end")
        self.store.leases.succeed(attempt.lease, [Published("stylized.ply", "x", 1, _SHA)], {})
        self._account(attempt)
        attempt.record.ended = self.now
        del host.running[attempt.lease.job_id]
        self._at(self._soon(), lambda: self._look(host))

    def _renew(self, host: Host) -> None:
        if host.up and host.running:
            self._do("renew")
            self.store.leases.renew([attempt.lease for attempt in host.running.values()])
        self._at(self.now + _RENEWAL_SECONDS, lambda: self._renew(host))

    # --- failures --------------------------------------------------------------------------------------------------

    def _fail_some_day(self, host: Host) -> None:
        after = self._chance.expovariate(1 / (self._host_days * 86_400))
        self._at(self.now + after, lambda: self._fail(host))

    def _fail(self, host: Host) -> None:
        self.failures += 1
        for attempt in host.running.values():
            self._lose(attempt)
        host.running.clear()
        host.life += 1
        host.up = False
        last_renewed = self._chance.uniform(0, LEASE_SECONDS / 3)
        self._at(self.now + LEASE_SECONDS - last_renewed, lambda: self._run_out(host))
        self._at(self.now + self._chance.uniform(*_REPAIR_SECONDS), lambda: self._repair(host))

    def _lose(self, attempt: Attempt) -> None:
        """Record the work since the last checkpoint as lost; before the first step, the whole attempt is lost."""
        record = attempt.record
        self._account(attempt)
        gpus = len(attempt.grant.gpus)
        if attempt.stepping_since is None:
            record.lost += gpus * (self.now - attempt.begun)
            return
        stepped = self.now - attempt.stepping_since
        saved = stepped // CHECKPOINT_SECONDS * CHECKPOINT_SECONDS
        record.lost += gpus * (stepped - saved)
        if saved:
            record.done += saved / record.job.seconds(record.planned)
            step = int(record.done * record.job.steps)
            self._do("checkpoint")
            file = Published(CHECKPOINT, f"x/{attempt.lease.epoch}", 1, _SHA, step=step)
            self.store.leases.publish(attempt.lease, [file])

    def _run_out(self, host: Host) -> None:
        self._do("failure")
        held = self.store.leases.waiting()
        self.store.leases.expire(host.name)
        self.store.operations.remove_dispatcher(host.name)
        self._waiting += self.store.leases.waiting() - held
        self._at(self._soon(), self._schedule_polls)

    def _repair(self, host: Host) -> None:
        host.up = True
        self._do("failure")
        self.store.operations.record_heartbeat(host.name, host.gpus, host.gpus)
        self._look(host)
        self._fail_some_day(host)

    def _account(self, attempt: Attempt) -> None:
        attempt.record.held += len(attempt.grant.gpus) * (self.now - attempt.since)
        attempt.since = self.now


def _trust_the_memory(connection: Any, _record: Any) -> None:
    """Turn off durability, which a simulated database does not need."""
    connection.execute("PRAGMA synchronous=OFF")
