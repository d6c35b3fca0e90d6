"""Load that the API sustains while a job runs on the same machine: submissions, status requests, watchers, an upload.

python -m benchmarks.service_load [--postgresql]

Targets: 100 submissions per second of jobs whose files are already uploaded; 200 status requests per second with a 99th
percentile latency under 50 ms; 1000 watchers of server-sent events; memory growth of the API of less than 64 MB during
an upload of 2 GB. The client runs on the same machine.

With --postgresql, the database is a PostgreSQL server with durable commits. Two API processes share it, and requests
and watchers alternate between them, so half of the watchers receive the running job's events through the other API
process.
"""

import argparse
import asyncio
import contextlib
import json
import os
import re
import statistics
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import httpx2
import psutil
import uvloop

from api.client import AsyncClient
from benchmarks.common import add_pair, parse
from tests.api.http.sending import OFFSET_STREAM, TUS
from tests.api.service import Service
from tests.postgres import fresh_database, server
from tests.small_scenes import wall, write_files

#: Parameters of a job that outlasts the benchmark, so that jobs submitted later never start.
LONG = {"preset": "standard", "steps_sos": 1_000_000, "backbone": "vgg16", "early_stop": False}
SETTINGS: dict[str, Any] = {
    "SGSST_LEASE_SECONDS": "30",
    "SGSST_POLL_SECONDS": "0.5",
    "SGSST_CHECKPOINT_SECONDS": "60",
    "SGSST_PREVIEW_SECONDS": "20",
    "SGSST_MAX_JOBS_PER_KEY": "1000000",
    "SGSST_MIN_FREE_BYTES": "1000000000",
}
_SUBMITTERS, _STATUS_CONNECTIONS = 16, 32
_PIECE = 1 << 20
#: Bytes of the upload, number of watchers, and seconds of each measurement.
_UPLOAD, _WATCHERS, _SECONDS = 2_000_000_000, 1000, 20.0


class Connection:
    """Persistent connection with a minimal HTTP client.

    A general-purpose client would use as much CPU time as the API, on the same machine.
    """

    def __init__(self, url: str) -> None:
        self._host, _, port = url.removeprefix("http://").partition(":")
        self._port = int(port)
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, method: str, path: str, body: bytes = b"") -> tuple[int, bytes]:
        """Send a request, and return status and body of the response.

        Raises:
            OSError, EOFError: If the connection breaks. The next request opens a new connection.
        """
        reader, writer = self._streams = self._streams or await asyncio.open_connection(self._host, self._port)
        try:
            writer.write(self._head(method, path, len(body)) + body)
            head = (await reader.readuntil(b"\r\n\r\n")).lower()
            length = re.search(rb"\r\ncontent-length: (\d+)", head)
            return int(head[9:12]), await reader.readexactly(int(length[1]) if length else 0)
        except BaseException:
            self.close()
            raise

    async def lines(self, path: str) -> AsyncIterator[bytes]:
        """Yield the lines of an endless response, including its headers."""
        reader, writer = self._streams = await asyncio.open_connection(self._host, self._port)
        writer.write(self._head("GET", path, 0))
        while line := await reader.readline():
            yield line

    def close(self) -> None:
        """Close the connection."""
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None

    def _head(self, method: str, path: str, length: int) -> bytes:
        kind = f"Content-Type: application/json\r\nContent-Length: {length}\r\n" if length else ""
        return f"{method} {path} HTTP/1.1\r\nHost: {self._host}:{self._port}\r\n{kind}\r\n".encode()


