"""Forecast of when queued jobs start, for their users. PyTorch is not imported, because the API process computes it.

Jobs are assumed to start in the order of their positions, each on one GPU or in one slot. Running jobs report their
remaining seconds. The durations of jobs ahead are estimated from their records, scaled by the pace of running jobs, as
for backfilling (`service.scheduling.selection`). An estimate derives from all parameters of a job, which may take 64 kB
and never change, so it is computed once.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Collection, Mapping
from functools import lru_cache
from statistics import median

from service.errors import NoJobError
from service.scheduling.packing import Estimate
from service.store import Store
from service.store.operations import Line
from service.store.tables import JobRow

#: Maximum position in the queue for which a start is forecast.
MOST_AHEAD = 100
#: Maximum number of cached estimates.
_MAX_ESTIMATES = 10_000


def expected_starts(store: Store, job_ids: Collection[str]) -> dict[str, float]:
    """Return the expected start of queued jobs by the store's clock; jobs whose start is unknown are left out."""
    if not job_ids:
        return {}
    line = store.operations.line(MOST_AHEAD)
    jobs = (*(job for job, _, _ in line.running), *line.queued)
    starts = forecast(line, {job.id: _estimate(store, job.id) for job in jobs})
    return {job_id: starts[job_id] for job_id in job_ids if job_id in starts}


@lru_cache(_MAX_ESTIMATES)
def _estimate(store: Store, job_id: str) -> Estimate:
    try:
        shown, _ = store.jobs.detail(job_id, None)
    except NoJobError:  # deleted a moment ago
        return Estimate()
    shown.row.inputs = shown.inputs
    return Estimate.of(shown.row)


def forecast(line: Line, estimates: Mapping[str, Estimate]) -> dict[str, float]:
    """Return the expected start of each queued job; jobs whose start is unknown are left out.

    Times derive from reports alone, so that they change only with these.
    """
    if not line.capacity:
        return {}
    ends = [(job, since, gpus, _reported_end(job)) for job, since, gpus in line.running]
    paces = [
        (end - since) / estimates[job.id].seconds(gpus)
        for job, since, gpus, end in ends
        if end is not None and job.attempt == 1  # later attempts resume from a checkpoint
    ]
    pace = median(paces) if paces else math.inf
    places: list[float] = []
    for job, since, gpus, end in ends:
        known = since + pace * estimates[job.id].seconds(gpus) if end is None else end
        places += max(gpus, 1) * [known]
    places += max(0, line.capacity - len(places)) * [0.0]
    heapq.heapify(places)
    starts: dict[str, float] = {}
    for job in line.queued:
        start = max(heapq.heappop(places), job.queued_at, job.not_before)
        if math.isinf(start):
            break
        starts[job.id] = start
        heapq.heappush(places, start + pace * estimates[job.id].seconds())
    return starts


def _reported_end(job: JobRow) -> float | None:
    """Return the end of a running job according to its last report; None before its first step."""
    progress = job.progress or {}
    left = progress.get("eta_s")
    has_steps = progress.get("loss") is not None or progress.get("stage") == "measuring"
    if left is None or not has_steps or progress.get("attempt") != job.attempt:
        return None
    return float(progress["updated_at"] + left)
