"""Random kills of ranks, Ray processes and the driver of small jobs: cost of each fault, and correctness of results.

python -m benchmarks.faults [--faults 33] [--drivers 3] [--seed 0]

Jobs run on two ranks on this machine, with one fault per attempt and several attempts per job. The results in
benchmarks/results/faults.json are the kind of each fault, the number of steps lost, the seconds until the next step,
and the final loss of each job compared with that of an undisturbed job.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import psutil

from benchmarks.machine import write_result
from sgsst_core.progress import Progress
from tests.worker.ranks.faults import Fault, FaultyRank, Place, fired, folders, forget, shared_memory, small_request
from worker.job import JobSpec
from worker.ranks.cluster import Cluster
from worker.ranks.driver import stylize_on_ranks
from worker.ranks.rank import WorkerOptions
from worker.run import Ended, Listener

STEPS = 250
#: Number of faults per job. An attempt makes a few dozen steps before its fault.
FAULTS_A_JOB = 9
CHECKPOINT_SECONDS, RANK_TIMEOUT = 0.5, 5.0
#: Of ten faults: number that suspend a rank (SIGSTOP) instead of killing it, and number that kill a Ray process.
STOPPED, DAEMONS = 2, 1


@dataclass(frozen=True)
class DaemonFault:
    """Kill of one of Ray's own processes after a number of progress reports."""

    daemon: str
    reports: int


def random_faults(chance: random.Random) -> Iterator[Fault | DaemonFault]:
    """Yield random faults that cycle through all functions in which a fault can be injected."""
    for number, place in enumerate(itertools.cycle(get_args(Place))):
        if number % 10 < DAEMONS:
            yield DaemonFault(chance.choice(["raylet", "gcs_server"]), chance.randint(3, 12))
            continue
        what: Literal["SIGKILL", "SIGSTOP"] = "SIGSTOP" if chance.random() < STOPPED / 10 else "SIGKILL"
        rank = 0 if place == "checkpoint" else chance.randint(0, 1)
        # These functions are called less often: a checkpoint twice a second, `all_gather` only during preparation.
        call = chance.randint(*{"checkpoint": (2, 5), "all_gather": (2, 8)}.get(place, (20, 60)))
        # Half of the faults happen immediately, the others during an operation that takes some milliseconds.
        yield Fault(rank, place, call, what, chance.choice([0.0, chance.uniform(0, 0.005)]))


class Chaos:
    """Injector of faults into a job, one per attempt, that records their effects.

    Args:
        request: Job.
        cluster: Ray cluster that runs it.
        faults: Queue of faults; a fault that has not occurred when the job ends is put back.
    """

    def __init__(self, request: JobSpec, cluster: Cluster, faults: list[Fault | DaemonFault]) -> None:
        self._request = request
        self._cluster = cluster
        self._faults = faults
        self._current: Fault | DaemonFault | None = None
        self._reports = 0
        self._at: float | None = None  # time of the current fault in seconds since the epoch
        self.injected: list[dict[str, Any]] = []
        self._arm()

    def run(self) -> Ended:
        """Run the job to its end."""
        options = WorkerOptions(RANK_TIMEOUT, CHECKPOINT_SECONDS, actor=FaultyRank)
        listener = Listener(progress=self._progress, happened=self._happened)
        ended = stylize_on_ranks(self._request, 2, listener, options=options, cluster=self._cluster)
        if self._current is not None:
            self._faults.append(self._current)
        for entry, attempt in zip(self.injected, ended.attempts, strict=True):
            entry.pop("at", None)  # still present if the next fault occurred before the job made a step
            entry |= {
                "reason": attempt.reason,
                "steps_lost": attempt.last_step - attempt.saved_step,
                "seconds_lost": attempt.seconds_lost,
            }
        return ended

    def _arm(self) -> None:
        self._current, self._at, self._reports = None, None, 0
        if len(self.injected) < FAULTS_A_JOB and self._faults:
            self._current = self._faults.pop(0)
        if isinstance(self._current, Fault):
            self._current.write(self._request)

    def _progress(self, progress: Progress) -> None:
        self._reports += 1
        if isinstance(self._current, DaemonFault) and self._at is None and self._reports >= self._current.reports:
            self._at = time.time()
            next(child for child in psutil.Process().children() if child.name() == self._current.daemon).kill()

    def _happened(self, line: str) -> None:
        print(f"  {line}", flush=True)
        if line.startswith("Going on"):
            self.injected[-1]["seconds_to_running"] = round(time.time() - self.injected[-1].pop("at"), 2)
            return
        if isinstance(self._current, Fault):
            at = fired(self._request)
            self._at = None if at is None else at + self._current.delay
        if self._current is None or self._at is None:  # not an injected fault: a rank responded late on a busy machine
            self.injected.append({"fault": {"what": "none"}, "at": time.time()})
            return
        self.injected.append({"fault": asdict(self._current), "at": self._at})
        forget(self._request)
        self._arm()


