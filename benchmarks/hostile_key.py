"""Latency of one API key's small submissions while another key attacks the service.

python -m benchmarks.hostile_key

One key sends costly requests, 16 at a time: files that are slow to validate, dry runs, large bodies that are refused,
and uploads that are created and deleted. Meanwhile, another key submits small jobs one after the other, each with files
that are new to the service. The target is a 99th percentile below 2 s. Client and service run on the same machine.
"""

import argparse
import asyncio
import itertools
import json
import multiprocessing
import tempfile
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from typing import Any

import httpx2

from benchmarks.common import parse, write_result
from benchmarks.service_load import spread
from service.settings import ServiceSettings
from service.store import open_store
from tests.api.http.sending import TUS
from tests.api.service import Service
from tests.small_scenes import cameras, wall, write_files

_SETTINGS = {
    "SGSST_REQUIRE_KEYS": "true",
    "SGSST_MAX_JOBS_PER_KEY": "1000000",
    "SGSST_MIN_FREE_BYTES": "1000000000",
}
_ROLES = ("scene", "cameras", "style")
_QUICK = {"preset": "preview", "backbone": "vgg16", "resolution": 128}
#: Bytes of a request body that is refused only after its last byte.
_LARGE = 60_000_000
#: Number of simultaneous costly requests, and seconds of small ones beside each kind of them.
_PARALLEL, _SECONDS = 16, 60.0
#: Timeout in seconds for responses to the hostile key, and for responses to the other key.
_PATIENCE, _SHORT_PATIENCE = 600.0, 60.0

Files = dict[str, bytes]
Costly = Callable[[httpx2.AsyncClient, Files, int], Awaitable[httpx2.Response]]


def input_files(folder: Path) -> Files:
    """Return the contents of small files, and of a scene with 2,000 cameras that all look away from it.

    Validation has to try each of these cameras.
    """
    (folder / "inputs").mkdir()
    behind = wall(500, 400)
    behind.means[:, 2] = -3
    small, costly = write_files(folder / "inputs", wall()), write_files(folder, behind, cameras(2000))
    names = [*_ROLES, *(f"costly {role}" for role in _ROLES)]
    return {name: path.read_bytes() for name, path in zip(names, small + costly, strict=True)}


def form(files: Files, number: int) -> dict[str, Any]:
    """Return a multipart form whose files are new to the service: `number` determines whitespace in the camera file."""
    new = files["cameras"] + f"{number:064b}".replace("0", " ").replace("1", "\n").encode()
    names = {"scene": "scene.ply", "cameras": "cameras.json", "style": "style.png"}
    parts = [(role, (names[role], content)) for role, content in {**files, "cameras": new}.items()]
    return {"files": parts, "data": {"parameters": json.dumps(_QUICK)}}


async def _inspection(client: httpx2.AsyncClient, files: Files, number: int) -> httpx2.Response:
    return await client.post("/v1/jobs", **form({role: files[f"costly {role}"] for role in _ROLES}, number))


async def _dry_run(client: httpx2.AsyncClient, files: Files, number: int) -> httpx2.Response:
    request = form({role: files[role] for role in _ROLES}, number)
    return await client.post("/v1/jobs", params={"dry_run": True}, **request | {"data": {}})


async def _large_body(client: httpx2.AsyncClient, files: Files, number: int) -> httpx2.Response:
    large = {"scene": files["scene"], "cameras": files["cameras"], "style": number.to_bytes(16, "big") + bytes(_LARGE)}
    return await client.post("/v1/jobs", **form(large, number))


async def _uploads(client: httpx2.AsyncClient, files: Files, number: int) -> httpx2.Response:
    answer = await client.post("/v1/uploads", headers=TUS | {"Upload-Length": "1000"})
    if answer.status_code == 201:
        await client.delete(answer.headers["location"])
    return answer


ATTACKS: dict[str, Costly] = {
    "uploads": _uploads,
    "large_bodies": _large_body,
    "dry_runs": _dry_run,
    "inspections": _inspection,
}


def attack(url: str, key: str, name: str, files: Files, statuses: Any) -> None:
    """Send requests of one kind until the process is killed, and count response statuses."""

    async def one(client: httpx2.AsyncClient, numbers: Iterator[int]) -> None:
        while True:
            try:
                status = str((await ATTACKS[name](client, files, next(numbers))).status_code)
            except httpx2.TransportError as error:
                status = type(error).__name__
            statuses[status] = statuses.get(status, 0) + 1

    async def all_of_them() -> None:
        numbers = itertools.count(int(time.time() * 1000) << 20)
        limits = httpx2.Limits(max_connections=_PARALLEL)
        headers = {"Authorization": f"Bearer {key}"}
        async with httpx2.AsyncClient(base_url=url, headers=headers, timeout=_PATIENCE, limits=limits) as client:
            await asyncio.gather(*(one(client, numbers) for _ in range(_PARALLEL)))

    asyncio.run(all_of_them())


def submissions(url: str, key: str, files: Files, seconds: float) -> dict[str, Any]:
    """Submit small jobs one after the other, and return the time until each one was accepted."""
    took: list[float] = []
    statuses: Counter[str] = Counter()
    small = {role: files[role] for role in _ROLES}
    first = int(time.time() * 1000) << 20
    end = time.perf_counter() + seconds
    with httpx2.Client(base_url=url, headers={"Authorization": f"Bearer {key}"}, timeout=_SHORT_PATIENCE) as client:
        while time.perf_counter() < end:
            started = time.perf_counter()
            try:
                status = str(client.post("/v1/jobs", **form(small, first + len(took))).status_code)
            except httpx2.TransportError as error:
                status = type(error).__name__
            took.append(time.perf_counter() - started)
            statuses[status] += 1
    return {"statuses": dict(statuses), "submissions": len(took), "most_ms": round(1000 * max(took), 1), **spread(took)}


def measure(folder: Path) -> dict[str, Any]:
    """Return percentiles of the small submissions' times, without an attack and during each kind of attack."""
    files = input_files(folder)
    figures: dict[str, Any] = {}
    with Service(folder / "data", alone=True, **_SETTINGS) as service:
        store = open_store(ServiceSettings(data=service.data))
        hostile, other = (store.keys.create(name)[1] for name in ("hostile", "other"))
        store.close()
        submissions(service.url, other, files, 1)  # warm-up: modules and data that are loaded once
        figures["alone"] = submissions(service.url, other, files, _SECONDS / 4)
        print("alone", figures["alone"], flush=True)
        context = multiprocessing.get_context("spawn")
        with context.Manager() as manager:
            for name in ATTACKS:
                statuses = manager.dict()
                arguments = (service.url, hostile, name, files, statuses)
                process = context.Process(target=attack, args=arguments, daemon=True)
                process.start()
                time.sleep(10)  # until the attack's requests queue up
                figures[name] = submissions(service.url, other, files, _SECONDS)
                process.kill()
                process.join()
                figures[name]["hostile_answers"] = dict(statuses)
                print(name, figures[name], flush=True)
    return figures


def main() -> None:
    """Measure, then print and store the figures."""
    parse(argparse.ArgumentParser(description=__doc__))
    with tempfile.TemporaryDirectory(prefix="sgsst-hostile-") as folder:
        figures = measure(Path(folder))
    print(write_result("hostile_key", {"parallel": _PARALLEL, **figures}))


if __name__ == "__main__":
    main()
