"""Load on one PostgreSQL server from a long queue and from all writes of a fleet's dispatchers.

Each kind of store call that a dispatcher makes runs many times on several threads at once. The rate of these calls in a
fleet is derived from its jobs and from the service's own intervals. Server and clients both run on this machine, and
commits are durable. CPU seconds are those of the server alone.
"""

from __future__ import annotations

import statistics
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil
from sqlalchemy import event, insert, text

from benchmarks.fleet_parts.demand import KINDS, Demand
from benchmarks.fleet_parts.simulation import CHECKPOINT_SECONDS, LEASE_SECONDS, POLL_SECONDS
from service.inputs import CHECKPOINT
from service.scheduling.attempts import progress_seconds
from service.settings import ServiceSettings
from service.states import Published
from service.store import Store, open_store
from service.store.jobs import _JOBS, NewJob
from service.store.queue import Lease
from sgsst_core.progress import Progress
from tests.postgres import fresh_database, server

_SHA = "a" * 64
_OWNERS, _THREADS, _EACH = 50, 4, 12
_INPUTS = [{"role": "scene", "name": "scene.ply", "sha256": _SHA, "size": 10**9}]
#: Seconds between previews (`ServiceSettings.preview_seconds`).
_PREVIEW_SECONDS = 20.0


def measure(queued: int, gpus: int, dispatchers: int) -> dict[str, Any]:
    """Measure the lease query and the cost of each call, and extrapolate to a fleet."""
    with server(durable=True) as url, tempfile.TemporaryDirectory() as folder:
        settings = ServiceSettings(data=Path(folder), database=fresh_database(url), lease_seconds=3600)
        store = open_store(settings)
        _fill(store, queued)
        measured: dict[str, Any] = {"queued": queued, "owners": _OWNERS, "lease_query_ms": _lease_query(store)}
        calls = measured["calls"] = _calls(store, int(url.rsplit(":", 1)[1].partition("/")[0]))
        measured["fleet"] = _fleet(calls, gpus, dispatchers)
        store.close()
    return measured


def _fill(store: Store, queued: int) -> None:
    store.inputs.add_blob(_SHA, "aa/blob", 3)
    now = time.time() - queued
    jobs = [NewJob(f"key_{number % _OWNERS:03d}", "", 0, {"preset": "paper"}, _INPUTS) for number in range(queued)]
    with store.database.writing() as session:
        session.execute(insert(_JOBS), [job.row(now + number) for number, job in enumerate(jobs)])
        session.execute(text("ANALYZE"))


def _lease_query(store: Store) -> dict[str, float]:
    """Return the milliseconds of finding the next job, both statements together; `least` is the minimum."""
    took: list[float] = []
    started = 0.0

    def before(*_: Any) -> None:
        nonlocal started
        started = time.perf_counter()

    def after(_connection: Any, _cursor: Any, statement: str, *_: Any) -> None:
        if "owners" in statement:
            took.append(time.perf_counter() - started)
        elif "FOR UPDATE OF jobs SKIP LOCKED" in statement:
            took[-1] += time.perf_counter() - started

    event.listen(store.database.engine, "before_cursor_execute", before)
    event.listen(store.database.engine, "after_cursor_execute", after)
    for _ in range(60):
        store.leases.take("one")
    event.remove(store.database.engine, "before_cursor_execute", before)
    event.remove(store.database.engine, "after_cursor_execute", after)
    sorted_seconds = sorted(took[10:])
    return {
        "least": _ms(sorted_seconds[0]),
        "p50": _ms(statistics.median(sorted_seconds)),
        "p99": _ms(sorted_seconds[int(0.99 * len(sorted_seconds))]),
    }


