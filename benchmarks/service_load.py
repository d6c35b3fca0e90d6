"""What the API holds while a job is running on the same machine: submissions, status, watchers, a large upload.

python -m benchmarks.service_load [--upload-mb 2000] [--watchers 1000] [--seconds 20]

Aims: 100 submissions a second by reference to uploads; status at 200 requests a second with a 99th percentile under
50 ms; 1000 watchers of server-sent events; an API that grows by less than 64 MB during an upload of 2 GB. The client
runs on the same machine and takes a share of its processors: it is part of what is measured.
"""

from __future__ import annotations

import argparse
import asyncio
import base64
import contextlib
import json
import os
import statistics
import tempfile
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import httpx
import psutil

from benchmarks.machine import write_result
from tests.api.service import Service, wait_for
from tests.small_scenes import wall, write_files

#: A job that outlasts the benchmark; the others never get its place.
LONG = {"preset": "standard", "steps_sos": 1_000_000, "backbone": "vgg16", "early_stop": False}
SETTINGS = {
    "SGSST_LEASE_SECONDS": "30",
    "SGSST_POLL_SECONDS": "0.5",
    "SGSST_CHECKPOINT_SECONDS": "60",
    "SGSST_PREVIEW_SECONDS": "20",
    "SGSST_MAX_JOBS_PER_KEY": "1000000",
    "SGSST_MIN_FREE_BYTES": "1000000000",
}
_TUS = {"Tus-Resumable": "1.0.0"}
_API = "api.server"
_SUBMITTERS, _STATUS_CONNECTIONS = 16, 32
_PIECE = 1 << 20


