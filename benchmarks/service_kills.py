"""Processes of the service killed at random moments: `python -m benchmarks.service_kills [KILLS] [OUT.json]`.

Jobs run one after the other; meanwhile API, dispatcher and the process of the attempt get SIGKILL. Counted are jobs
that were accepted, lost, published twice, and that ended with another file than an undisturbed one.
"""

from __future__ import annotations

import hashlib
import json
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import httpx

from benchmarks.machine import describe_machine
from tests.api.service import Service, wait_for
from tests.small_scenes import wall, write_files

VICTIMS = ("api.server", "service.dispatcher", "service.attempt_process")
#: Kills of one job at most: each costs an attempt, of which the service here allows plenty.
KILLS_OF_A_JOB = 4
PARAMETERS = {"steps_sos": 80, "backbone": "vgg16", "early_stop": False}


def patiently(client: httpx.Client, method: str, path: str, **options: Any) -> httpx.Response:
    """A request that is sent again while the API is started again."""
    while True:
        try:
            return client.request(method, path, **options)
        except httpx.TransportError:
            time.sleep(0.2)


def run_job(service: Service, client: httpx.Client, files: dict[str, Any], kills: int, counts: Counter[str]) -> str:
    """One job from submission to its end, with so many kills; returns the digest of its result."""
    key = {"Idempotency-Key": str(random.random())}
    data = {"parameters": json.dumps(PARAMETERS)}
    answer = patiently(client, "POST", "/v1/jobs", files=files, data=data, headers=key)
    answer.raise_for_status()
    counts["accepted"] += 1
    where = f"/v1/jobs/{answer.json()['id']}"
    for _ in range(kills):
        time.sleep(random.uniform(0, 12))
        victim = random.choice(VICTIMS)
        process = service.process(victim)
        if process is None:
            continue
        process.kill()
        counts[f"killed {victim}"] += 1
        started = time.monotonic()
        if victim == "api.server":
            wait_for(service.ready, "the API")
            counts["slowest return of the API, ms"] = max(
                counts["slowest return of the API, ms"], round(1e3 * (time.monotonic() - started))
            )

    def ended() -> dict[str, Any] | None:
        found: dict[str, Any] = patiently(client, "GET", where).json()
        return found if found["status"] in ("succeeded", "failed") else None

    found = wait_for(ended, where, service.said)
    counts[found["status"]] += 1
    counts["attempts"] += found["attempt"]
    published = list((service.data / "artifacts" / found["id"]).rglob("stylized.ply"))
    counts["published twice"] += len(published) > 1
    return hashlib.sha256(patiently(client, "GET", f"{where}/artifacts/stylized.ply").content).hexdigest()


def main() -> None:
    """Kill as often as asked, and print the counts."""
    wanted = int(sys.argv[1]) if sys.argv[1:] else 100
    counts: Counter[str] = Counter()
    random.seed(1)
    with tempfile.TemporaryDirectory() as name:
        paths = write_files(Path(name), wall())
        files = {role: path.read_bytes() for role, path in zip(("scene", "cameras", "style"), paths, strict=True)}
        with Service(Path(name) / "data", SGSST_MAX_ATTEMPTS="100") as service, service.client() as client:
            undisturbed = run_job(service, client, files, 0, counts)
            while (done := sum(number for key, number in counts.items() if key.startswith("killed"))) < wanted:
                digest = run_job(service, client, files, random.randint(1, min(KILLS_OF_A_JOB, wanted - done)), counts)
                counts["another result"] += digest != undisturbed
                print(dict(counts), flush=True)
    counts["lost"] = counts["accepted"] - counts["succeeded"] - counts["failed"]
    found = {"machine": describe_machine(), "kills": wanted, "counts": dict(sorted(counts.items()))}
    print(json.dumps(found, indent=2))
    if sys.argv[2:]:
        Path(sys.argv[2]).write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