def _calls(store: Store, port: int) -> dict[str, dict[str, float]]:
    """Return number of statements, server time and rate of each store call that dispatchers make."""
    leases: dict[str, list[Lease]] = {f"host-{number}": [] for number in range(_THREADS)}

    def own() -> list[Lease]:
        """Return the leases of this thread; no two dispatchers write to the same job."""
        return leases[threading.current_thread().name]

    def take() -> None:
        lease = store.leases.take(threading.current_thread().name)
        while lease is None:  # another thread has locked the next row
            lease = store.leases.take(threading.current_thread().name)
        own().append(lease)

    def some() -> Lease:
        own().append(own().pop(0))
        return own()[0]

    submitted = NewJob("key_000", "", 0, {"preset": "paper"}, _INPUTS)
    progress = Progress(stage="sos", step=7, total=20_000, eta_s=100.0, loss=0.5, seconds=9.0)
    checkpoint = Published(CHECKPOINT, "x", 1, _SHA, step=5)
    what: dict[str, Callable[[], Any]] = {
        "submit": lambda: store.jobs.create(submitted, limit=10**9),
        "lease": take,
        "gpus": lambda: store.leases.hold_gpus(some(), 2),
        "begin": lambda: store.leases.start(some()),
        "progress": lambda: store.leases.report_progress(some(), progress),
        "publish": lambda: store.leases.publish(some(), [checkpoint]),
        "renew eight": lambda: store.leases.renew(own()[:8]),
        "look at eight": lambda: store.leases.statuses(own()[:8]),
        "look at the queue": lambda: (store.operations.dispatchers(), store.leases.waiting(1000)),
        "alive": lambda: store.operations.record_heartbeat(threading.current_thread().name, 8, 0),
        "end": lambda: store.leases.succeed(own().pop(), [Published("stylized.ply", "x", 1, _SHA)], {}),
    }
    return {name: _cost(store, port, each) for name, each in what.items()}


def _cost(store: Store, port: int, call: Callable[[], Any]) -> dict[str, float]:
    statements = 0
    errors: list[Exception] = []

    def count(*_: Any) -> None:
        nonlocal statements
        statements += 1

    def work() -> None:
        try:
            for _ in range(_EACH):
                call()
        except Exception as error:
            errors.append(error)

    event.listen(store.database.engine, "before_cursor_execute", count)
    before, started = _server_seconds(port), time.perf_counter()
    threads = [threading.Thread(target=work, name=f"host-{number}") for number in range(_THREADS)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]
    seconds, used = time.perf_counter() - started, _server_seconds(port) - before
    event.remove(store.database.engine, "before_cursor_execute", count)
    calls = _THREADS * _EACH
    return {
        "statements": round(statements / calls, 1),
        "server_cpu_ms": _ms(used / calls),
        "a_second_here": round(calls / seconds, 1),
    }


def _server_seconds(port: int) -> float:
    """Return the CPU seconds of all server processes. Connections stay open, so no server process exits meanwhile."""
    seconds = 0.0
    for connection in psutil.net_connections("tcp"):
        if connection.status == psutil.CONN_LISTEN and connection.laddr.port == port and connection.pid:
            main = psutil.Process(connection.pid)
            for process in (main, *main.children()):
                times = process.cpu_times()
                seconds += times.user + times.system
            break
    return seconds


def _fleet(calls: dict[str, dict[str, float]], gpus: int, dispatchers: int) -> dict[str, Any]:
    """Return each call's rate in a fleet, the total load, and the number of GPUs whose calls saturate one core."""
    demand = Demand(gpus)
    jobs = demand.jobs(0.2, 0)
    a_second = demand.jobs_a_day * gpus / 1000 / 86_400
    seconds = sum(job.seconds(1) for job in jobs) / len(jobs)
    reports = sum(_reports(job.seconds(1)) for job in jobs) / len(jobs)
    rates = {
        **dict.fromkeys(("submit", "lease", "gpus", "begin", "end"), a_second),
        "progress": a_second * reports,
        "publish": a_second * seconds * (1 / CHECKPOINT_SECONDS + 1 / _PREVIEW_SECONDS),
        "renew eight": dispatchers * 3 / LEASE_SECONDS,
        "look at eight": dispatchers / POLL_SECONDS,
        "look at the queue": dispatchers / POLL_SECONDS,
        "alive": dispatchers * 3 / LEASE_SECONDS,
    }
    statements = {name: round(rate * calls[name]["statements"], 1) for name, rate in rates.items()}
    cores = sum(rate * calls[name]["server_cpu_ms"] / 1000 for name, rate in rates.items())
    return {
        "gpus": gpus,
        "dispatchers": dispatchers,
        "kinds": [kind.name for kind in KINDS],
        "calls_a_second": {name: round(rate, 1) for name, rate in rates.items()},
        "statements_a_second": {**statements, "all": round(sum(statements.values()), 1)},
        "commits_a_second": round(sum(rate for name, rate in rates.items() if not name.startswith("look")), 1),
        "server_cores": round(cores, 2),
        "gpus_for_each_core": round(gpus / cores) if cores else None,
    }


def _reports(seconds: float) -> float:
    """Return the number of progress reports during the given seconds of steps."""
    count, now = 0.0, 0.0
    while now < seconds:
        now += progress_seconds(now)
        count += 1
    return count


def _ms(seconds: float) -> float:
    return round(1000 * seconds, 2)