async def upload(client: httpx.AsyncClient, path: Path) -> str:
    """The id of a small file's upload."""
    name = base64.b64encode(path.name.encode()).decode()
    length = str(path.stat().st_size)
    begun = await client.post(
        "/v1/uploads", headers=_TUS | {"Upload-Length": length, "Upload-Metadata": f"filename {name}"}
    )
    begun.raise_for_status()
    headers = _TUS | {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    (await client.patch(begun.headers["location"], content=path.read_bytes(), headers=headers)).raise_for_status()
    return str(begun.json()["id"])


async def submissions(
    client: httpx.AsyncClient, body: dict[str, Any], seconds: float, made: list[str]
) -> dict[str, Any]:
    """Jobs by reference to uploads, by some clients at once, as fast as they are accepted; their ids go into `made`."""
    took: list[float] = []
    refused = 0
    end = time.perf_counter() + seconds

    async def submit(number: int) -> None:
        nonlocal refused
        while time.perf_counter() < end:
            parameters = body["parameters"] | {"seed": number * 1_000_000 + len(made)}
            started = time.perf_counter()
            answer = await client.post("/v1/jobs", json=body | {"parameters": parameters})
            took.append(time.perf_counter() - started)
            if answer.status_code == 202:
                made.append(answer.json()["id"])
            else:
                refused += 1

    started = time.perf_counter()
    await asyncio.gather(*(submit(number) for number in range(_SUBMITTERS)))
    elapsed = time.perf_counter() - started
    return {"per_second": round(len(made) / elapsed, 1), "accepted": len(made), "refused": refused, **spread(took)}


async def at_a_rate(
    ask: Callable[[int], Awaitable[httpx.Response]], rate: float, seconds: float, good: tuple[int, ...] = (200, 304)
) -> dict[str, Any]:
    """Requests that are due at fixed moments, whether or not earlier ones have been answered.

    A request that waits for a free connection waits on our clock: the time counts from when it was due.
    """
    took: list[float] = []
    failed = 0
    start = time.perf_counter()

    async def one(number: int) -> None:
        nonlocal failed
        due = start + number / rate
        await asyncio.sleep(due - time.perf_counter())
        try:
            answer = await ask(number)
            failed += answer.status_code not in good
        except httpx.TransportError:
            failed += 1
        took.append(time.perf_counter() - due)

    await asyncio.gather(*(one(number) for number in range(int(rate * seconds))))
    elapsed = time.perf_counter() - start
    return {
        "rate": rate,
        "requests": len(took),
        "answered_per_second": round(len(took) / elapsed, 1),
        "failed": failed,
        **spread(took),
    }


async def with_processor(api: psutil.Process, work: Awaitable[dict[str, Any]], count: str) -> dict[str, Any]:
    """Figures with the API's own processor time for each request, which other work on the machine does not change."""
    before = api.cpu_times()
    figures = await work
    after = api.cpu_times()
    used = after.user + after.system - before.user - before.system
    return {**figures, "api_cpu_ms_each": round(1000 * used / max(1, figures[count]), 2)}


async def watch(url: str, job_id: str, count: int, seconds: float, api: psutil.Process) -> dict[str, Any]:
    """Watchers of one running job: how many are connected, and how late they learn what happens."""
    before = api.memory_info().rss
    late: list[float] = []
    events = [0] * count
    connected = 0
    limits = httpx.Limits(max_connections=None, max_keepalive_connections=0)
    async with httpx.AsyncClient(base_url=url, limits=limits, timeout=httpx.Timeout(60, read=None)) as client:

        async def one(number: int) -> None:
            nonlocal connected
            await asyncio.sleep(number / 200)  # not all of them in one moment
            async with client.stream("GET", f"/v1/jobs/{job_id}/events") as stream:
                stream.raise_for_status()
                connected += 1
                async for data in _events(stream):
                    if "updated_at" in data and data["updated_at"] > opened:
                        events[number] += 1
                        late.append(time.time() - data["updated_at"])

        tasks = [asyncio.create_task(one(number)) for number in range(count)]
        deadline = time.monotonic() + 120
        opened = float("inf")  # events of the past do not count
        while connected < count and time.monotonic() < deadline and not any(task.done() for task in tasks):
            await asyncio.sleep(0.1)
        opened = time.time()
        grown = api.memory_info().rss - before
        await asyncio.sleep(seconds)
        alive = sum(not task.done() for task in tasks)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return {
        "wanted": count,
        "connected": connected,
        "still_connected": alive,
        "api_grown_mb": round(grown / 1e6, 1),
        "events_received": sum(events),
        "watchers_without_an_event": sum(not each for each in events),
        "delay": spread(late) if late else None,
    }


async def _events(stream: httpx.Response) -> AsyncIterator[dict[str, Any]]:
    async for line in stream.aiter_lines():
        if line.startswith("data: "):
            yield json.loads(line[6:])


async def large_upload(client: httpx.AsyncClient, path: Path, api: psutil.Process) -> dict[str, Any]:
    """One file in one request, and the API's memory meanwhile."""
    size = path.stat().st_size
    begun = await client.post("/v1/uploads", headers=_TUS | {"Upload-Length": str(size)})
    begun.raise_for_status()
    before = most = api.memory_info().rss
    done = asyncio.Event()

    async def look() -> None:
        nonlocal most
        while not done.is_set():
            most = max(most, api.memory_info().rss)
            await asyncio.sleep(0.05)

    async def pieces() -> AsyncIterator[bytes]:
        with path.open("rb") as file:
            while piece := await asyncio.to_thread(file.read, _PIECE):
                yield piece

    looking = asyncio.create_task(look())
    started = time.perf_counter()
    headers = _TUS | {"Upload-Offset": "0", "Content-Type": "application/offset+octet-stream"}
    answer = await client.patch(begun.headers["location"], content=pieces(), headers=headers, timeout=1200)
    seconds = time.perf_counter() - started
    done.set()
    await looking
    await client.delete(begun.headers["location"])
    return {
        "bytes": size,
        "status": answer.status_code,
        "mb_per_second": round(size / seconds / 1e6, 1),
        "api_before_mb": round(before / 1e6, 1),
        "api_grown_mb": round((most - before) / 1e6, 1),
    }


def spread(values: list[float]) -> dict[str, float]:
    """Percentiles of seconds, as milliseconds."""
    cuts = statistics.quantiles(values, n=1000, method="inclusive") if len(values) > 1 else values * 999
    return {f"p{name}_ms": round(1000 * cuts[index], 1) for name, index in (("50", 499), ("95", 949), ("99", 989))}


async def measure(
    service: Service, files: dict[str, Path], arguments: argparse.Namespace, large: Path
) -> dict[str, Any]:
    """All figures, one after the other."""
    api = service.process(_API)
    assert api is not None
    limits = httpx.Limits(max_connections=_STATUS_CONNECTIONS, max_keepalive_connections=_STATUS_CONNECTIONS)
    async with httpx.AsyncClient(base_url=service.url, limits=limits, timeout=120) as client:
        ids = {role: await upload(client, path) for role, path in files.items()}
        body = {"scene": ids["scene"], "style": ids["style"], "cameras": [ids["cameras"]], "parameters": LONG}
        running = (await client.post("/v1/jobs", json=body)).json()["id"]
        await _until_it_runs(client, running)
        figures: dict[str, Any] = {"job_steps_per_second_alone": await _speed(client, running, arguments.seconds / 2)}
        print(figures, flush=True)
        # first, as what watchers leave free in the API's heap would hide its growth
        figures["upload"] = await large_upload(client, large, api)
        print(figures["upload"], flush=True)

        async def status(number: int) -> httpx.Response:
            return await client.get(f"/v1/jobs/{running}")

        figures["status"] = await with_processor(api, at_a_rate(status, 200, arguments.seconds), "requests")
        print(figures["status"], flush=True)
        figures["watchers"] = await watch(service.url, running, arguments.watchers, arguments.seconds, api)
        print(figures["watchers"], flush=True)
        made: list[str] = []
        submitting = submissions(client, body, arguments.seconds, made)
        figures["submissions"] = await with_processor(api, submitting, "accepted")
        print(figures["submissions"], flush=True)

        async def any_status(number: int) -> httpx.Response:
            return await client.get(f"/v1/jobs/{made[number % len(made)]}")

        asking = at_a_rate(any_status, 200, arguments.seconds / 2)
        figures["status_of_queued_jobs"] = await with_processor(api, asking, "requests")
        print(figures["status_of_queued_jobs"], flush=True)
        figures["job_still_running"] = (await client.get(f"/v1/jobs/{running}")).json()["status"] == "running"
    figures["api_memory_mb"] = round(api.memory_info().rss / 1e6, 1)
    return figures


async def _until_it_runs(client: httpx.AsyncClient, job_id: str) -> None:
    while (job := (await client.get(f"/v1/jobs/{job_id}")).json())["status"] != "running" or not job["progress"][
        "step"
    ]:
        if job["status"] == "failed":
            raise RuntimeError(job["error"])
        await asyncio.sleep(0.5)


async def _speed(client: httpx.AsyncClient, job_id: str, seconds: float) -> float:
    steps = []
    for wait in (seconds, 0):
        steps.append((await client.get(f"/v1/jobs/{job_id}")).json()["progress"]["step"])
        await asyncio.sleep(wait)
    return round((steps[1] - steps[0]) / seconds, 1)


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--upload-mb", type=int, default=2000)
    parser.add_argument("--watchers", type=int, default=1000)
    parser.add_argument("--seconds", type=float, default=20.0)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="sgsst-load-") as name:
        folder = Path(name)
        (folder / "inputs").mkdir()
        ply, cameras, style = write_files(folder / "inputs", wall())
        large = folder / "large"
        large.touch()
        os.truncate(large, arguments.upload_mb * 1_000_000)  # a hole: it takes room only where it is uploaded to
        # the files of 1000 watchers, here and in the service
        with contextlib.suppress(ValueError, OSError):
            import resource

            _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
        with Service(folder / "data", **SETTINGS) as service:
            wait_for(service.ready, "the service", service.said)
            files = {"scene": ply, "cameras": cameras, "style": style}
            figures = asyncio.run(measure(service, files, arguments, large))
    print(write_result("service_load", {"processors": os.cpu_count(), **figures}))


if __name__ == "__main__":
    main()
