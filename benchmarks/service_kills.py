"""Random SIGKILLs of the service's processes while it runs a queue of small jobs.

python -m benchmarks.service_kills

`sgsst serve` runs with default settings except for `SETTINGS`. The benchmark counts accepted jobs that do not succeed
(lost), results that are announced or stored twice (published twice), and PLY files that are not bit-identical to that
of `sgsst stylize` with the same seed (different). A job on two ranks adds numbers in a different order, so its colors
are compared with those of a one-rank job within a tolerance.
"""

import argparse
import contextlib
import json
import random
import secrets
import signal
import statistics
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx2

from benchmarks.common import parse, write_result
from sgsst_core.files.scene_file import read_scene
from tests.api.service import Service, undisturbed
from tests.small_scenes import wall, write_files

PARAMETERS = {"preset": "standard", "steps_sos": 60, "backbone": "vgg16", "early_stop": False}
SEEDS = (1, 2)
#: Steps of the job on two ranks: enough that it still runs when all kills are done.
RANK_STEPS = 200
#: Settings with which killed attempts neither make the service give up on a job nor lengthen its retry delays.
SETTINGS: dict[str, Any] = {
    "SGSST_LEASE_SECONDS": "30",
    "SGSST_MAX_ATTEMPTS": "1000000",
    "SGSST_RETRY_SECONDS": "0",
    "SGSST_CHECKPOINT_SECONDS": "1",
    "SGSST_POLL_SECONDS": "0.5",
}
API, DISPATCHER, ATTEMPT, RANK = (
    "api.http.server",
    "service.scheduling.dispatcher",
    "service.scheduling.attempt_process",
    "ray::RankProcess",
)
EVERYTHING = "sgsst serve"
#: Mean seconds between two kills of one kind.
EVERY = {API: 9.0, DISPATCHER: 30.0, ATTEMPT: 30.0, EVERYTHING: 120.0}
FINISHED = ("succeeded", "failed", "canceled", "expired")
#: Seconds until a request that nothing answers, or a job that does not end, counts as lost.
PATIENCE = 900.0
#: Number of unfinished jobs to maintain, of kills at random, and of kills of a rank.
_QUEUE, _KILLS, _RANK_KILLS = 2, 100, 6
#: Seconds until files of killed attempts that remain after housekeeping count as published.
_SWEEP_SECONDS = 180.0