async def submissions(urls: Sequence[str], body: dict[str, Any], created: list[str]) -> dict[str, Any]:
    """Submit jobs with uploaded files from several clients, as fast as possible, and append their ids to `created`."""
    took: list[float] = []
    failures: Counter[str] = Counter()
    end = time.perf_counter() + _SECONDS

    async def submit(number: int) -> None:
        connection = Connection(urls[number % len(urls)])
        while time.perf_counter() < end:
            parameters = body["parameters"] | {"seed": number * 1_000_000 + len(created)}
            text = json.dumps(body | {"parameters": parameters}).encode()
            started = time.perf_counter()
            try:
                status, answer = await connection.ask("POST", "/v1/jobs", text)
            except (OSError, EOFError) as error:
                failures[type(error).__name__] += 1
                continue
            took.append(time.perf_counter() - started)
            if status == 202:
                created.append(json.loads(answer)["id"])
            else:
                failures[str(status)] += 1
        connection.close()

    started = time.perf_counter()
    await asyncio.gather(*(submit(number) for number in range(_SUBMITTERS)))
    elapsed = time.perf_counter() - started
    return {
        "per_second": round(len(created) / elapsed, 1),
        "accepted": len(created),
        "failures": failures,
        **spread(took),
    }


async def at_a_rate(urls: Sequence[str], path: Callable[[int], str], rate: float, seconds: float) -> dict[str, Any]:
    """Send requests at a constant rate, whether or not earlier ones have been answered.

    Response times are measured from the moment a request is due, including any wait for a free connection.
    """
    took: list[float] = []
    failures: Counter[str] = Counter()
    free: asyncio.LifoQueue[Connection] = asyncio.LifoQueue()
    for number in range(_STATUS_CONNECTIONS):
        free.put_nowait(Connection(urls[number % len(urls)]))
    start = time.perf_counter()

    async def one(number: int) -> None:
        due = start + number / rate
        await asyncio.sleep(due - time.perf_counter())
        connection = await free.get()
        try:
            status, _ = await connection.ask("GET", path(number))
            if status != 200:
                failures[str(status)] += 1
        except (OSError, EOFError) as error:
            failures[type(error).__name__] += 1
        free.put_nowait(connection)
        took.append(time.perf_counter() - due)

    await asyncio.gather(*(one(number) for number in range(int(rate * seconds))))
    elapsed = time.perf_counter() - start
    while not free.empty():
        free.get_nowait().close()
    return {
        "rate": rate,
        "requests": len(took),
        "answered_per_second": round(len(took) / elapsed, 1),
        "failures": failures,
        **spread(took),
    }


async def watch(urls: Sequence[str], job_id: str) -> dict[str, Any]:
    """Watch one running job with many clients, and return the number of connected clients and the delay of events."""
    late: list[float] = []
    connected = 0
    opened = float("inf")  # events before this time do not count

    async def one(number: int) -> None:
        nonlocal connected
        await asyncio.sleep(number / 200)  # spread the connections over time
        connection = Connection(urls[number % len(urls)])
        try:
            async for line in connection.lines(f"/v1/jobs/{job_id}/events"):
                if line.startswith(b"HTTP/1.1 200"):
                    connected += 1
                elif line.startswith(b"data: ") and time.time() > opened:
                    updated = _moment(json.loads(line[6:]).get("updated_at"))
                    if updated > opened:
                        late.append(time.time() - updated)
        finally:
            connection.close()

    tasks = [asyncio.create_task(one(number)) for number in range(_WATCHERS)]
    deadline = time.monotonic() + 120
    while connected < _WATCHERS and time.monotonic() < deadline and not any(task.done() for task in tasks):
        await asyncio.sleep(0.1)
    opened = time.time()
    await asyncio.sleep(_SECONDS)
    alive = sum(not task.done() for task in tasks)
    for task in tasks:
        task.cancel()
    for ended in await asyncio.gather(*tasks, return_exceptions=True):
        if isinstance(ended, Exception) and not isinstance(ended, OSError):
            raise ended
    delay = spread(late) if late else None
    return {"wanted": _WATCHERS, "connected": connected, "still_connected": alive, "delay": delay}


def _moment(timestamp: str | None) -> float:
    """Convert a time from the API to seconds since 1970; return 0 for None."""
    return datetime.fromisoformat(timestamp).timestamp() if timestamp else 0.0


