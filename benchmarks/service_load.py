"""What the service carries while a job is running: `python -m benchmarks.service_load [OUT.json]`.

Submissions by reference to uploads, status requests at a steady rate, watchers of one job, and the API's memory while a
large file comes in. Everything runs on this machine, the load's sender too, and takes its share of the processor.
"""

from __future__ import annotations

import asyncio
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks.machine import describe_machine
from tests.api.service import Service
from tests.small_scenes import wall, write_files

SUBMISSIONS, RATE, SECONDS, WATCHERS, UPLOAD = 300, 200, 20, 1000, 2_000_000_000


def upload(client: httpx.Client, path: Path) -> str:
    """A file as an upload; its id."""
    made = client.post("/v1/uploads", headers={"Upload-Length": str(path.stat().st_size)}).json()
    headers = {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    client.patch(f"/v1/uploads/{made['id']}", content=path.read_bytes(), headers=headers).raise_for_status()
    return str(made["id"])


def reference(client: httpx.Client, folder: Path) -> dict[str, Any]:
    """The body of a submission that names uploads."""
    ply, _, style = write_files(folder, wall())
    parameters = {"orbit": 4, "resolution": 64, "backbone": "vgg16", "steps_sos": 1_000_000, "early_stop": False}
    return {"scene": upload(client, ply), "style": upload(client, style), "parameters": parameters}


async def submissions(url: str, body: dict[str, Any]) -> dict[str, float]:
    """Eight clients that submit as fast as they can."""
    left = iter(range(SUBMISSIONS))

    async def one(client: httpx.AsyncClient) -> None:
        for _ in left:
            (await client.post("/v1/jobs", json=body)).raise_for_status()

    async with httpx.AsyncClient(base_url=url, timeout=60) as client:
        started = time.perf_counter()
        await asyncio.gather(*(one(client) for _ in range(8)))
        return {"per_second": round(SUBMISSIONS / (time.perf_counter() - started), 1)}


async def statuses(url: str, job_id: str) -> dict[str, float]:
    """Requests at a steady rate, each timed from when it was due."""
    times: list[float] = []

    async def ask(client: httpx.AsyncClient, due: float) -> None:
        await asyncio.sleep(max(0.0, due - time.perf_counter()))
        (await client.get(f"/v1/jobs/{job_id}")).raise_for_status()
        times.append(time.perf_counter() - due)

    limits = httpx.Limits(max_connections=50, max_keepalive_connections=50)
    async with httpx.AsyncClient(base_url=url, timeout=60, limits=limits) as client:
        started = time.perf_counter() + 1
        await asyncio.gather(*(ask(client, started + number / RATE) for number in range(RATE * SECONDS)))
    cuts = statistics.quantiles(times, n=100)
    return {"rate": RATE, "median_ms": round(1e3 * cuts[49], 1), "p99_ms": round(1e3 * cuts[98], 1)}


async def watchers(url: str, job_id: str) -> dict[str, float]:
    """Streams that all get the same event: how many do, and how far apart."""
    seen: list[float] = []
    enough = asyncio.Event()

    async def watch(client: httpx.AsyncClient) -> None:
        async with client.stream("GET", f"/v1/jobs/{job_id}/events", timeout=120) as stream:
            async for line in stream.aiter_lines():
                if line.startswith("data:") and '"canceling"' in line:
                    seen.append(time.perf_counter())
                    if len(seen) == WATCHERS:
                        enough.set()
                    return

    limits = httpx.Limits(max_connections=WATCHERS + 10)
    async with httpx.AsyncClient(base_url=url, timeout=120, limits=limits) as client:
        tasks = [asyncio.create_task(watch(client)) for _ in range(WATCHERS)]
        await asyncio.sleep(20)
        started = time.perf_counter()
        (await client.post(f"/v1/jobs/{job_id}/cancel")).raise_for_status()
        await asyncio.wait_for(enough.wait(), 60)
        for task in tasks:
            task.cancel()
    return {"watchers": len(seen), "last_after_s": round(max(seen) - started, 2)}


def memory(service: Service) -> dict[str, float]:
    """The API's growth while an upload comes in, in bytes."""
    process = service.process("api.server")
    assert process is not None
    before = largest = process.memory_info().rss
    block = bytes(1 << 20)

    def body() -> Iterator[bytes]:
        nonlocal largest
        left = UPLOAD
        while left:
            part = block[: min(left, len(block))]
            left -= len(part)
            largest = max(largest, psutil.Process(process.pid).memory_info().rss)
            yield part

    with service.client() as client:
        made = client.post("/v1/uploads", headers={"Upload-Length": str(UPLOAD)}).json()
        headers = {
            "Upload-Offset": "0",
            "Content-Type": "application/offset+octet-stream",
            "Content-Length": str(UPLOAD),
        }
        started = time.perf_counter()
        answer = client.patch(f"/v1/uploads/{made['id']}", content=body(), headers=headers, timeout=600)
        answer.raise_for_status()
        seconds = time.perf_counter() - started
        client.delete(f"/v1/uploads/{made['id']}")
    return {"bytes": UPLOAD, "growth_mb": round((largest - before) / 1e6, 1), "seconds": round(seconds, 1)}


def main() -> None:
    """Run everything and print it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        limits = {"SGSST_MAX_JOBS_PER_KEY": "100000", "SGSST_LEASE_SECONDS": "60", "SGSST_LOG_FORMAT": "json"}
        with Service(folder / "data", **limits) as service, service.client() as client:
            body = reference(client, folder)
            job_id = client.post("/v1/jobs", json=body).json()["id"]
            while client.get(f"/v1/jobs/{job_id}").json()["status"] != "running":
                time.sleep(0.5)
            found: dict[str, Any] = {"machine": describe_machine(), "a_job_is_running": True}
            found["status_requests"] = asyncio.run(statuses(service.url, job_id))
            found["submissions"] = asyncio.run(submissions(service.url, body))
            found["upload"] = memory(service)
            found["event_streams"] = asyncio.run(watchers(service.url, job_id))
    text = json.dumps(found, indent=2)
    print(text)
    if sys.argv[1:]:
        Path(sys.argv[1]).write_text(text + "\n")


if __name__ == "__main__":
    main()
