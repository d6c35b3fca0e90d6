"""Prometheus metrics: requests of this process, and jobs as the store has them."""

from __future__ import annotations

from collections.abc import Iterable

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from service.store import Store

_HELP = {
    "sgsst_jobs_submitted": "Jobs that were accepted.",
    "sgsst_jobs_finished": "Jobs that have ended, by status.",
    "sgsst_attempts": "Attempts that were begun.",
    "sgsst_attempts_ended": "Attempts that have ended, by outcome.",
    "sgsst_lease_expirations": "Leases that ran out because a dispatcher was not heard of.",
    "sgsst_queue_wait_seconds_sum": "Seconds that jobs waited for their attempts.",
    "sgsst_queue_wait_seconds_count": "Waits counted in sgsst_queue_wait_seconds_sum.",
    "sgsst_job_seconds_sum": "Seconds from first attempt to success.",
    "sgsst_job_seconds_count": "Successes counted in sgsst_job_seconds_sum.",
}


class Metrics:
    """What `/metrics` shows."""

    def __init__(self, store: Store) -> None:
        self._registry = CollectorRegistry()
        self._requests = Counter(
            "sgsst_requests", "HTTP requests.", ["method", "route", "status"], registry=self._registry
        )
        self._seconds = Histogram(
            "sgsst_request_seconds", "Seconds until the response began.", ["method", "route"], registry=self._registry
        )
        self._registry.register(_StoreCollector(store))

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count a request."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(method, route).observe(seconds)

    def render(self) -> bytes:
        """The text format."""
        return generate_latest(self._registry)


class _StoreCollector(Collector):
    """Counts that outlive processes, read from the store when asked for."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def describe(self) -> Iterable[Metric]:
        return []

    def collect(self) -> Iterable[Metric]:
        operations = self._store.operations
        depth = GaugeMetricFamily("sgsst_jobs", "Jobs by status.", labels=["status"])
        for status, number in operations.depths().items():
            depth.add_metric([status], number)
        yield depth
        yield GaugeMetricFamily(
            "sgsst_queue_oldest_seconds", "Seconds that the oldest queued job has waited.", operations.oldest_queued()
        )
        yield from self._counters()
        rates = [step / seconds for step, seconds in operations.steps_and_seconds()]
        yield GaugeMetricFamily("sgsst_iterations_per_second", "Of all running jobs together.", sum(rates))
        alive = operations.dispatchers()
        yield GaugeMetricFamily("sgsst_dispatchers", "Dispatchers that are alive.", len(alive))
        places, free = sum(row.places for row in alive), sum(row.free for row in alive)
        yield GaugeMetricFamily("sgsst_places", "GPUs, or places for jobs where there are none.", places)
        yield GaugeMetricFamily("sgsst_places_free", "Those that no job has.", free)

    def _counters(self) -> Iterable[Metric]:
        families: dict[str, CounterMetricFamily] = {}
        for name, labels, value in self._store.operations.counters():
            plain = name.removesuffix("_total")
            key, _, label = labels.partition("=")
            family = families.setdefault(
                plain, CounterMetricFamily(plain, _HELP.get(plain, plain), labels=[key] if key else None)
            )
            family.add_metric([label.strip('"')] if key else [], value)
        return families.values()