async def large_upload(client: httpx2.AsyncClient, path: Path, api: psutil.Process) -> dict[str, Any]:
    """Upload a large file in one request, and measure the API's memory meanwhile."""
    size = path.stat().st_size
    begun = await client.post("/v1/uploads", headers=TUS | {"Upload-Length": str(size)})
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
    headers = TUS | {"Upload-Offset": "0", "Content-Type": OFFSET_STREAM}
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
    """Return percentiles of times in seconds, converted to milliseconds."""
    cuts = statistics.quantiles(values, n=1000, method="inclusive") if len(values) > 1 else values * 999
    return {f"p{name}_ms": round(1000 * cuts[index], 1) for name, index in (("50", 499), ("95", 949), ("99", 989))}


async def measure(services: Sequence[Service], files: dict[str, Path], large: Path) -> dict[str, Any]:
    """Measure all figures one after the other. The first of the services has the dispatcher."""
    service, urls = services[0], [each.url for each in services]
    api = service.processes("api.http.server")[0]
    figures: dict[str, Any] = {}
    async with AsyncClient(service.url) as uploads, httpx2.AsyncClient(base_url=service.url, timeout=120) as client:
        ids = {role: await uploads.upload(path) for role, path in files.items()}
        body = {"scene": ids["scene"], "style": ids["style"], "cameras": [ids["cameras"]], "parameters": LONG}
        running = (await client.post("/v1/jobs", json=body)).json()["id"]
        await _until_it_runs(client, running)
        # The upload comes before the watchers, whose freed memory in the API's heap would hide its growth.
        figures["upload"] = await large_upload(client, large, api)
        figures["status"] = await at_a_rate(urls, lambda number: f"/v1/jobs/{running}", 200, _SECONDS)
        figures["watchers"] = await watch(urls, running)
        created: list[str] = []
        figures["submissions"] = await submissions(urls, body, created)
        figures["status_of_queued_jobs"] = await at_a_rate(
            urls, lambda number: f"/v1/jobs/{created[number % len(created)]}", 200, _SECONDS / 2
        )
        job = (await client.get(f"/v1/jobs/{running}")).json()
        assert job["status"] == "running", "the job has ended before the measurements"
    print(json.dumps(figures, indent=2))
    return figures


async def _until_it_runs(client: httpx2.AsyncClient, job_id: str) -> None:
    job: dict[str, Any] = {"status": "queued"}
    while job["status"] != "running" or not job["progress"]["step"]:
        await asyncio.sleep(0.5)
        job = (await client.get(f"/v1/jobs/{job_id}")).json()
        if job["status"] == "failed":
            raise RuntimeError(job["error"])


def _services(folder: Path, stack: contextlib.ExitStack, postgresql: bool) -> list[Service]:
    """Return the services to measure, which are not started yet."""
    if not postgresql:
        return [Service(folder / "data", **SETTINGS)]
    database = fresh_database(stack.enter_context(server(durable=True)))
    settings = SETTINGS | {"SGSST_DATABASE": database}
    return [Service(folder / "data", **settings), Service(folder / "data", alone=True, **settings)]


def main() -> None:
    """Measure, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--postgresql", action="store_true", help="two API processes on a PostgreSQL server")
    arguments = parse(parser)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="sgsst-load-")))
        (folder / "inputs").mkdir()
        ply, cameras, style = write_files(folder / "inputs", wall())
        large = folder / "large"
        large.touch()
        os.truncate(large, _UPLOAD)  # sparse: it needs no space on disk
        # Raise the limit of open files for 1000 watchers, here and in the service.
        with contextlib.suppress(ValueError, OSError):
            import resource

            _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
        services = [stack.enter_context(each) for each in _services(folder, stack, arguments.postgresql)]
        files = {"scene": ply, "cameras": cameras, "style": style}
        figures = uvloop.run(measure(services, files, large))
    print(add_pair("service_load", "postgresql" if arguments.postgresql else "sqlite", {}, figures))


if __name__ == "__main__":
    main()