def kill_driver(folder: Path, chance: random.Random) -> dict[str, Any]:
    """Kill the `sgsst` command after a random time, then run it again; resume if there is a checkpoint."""
    request = small_request(folder, STEPS)
    source = request.source
    arguments = ["stylize", str(source.scene), "--cameras", str(source.cameras), "--style", str(request.styles[0].path)]
    arguments += ["--out", str(request.out), "--backbone", "vgg16", "--steps-sos", "60", "--no-early-stop"]
    arguments += ["--workers", "2", "--checkpoint-seconds", str(CHECKPOINT_SECONDS)]
    command = [sys.executable, "-m", "api.cli", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    while not process.stdout.readline().startswith("schedule"):
        pass
    delay = chance.uniform(0, 5)
    time.sleep(delay)
    family = psutil.Process(process.pid).children(recursive=True)
    shared, used = shared_memory(family), folders(family)
    process.send_signal(signal.SIGKILL)
    started = time.monotonic()
    process.wait()
    _, alive = psutil.wait_procs(family, timeout=30)
    seconds = time.monotonic() - started
    time.sleep(2)  # Ray deletes its folder last
    saved = request.out.with_name("s.checkpoint.safetensors").exists()
    again = subprocess.run([*command, *(["--resume"] if saved else [])], capture_output=True, text=True)
    return {
        "seconds_after_schedule": round(delay, 2),
        "processes_left": len(alive),
        "folders_left": sorted(str(path) for path in used if path.exists()),
        "shared_memory_left": sorted(str(path) for path in shared if path.exists()),
        "seconds_until_all_gone": round(seconds, 2),
        "saved": saved,
        "exit_code_of_next": again.returncode,
        "scene_written": request.out.exists(),
    }


def main() -> None:
    """Run all jobs, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--faults", type=int, default=33)
    parser.add_argument("--drivers", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    chance = random.Random(arguments.seed)
    faults = list(itertools.islice(random_faults(chance), arguments.faults))
    os.environ["PYTHONPATH"] = os.pathsep.join([str(Path.cwd()), os.environ.get("PYTHONPATH", "")])
    outcomes: list[dict[str, Any]] = []
    jobs: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as name:
        drivers = [kill_driver(Path(name) / f"driver_{number}", chance) for number in range(arguments.drivers)]
        print(json.dumps(drivers, indent=1))
        with Cluster(2) as cluster:
            request = small_request(Path(name) / "undisturbed", STEPS)
            loss = _loss(Chaos(request, cluster, []).run())
            content = request.out.read_bytes()
            while faults:
                request = small_request(Path(name) / f"job_{len(jobs)}", STEPS)
                chaos = Chaos(request, cluster, faults)
                ended = chaos.run()
                outcomes += chaos.injected
                difference = abs(_loss(ended) / loss - 1)
                same = request.out.read_bytes() == content
                jobs.append({"faults": len(chaos.injected), "loss_relative_error": difference, "same_file": same})
                print(json.dumps(jobs[-1]), flush=True)
                if not chaos.injected:
                    sys.exit("No fault has happened in a whole job.")
    killed = [entry for entry in outcomes if entry["fault"].get("what") == "SIGKILL" and "seconds_to_running" in entry]
    seconds = sorted(entry["seconds_to_running"] for entry in killed)
    figures = {
        "job": {"steps": STEPS, "ranks": 2, "view": "64x48", "checkpoint_seconds": CHECKPOINT_SECONDS},
        "rank_timeout": RANK_TIMEOUT,
        "loss_of_undisturbed": loss,
        "seconds_to_running_after_sigkill": {"median": seconds[len(seconds) // 2], "most": seconds[-1]},
        "jobs": jobs,
        "faults": outcomes,
        "drivers": drivers,
    }
    print(write_result("faults", figures))


def _loss(ended: Ended) -> float:
    assert ended.result is not None
    assert ended.result.loss_after is not None
    return ended.result.loss_after


if __name__ == "__main__":
    main()
