"""Tests of a small simulated fleet: no job is lost or waits forever, and equal seeds give equal results."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet import simulate
from benchmarks.fleet_parts.demand import KINDS, Demand, SimulatedJob
from benchmarks.fleet_parts.simulation import Fleet
from service.states import JobStatus


def job(at: float, owner: str, factor: float = 1.0, **parameters: Any) -> SimulatedJob:
    options = {"preset": "paper", "resolution": 980, **parameters}
    return SimulatedJob(at, owner, "paper", options, 248_000_000, factor)


def test_demand_matches_load_and_is_reproducible() -> None:
    demand = Demand(1000, load=0.9)
    jobs = demand.jobs(2.0, seed=3)
    assert jobs == demand.jobs(2.0, seed=3)
    assert len(jobs) == round(200_000 / 12)
    asked = sum(each.seconds(1) + each.start_seconds() for each in jobs)
    assert asked / (2 * 3600 * 1000) == pytest.approx(0.9, abs=0.12)
    assert {each.kind for each in jobs} == {kind.name for kind in KINDS}
    assert sum(each.owner == "key_000" for each in jobs) == round(0.05 * len(jobs))


def test_small_fleet_serves_its_demand_reproducibly() -> None:
    measured = simulate(Demand(16, load=0.8, keys=20), hours=0.5, host_days=1000, seed=1)
    assert measured["jobs"] == measured["attempts"] == round(200_000 * 0.016 / 48)
    assert measured["ended"] > 0.7 * measured["jobs"]
    assert 0.4 < measured["utilization"] <= 1
    assert measured["starved"] == measured["host_failures"] == measured["lost_gpu_hours"] == 0
    again = simulate(Demand(16, load=0.8, keys=20), hours=0.5, host_days=1000, seed=1)
    for figures in (measured, again):
        del figures["simulated_in_seconds"]
    assert again == measured


def test_failing_hosts_lose_time_but_no_jobs(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, hosts=3, gpus_each=2, host_days=0.02, seed=2)
    fleet.run([job(10.0 * number, f"key_{number % 3}") for number in range(12)], 40_000.0, 0.0)
    records = fleet.records.values()
    assert fleet.failures > 5
    assert sum(record.attempts for record in records) > len(records) == 12
    assert all(record.ended is not None for record in records)
    assert {job.row.status for job in fleet.store.jobs.page(None)} == {JobStatus.SUCCEEDED}
    assert all(0 < record.lost < record.held for record in records if record.attempts > 1)
    fleet.store.close()


@pytest.mark.slow
def test_whole_host_job_is_not_starved_and_others_run(tmp_path: Path) -> None:
    fleet = Fleet(tmp_path, hosts=3, gpus_each=4, host_days=1e9, seed=0)
    small = [job(float(number), "many", 0.2 + number % 5 / 2, workers=1) for number in range(60)]
    fleet.run([*small, job(5.5, "one", workers=4)], 20_000.0, 0.0)
    records = list(fleet.records.values())
    (big,) = [record for record in records if record.job.owner == "one"]
    assert big.offered == 4
    assert big.started is not None
    started = sorted(record.started or 0.0 for record in records if record.job.owner == "many")
    assert big.started < started[-20], "it is not overtaken for ever"
    assert sum(moment < big.started for moment in started) > 11, "nor do all hosts wait: two and a part were full"
    fleet.store.close()
