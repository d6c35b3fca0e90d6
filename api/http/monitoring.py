"""`/livez`, `/readyz`, `/metrics`, `/v1/usage`: health checks that return even if one hangs, metrics, usage of keys."""

import asyncio
import re
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Query, Response
from fastapi.responses import JSONResponse, PlainTextResponse
from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.registry import Collector
from pydantic import BeforeValidator

from api.http.context import CallerDep, ContextDep
from api.http.problems import headers
from api.http.schemas import Health, UsageList, UsageView
from service.states import AttemptOutcome, Cause, JobStatus
from service.store import Store
from service.store.database import BUCKETS

#: Time limit in seconds for all checks together.
_SECONDS = 0.8


_ENDS = (JobStatus.SUCCEEDED, JobStatus.FAILED, JobStatus.CANCELED)
#: Help text of each counter, and its label with all possible values. Values without events are exported as 0.
_COUNTERS: dict[str, tuple[str, str | None, tuple[str, ...]]] = {
    "sgsst_jobs_submitted": ("Jobs that were accepted.", None, ()),
    "sgsst_jobs_finished": ("Jobs that have ended, by status.", "status", tuple(map(str, _ENDS))),
    "sgsst_attempts": ("Attempts that were started.", None, ()),
    "sgsst_attempts_ended": ("Attempts that have ended, by outcome.", "outcome", tuple(map(str, AttemptOutcome))),
    "sgsst_outages": (
        "Attempts that ended without the job's doing, by cause.",
        "cause",
        tuple(cause for cause in Cause if cause not in (Cause.JOB, Cause.DISPATCHER)),
    ),
    "sgsst_lease_expirations": ("Leases that expired because their dispatcher did not renew them.", None, ()),
}
_HISTOGRAMS = {
    "sgsst_queue_wait_seconds": "Seconds that jobs waited for their attempts.",
    "sgsst_job_seconds": "Seconds from first attempt to success.",
}


class Metrics(Collector):
    """Everything that `/metrics` exports.

    What survives restarts is read from the database at each scrape.

    Args:
        folder: Folder of the service, on the disk that receives uploads.
    """

    def __init__(self, store: Store, folder: Path) -> None:
        self._store, self._folder = store, folder
        self._registry = CollectorRegistry()
        self._requests = Counter(
            "sgsst_requests", "HTTP requests.", ["method", "route", "status"], registry=self._registry
        )
        self._seconds = Histogram(
            "sgsst_request_seconds", "Seconds until the response began.", ["method", "route"], registry=self._registry
        )
        self._registry.register(self)

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(method, route).observe(seconds)

    def render(self) -> bytes:
        """Return all metrics in the Prometheus text format."""
        return generate_latest(self._registry)

    def collect(self) -> Iterable[Metric]:
        """Yield the metrics of the database and the disk."""
        operations = self._store.operations
        depth = GaugeMetricFamily("sgsst_jobs", "Jobs by status.", labels=["status"])
        counts, waited, rate = operations.work()
        for status in JobStatus:
            depth.add_metric([status], counts.get(status, 0))
        yield depth
        yield from self._counters()
        alive, disk = operations.dispatchers(), shutil.disk_usage(self._folder)
        for name, text, value in (
            ("queue_oldest_seconds", "Seconds that the oldest queued job has waited.", waited),
            ("iterations_per_second", "Iterations per second of all running jobs together.", rate),
            ("dispatchers", "Dispatchers that are alive.", len(alive)),
            ("slots", "GPUs, or slots for jobs on hosts without GPUs.", sum(row.slots for row in alive)),
            ("slots_free", "GPUs or slots that no job occupies.", sum(row.free for row in alive)),
            ("disk_free_bytes", "Free bytes of the disk that receives files.", disk.free),
            ("disk_bytes", "Size of that disk.", disk.total),
        ):
            yield GaugeMetricFamily(f"sgsst_{name}", text, value)

    def _counters(self) -> Iterable[Metric]:
        stored: defaultdict[str, dict[str, float]] = defaultdict(dict)
        for name, labels, value in self._store.operations.counters():
            stored[name][labels.partition("=")[2].strip('"')] = value
        for name, (text, label, known) in _COUNTERS.items():
            family = CounterMetricFamily(name, text, labels=[label] if label else None)
            values = stored[f"{name}_total"]
            for choice in sorted({*known, *values} if label else {""}):
                family.add_metric([choice] if label else [], values.get(choice, 0.0))
            yield family
        for name, text in _HISTOGRAMS.items():
            buckets = stored[f"{name}_bucket"]
            number, total = (stored[f"{name}_{part}"].get("", 0.0) for part in ("count", "sum"))
            yield HistogramMetricFamily(name, text, _cumulative(buckets, number), total)