@dataclass
class Attacked:
    """Service under attack, and the jobs that it has accepted.

    Attributes:
        urls: Addresses of its API processes.
        files: Input files of all jobs by role.
        parameters: Parameters of all jobs.
        accepted: Parameters in which each accepted job differs from the others, by job id.
    """

    urls: list[str]
    files: dict[str, Path]
    parameters: dict[str, Any]
    accepted: dict[str, dict[str, Any]] = field(default_factory=dict)

    def call(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """Send a request to any API process that responds; retry while none does.

        Raises:
            RuntimeError: If none responds in time.
        """
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            for url in self.urls:
                with contextlib.suppress(httpx2.TransportError):
                    answer = httpx2.request(method, f"{url}{path}", timeout=15, trust_env=False, **options)
                    if answer.status_code < 500:
                        return answer
            time.sleep(0.05)
        raise RuntimeError(f"{method} {path} was never answered")

    def jobs(self) -> list[dict[str, Any]]:
        """Return all jobs that the service lists, which one page holds."""
        submitted: list[dict[str, Any]] = self.call("GET", "/v1/jobs", params={"limit": 200}).json()["jobs"]
        return submitted

    def waiting(self) -> int:
        """Return the number of jobs that have not ended."""
        return sum(job["status"] not in FINISHED for job in self.jobs())

    def submit(self, **parameters: Any) -> str:
        """Submit a job and return its id."""
        body = {role: (path.name, path.read_bytes()) for role, path in self.files.items()}
        data = {"parameters": json.dumps(self.parameters | parameters)}
        headers = {"Idempotency-Key": secrets.token_hex(8)}
        answer = self.call("POST", "/v1/jobs", files=body, data=data, headers=headers)
        if answer.status_code != 202:
            raise RuntimeError(f"a good job was refused: {answer.text}")
        job_id = str(answer.json()["id"])
        self.accepted[job_id] = parameters
        return job_id

    def wait_for_all(self) -> dict[str, dict[str, Any]]:
        """Wait until all accepted jobs have ended or time is up, and return the last status of each existing job."""
        deadline = time.monotonic() + PATIENCE
        finished: dict[str, dict[str, Any]] = {}
        while time.monotonic() < deadline:
            for job_id in self.accepted:
                if finished.get(job_id, {}).get("status") not in FINISHED:
                    answer = self.call("GET", f"/v1/jobs/{job_id}")
                    if answer.status_code == 200:
                        finished[job_id] = answer.json()
            if all(finished.get(job_id, {}).get("status") in FINISHED for job_id in self.accepted):
                break
            time.sleep(0.5)
        return finished

    def published(self, job_id: str) -> int:
        """Return the number of events that announce a job's result."""
        text = self.call("GET", f"/v1/jobs/{job_id}/events").text
        return max(text.count('"name": "stylized.ply"'), text.count('"status": "succeeded"'))

    def result(self, job_id: str) -> bytes:
        """Download a job's PLY."""
        return self.call("GET", f"/v1/jobs/{job_id}/artifacts/stylized.ply").content

    def distance(self, job_id: str, expected: Path, folder: Path) -> float:
        """Return the distance of a job's colors from the expected ones, relative to the change by the job."""
        (folder / "result.ply").write_bytes(self.result(job_id))
        paths = (folder / "result.ply", expected, self.files["scene"])
        result, wanted, before = (read_scene(path).scene.sh_dc for path in paths)
        return float((result - wanted).norm() / (wanted - before).norm())


@dataclass
class Run(Attacked):
    """Service whose processes are killed, and the figures collected."""

    service: Service = field(kw_only=True)
    kills: Counter[str] = field(default_factory=Counter)
    api_back: list[float] = field(default_factory=list)
    running_again: list[float] = field(default_factory=list)

    def active(self) -> dict[str, Any] | None:
        """Return the job in progress, or None."""
        return next((job for job in self.jobs() if job["status"] in ("starting", "running")), None)

    def fill(self) -> None:
        """Submit jobs until the queue is full."""
        for _ in range(_QUEUE - self.waiting()):
            self.submit(seed=SEEDS[len(self.accepted) % len(SEEDS)])

    def strike(self, target: str, chance: random.Random) -> None:
        """Kill one process, and measure the recovery."""
        if target == EVERYTHING:
            self.service.stop(signal.SIGKILL)
            self.service.start()
        else:
            before = self.active() if target == DISPATCHER else None
            if not self.kill(target, chance):
                return
            struck = time.monotonic()
            if target == API:
                self.call("GET", "/v1/jobs", params={"limit": 1})
                self.api_back.append(time.monotonic() - struck)
            elif before is not None and chance.random() < 0.6:  # otherwise, the next kill may precede the job's start
                self._measure(before, struck)
        self.kills[target] += 1

    def _measure(self, before: Mapping[str, Any], struck: float) -> None:
        """Wait until an interrupted job continues to make steps, and record the time."""
        while time.monotonic() - struck < PATIENCE:
            job = self.call("GET", f"/v1/jobs/{before['id']}").json()
            if job["status"] in FINISHED:
                return  # the job had finished when the dispatcher died
            if job["attempt"] > before["attempt"] and job["status"] == "running":
                self.running_again.append(time.monotonic() - struck)
                return
            time.sleep(0.1)

    def kill(self, target: str, chance: random.Random) -> bool:
        """Send SIGKILL to a random process of a kind; return False if none appears in time."""
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            processes = self.service.processes(target)
            if processes:
                with contextlib.suppress(Exception):
                    chance.choice(processes).send_signal(signal.SIGKILL)
                    return True
            time.sleep(0.01)
        return False


def attack(run: Run, chance: random.Random) -> None:
    """Kill processes at random moments."""
    due = {target: time.monotonic() + chance.expovariate(1 / mean) for target, mean in EVERY.items()}
    while sum(run.kills.values()) < _KILLS:
        run.fill()
        target = min(due, key=lambda name: due[name])
        time.sleep(max(0.0, due[target] - time.monotonic()))
        run.strike(target, chance)
        due[target] = time.monotonic() + chance.expovariate(1 / EVERY[target])
        done = sum(run.kills.values())
        if done % 10 == 0:
            print(f"{done} kills, {len(run.accepted)} jobs accepted", flush=True)


def attack_ranks(run: Run, chance: random.Random) -> str:
    """Run a job on two ranks, kill one of them repeatedly, and return the job's id."""
    job_id = run.submit(seed=SEEDS[0], workers=2, steps_sos=RANK_STEPS)
    reached = 0
    while run.kills[RANK] < _RANK_KILLS:
        job = run.call("GET", f"/v1/jobs/{job_id}").json()
        if job["status"] in FINISHED:
            break
        progress = job["progress"] or {}
        step = 0 if progress.get("stage") in ("planning", "starting") else progress.get("step") or 0
        if step > reached:
            reached = step
            time.sleep(chance.uniform(0, 2))
            run.kills[RANK] += run.kill(RANK, chance)
        time.sleep(0.1)
    return job_id


def published(run: Run, job_id: str) -> int:
    """Return how often a job's result was announced or stored on disk, whichever is more, after housekeeping."""
    folder, deadline = run.service.data / "artifacts" / job_id, time.monotonic() + _SWEEP_SECONDS
    while (stored := len(list(folder.rglob("stylized.ply")))) > 1 and time.monotonic() < deadline:
        time.sleep(1)
    return max(run.published(job_id), stored)


def spread(values: list[float]) -> dict[str, float | int | None]:
    """Return count, median and maximum."""
    return {
        "measured": len(values),
        "median": round(statistics.median(values), 2) if values else None,
        "largest": round(max(values), 2) if values else None,
    }


def main() -> None:
    """Run the benchmark, then print and store the figures."""
    parse(argparse.ArgumentParser(description=__doc__))
    with tempfile.TemporaryDirectory(prefix="sgsst-kills-") as name:
        figures = measure(Path(name), random.Random(0))
    print(json.dumps(figures, indent=2))
    print(write_result("service_kills", figures))
    sys.exit(bool(figures["lost"] or figures["published_twice"] or figures["different"]))


def measure(folder: Path, chance: random.Random) -> dict[str, Any]:
    """Run the service while killing its processes, and return all figures."""
    for part in ("inputs", "long", *map(str, SEEDS)):
        (folder / part).mkdir()
    ply, cameras, style = write_files(folder / "inputs", wall())
    files = {"scene": ply, "cameras": cameras, "style": style}
    expected = {seed: undisturbed(files, {**PARAMETERS, "seed": seed}, folder / str(seed)) for seed in SEEDS}
    one_rank = undisturbed(files, {**PARAMETERS, "seed": SEEDS[0], "steps_sos": RANK_STEPS}, folder / "long")
    started = time.monotonic()
    with Service(folder / "data", **SETTINGS) as service:
        run = Run([service.url], files, PARAMETERS, service=service)
        attack(run, chance)
        attacked = time.monotonic() - started
        on_ranks = attack_ranks(run, chance)
        jobs = run.wait_for_all()
        ended = [job_id for job_id in run.accepted if jobs.get(job_id, {}).get("status") == "succeeded"]
        alike = {job_id: expected[run.accepted[job_id]["seed"]] for job_id in ended if job_id != on_ranks}
        return {
            "kills": dict(run.kills),
            "kills_in_all": sum(run.kills.values()),
            "seconds": round(attacked, 1),
            "jobs_accepted": len(run.accepted),
            "lost": len(run.accepted) - len(ended),
            "published_twice": sum(published(run, job_id) != 1 for job_id in ended),
            "different": sum(run.result(job_id) != path.read_bytes() for job_id, path in alike.items()),
            "seconds_until_the_api_answers": spread(run.api_back),
            "seconds_until_a_job_runs_again_after_a_dispatchers_death": spread(run.running_again),
            "not_succeeded": [job.get("error") for job in jobs.values() if job["status"] != "succeeded"],
            "two_ranks_from_one": run.distance(on_ranks, one_rank, folder) if on_ranks in ended else None,
        }


if __name__ == "__main__":
    main()
