"""Simulation of a GPU fleet under a simulated clock, with the service's own queue, fairness, leases and packing.

python -m benchmarks.fleet [--gpus 1000] [--hours 6] [--load 0.9]
python -m benchmarks.fleet --database [--queued 10000]

The simulation reports GPU utilization, how long jobs wait by size and by API key, and the cost of host failures. With
`--database`, it instead measures the load on one PostgreSQL server, by executing real dispatchers' statements on a long
queue. Only the jobs (`benchmarks.fleet_parts.demand`) and the passage of time
(`benchmarks.fleet_parts.simulation`) are simulated.
"""

from __future__ import annotations

import argparse
import json
import math
import tempfile
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks.fleet_parts.demand import Demand
from benchmarks.fleet_parts.figures import figures
from benchmarks.fleet_parts.simulation import Fleet
from benchmarks.machine import RESULTS, write_result

_MEMORY = Path("/dev/shm")
_GPUS_EACH = 8


def simulate(demand: Demand, hours: float, host_days: float, seed: int, patience: float = math.inf) -> dict[str, Any]:
    """Simulate a fleet with eight GPUs per host, and return its figures; the first quarter of `hours` is warm-up."""
    seconds = hours * 3600
    started = time.perf_counter()
    with tempfile.TemporaryDirectory(dir=_MEMORY if _MEMORY.is_dir() else None, prefix="sgsst-fleet-") as folder:
        fleet = Fleet(Path(folder), max(demand.gpus // _GPUS_EACH, 1), _GPUS_EACH, host_days, seed)
        warm_up = seconds / 4
        seconds = fleet.run(demand.jobs(hours, seed), seconds, warm_up, patience)
        measured = figures(fleet, seconds, warm_up)
        fleet.store.close()
    description = {
        "hours": hours,
        "simulated_hours": round(seconds / 3600, 2),
        "host_days": host_days,
        "seed": seed,
        **asdict(demand),
    }
    statements = {what: round(count / fleet.calls[what], 1) for what, count in sorted(fleet.statements.items()) if what}
    calls = {what: round(count / seconds, 3) for what, count in sorted(fleet.calls.items())}
    took = {"simulated_in_seconds": round(time.perf_counter() - started)}
    return {"demand": description, **measured, "statements_of": statements, "a_second": calls, **took}


def _stored() -> dict[str, Any]:
    """Return the results of earlier runs, without the machine description, which each run writes again."""
    path = RESULTS / "fleet.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    return {name: known[name] for name in ("simulated", "database") if name in known}


def main() -> None:
    """Simulate or measure, then print and store the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--gpus", type=int, default=1000)
    parser.add_argument("--hours", type=float, default=6.0)
    parser.add_argument("--load", type=float, default=0.9, help="GPU seconds asked for, over those that there are")
    parser.add_argument("--host-days", type=float, default=30.0, help="mean days between failures of a host")
    parser.add_argument("--patience", type=float, default=math.inf, help="seconds to simulate for, at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--name", default="usual", help="of the run, among those that are stored")
    parser.add_argument("--database", action="store_true", help="measure PostgreSQL instead")
    parser.add_argument("--queued", type=int, default=10_000, help="jobs of 50 keys in the queue that is measured")
    arguments = parser.parse_args()
    if arguments.database:
        from benchmarks.fleet_parts.database import measure

        measured = measure(arguments.queued, arguments.gpus, arguments.gpus // _GPUS_EACH)
        stored = _stored() | {"database": measured}
    else:
        demand = Demand(arguments.gpus, arguments.load)
        measured = simulate(demand, arguments.hours, arguments.host_days, arguments.seed, arguments.patience)
        stored = _stored()
        stored["simulated"] = stored.get("simulated", {}) | {arguments.name: measured}
    print(json.dumps(measured, indent=1))
    print(write_result("fleet", stored))


if __name__ == "__main__":
    main()