def _cumulative(buckets: dict[str, float], number: float) -> list[tuple[str, float]]:
    """Return histogram buckets as Prometheus expects them: each count includes all lower buckets."""
    below, rows = 0.0, []
    for bound in BUCKETS:
        below += buckets.get(str(bound), 0.0)
        rows.append((str(float(bound)), below))
    return [*rows, ("+Inf", number)]


class Readiness:
    """Health checks, which run in separate threads that requests cannot occupy.

    A check that hangs is not started again until it has returned, so it never takes more than one thread.

    Args:
        checks: Check functions by name; each returns a value or raises.
    """

    def __init__(self, checks: Mapping[str, Callable[[], object]]) -> None:
        self._checks = checks
        self._threads = ThreadPoolExecutor(len(checks), "readiness")
        self._running: dict[str, asyncio.Future[object]] = {}

    async def run(self) -> dict[str, object]:
        """Return the result or exception of each check; `TimeoutError` for a check that has not returned in time."""
        running = {name: self._start(name) for name in self._checks}
        await asyncio.wait(running.values(), timeout=_SECONDS)
        return {
            name: (future.exception() or future.result()) if future.done() else TimeoutError()
            for name, future in running.items()
        }

    def _start(self, name: str) -> asyncio.Future[object]:
        running = self._running.get(name)
        if running is None or running.done():
            self._running[name] = asyncio.get_running_loop().run_in_executor(self._threads, self._checks[name])
        return self._running[name]

    def close(self) -> None:
        """Cancel checks that have not started, without waiting for running ones."""
        self._threads.shutdown(wait=False, cancel_futures=True)


router = APIRouter(tags=["operations"])


@router.get("/livez", response_model=Health)
async def livez() -> Health:
    """Check that the process answers. If it does not, restart it."""
    return Health(status="ok", checks={})


@router.get(
    "/readyz",
    response_model=Health,
    responses={
        503: {
            "description": "Something that jobs need is unavailable; `checks` names it.",
            "headers": headers("Retry-After"),
            "content": {
                "application/json": {
                    "schema": {"$ref": "#/components/schemas/Health"},
                    "example": {
                        "status": "unavailable",
                        "checks": {
                            "database": "ok",
                            "artifacts": "ok",
                            "disk": "NoSpaceError",
                            "weights": "ok",
                            "dispatchers": "1",
                        },
                    },
                }
            },
        }
    },
)
async def readyz(context: ContextDep) -> Response:
    """Check that jobs can be accepted.

    The database must answer, results must be storable, the disk must have free space, and the weights of the feature
    networks must be intact.

    Without a dispatcher, jobs are accepted and wait in the queue: the answer is 200 with status `waiting`, and its
    check `dispatchers` is "none". Otherwise that check is the number of dispatchers that are alive. The answer comes
    within a second; a check that has not returned by then has failed (`TimeoutError`).
    """
    outcomes = await context.readiness.run()
    checks = {
        name: type(outcome).__name__ if isinstance(outcome, BaseException) else "ok"
        for name, outcome in outcomes.items()
    }
    ready, alive = set(checks.values()) == {"ok"}, outcomes["database"]
    if not isinstance(alive, BaseException):
        checks["dispatchers"] = str(alive or "none")
    if not ready:
        return JSONResponse(Health(status="unavailable", checks=checks).model_dump(), 503, {"Retry-After": "5"})
    return JSONResponse(Health(status="ok" if alive else "waiting", checks=checks).model_dump())


def _day(text: object) -> object:
    """Return the day of a text; `date` would accept numbers of seconds too."""
    if not isinstance(text, str) or not re.fullmatch(r"[0-9]{4}-[0-9]{2}-[0-9]{2}", text):
        raise ValueError("must be a day such as 2026-11-21")
    return date.fromisoformat(text)


_Day = Annotated[date, BeforeValidator(_day)]


@router.get("/v1/usage", response_model=UsageList)
def get_usage(
    context: ContextDep,
    caller: CallerDep,
    since: Annotated[
        _Day | None, Query(description="First day (UTC). Default: 30 days up to the last.", examples=["2026-11-01"])
    ] = None,
    until: Annotated[_Day | None, Query(description="Last day. Default: today.", examples=["2026-11-30"])] = None,
) -> UsageList:
    """Get the usage of this key by day, or with an operator's key that of all keys, for at most 92 days."""
    rows = context.store.keys.usage(since, until, None if caller.operator else caller.owner)
    return UsageList(usage=[UsageView(**row) for row in rows])


@router.get(
    "/metrics",
    response_class=PlainTextResponse,
    responses={
        200: {
            "description": "Metrics in the Prometheus text format.",
            "content": {"text/plain": {"example": 'sgsst_jobs{status="queued"} 3.0\n'}},
        }
    },
)
async def metrics(context: ContextDep) -> Response:
    """Get Prometheus metrics."""
    text = await context.threads.run("", context.metrics.render)  # it looks at the disk, too
    return Response(text, media_type="text/plain; version=0.0.4; charset=utf-8")
