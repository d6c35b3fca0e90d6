"""Figures of a simulated fleet: GPU utilization, waiting times by job size and by API key, cost of failures."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

from benchmarks.fleet_parts.simulation import Fleet, Record

#: A job counts as starved if it waits longer than this plus its own run time.
_STARVED_SECONDS = 3600.0


def figures(fleet: Fleet, seconds: float, warm_up: float) -> dict[str, Any]:
    """Return all figures; GPU seconds and waits count from the end of the warm-up."""
    records = list(fleet.records.values())
    counted = [record for record in records if record.job.at >= warm_up]
    gpus = sum(host.gpus for host in fleet.hosts)
    held = sum(record.held for record in records)
    ended = [record for record in records if record.ended is not None]
    worth = sum(record.job.seconds(1) for record in ended)
    stepping = sum(record.planned * record.job.seconds(record.planned) for record in ended)
    return {
        "jobs": len(records),
        "ended": len(ended),
        "offered_load": round(sum(r.job.seconds(1) + r.job.start_seconds() for r in records) / (gpus * seconds), 3),
        "utilization": round(held / (gpus * (seconds - warm_up)), 3),
        "of_steps_worth_on_one_gpu": round(worth / max(stepping, 1e-9), 3),
        "host_failures": fleet.failures,
        "lost_gpu_hours": round(sum(record.lost for record in records) / 3600, 2),
        "attempts": sum(record.attempts for record in records),
        "longest_queue": max((length for _, length in fleet.queue_seconds), default=0),
        "wait_by_kind": _by(counted, seconds, lambda record: record.job.kind),
        "wait_by_workers": _by(counted, seconds, lambda record: str(record.job.parameters.get("workers", "not named"))),
        "wait_by_key": _keys(counted, seconds),
        "gpus_by_kind": _gpus(counted),
        "seconds_to_result_by_kind": _results(counted),
        "starved": sum(_wait(record, seconds) > _STARVED_SECONDS + record.job.seconds(1) for record in counted),
    }


def _wait(record: Record, now: float) -> float:
    """Return the waiting time before the first attempt; if there is none yet, the waiting time so far."""
    return (now if record.started is None else record.started) - record.job.at


def spread(values: Iterable[float]) -> dict[str, float]:
    """Return percentiles of times in seconds."""
    ordered = sorted(values)
    if not ordered:
        return {}
    places = {"p50": 0.5, "p99": 0.99, "most": 1.0}
    return {name: round(ordered[min(int(share * len(ordered)), len(ordered) - 1)], 1) for name, share in places.items()}


def _grouped(records: Sequence[Record], name: Any) -> dict[str, list[Record]]:
    groups: dict[str, list[Record]] = defaultdict(list)
    for record in records:
        groups[name(record)].append(record)
    return dict(sorted(groups.items()))


def _by(records: Sequence[Record], now: float, name: Any) -> dict[str, Any]:
    groups = _grouped(records, name)
    return {key: {"jobs": len(own), **spread(_wait(r, now) for r in own)} for key, own in groups.items()}


def _keys(records: Sequence[Record], now: float) -> dict[str, Any]:
    """Return waiting times of the greedy API key, of the keys with most jobs, and a summary of all other keys."""
    groups = _grouped(records, lambda record: record.job.owner)
    greedy = groups.pop("key_000", [])
    others = {key: spread(_wait(record, now) for record in own) for key, own in groups.items()}
    busiest = sorted(groups, key=lambda key: -len(groups[key]))[:5]
    return {
        "greedy": {"jobs": len(greedy), **spread(_wait(record, now) for record in greedy)},
        "busiest": {key: {"jobs": len(groups[key]), **others[key]} for key in busiest},
        "medians_of_other_keys": spread(each["p50"] for each in others.values()),
        "longest_of_other_keys": spread(each["most"] for each in others.values()),
    }


def _gpus(records: Sequence[Record]) -> dict[str, Any]:
    started = [record for record in records if record.planned]
    groups = _grouped(started, lambda record: record.job.kind)
    return {
        kind: {
            "offered": round(statistics.mean(record.offered for record in own), 2),
            "planned": round(statistics.mean(record.planned for record in own), 2),
        }
        for kind, own in groups.items()
    }


def _results(records: Sequence[Record]) -> dict[str, Any]:
    ended = [record for record in records if record.ended is not None]
    groups = _grouped(ended, lambda record: record.job.kind)
    return {kind: spread((record.ended or 0.0) - record.job.at for record in own) for kind, own in groups.items()}
