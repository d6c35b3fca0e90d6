"""Client of `service.inspection.process`: checks users' files without reading them in the calling process."""

import asyncio
import hashlib
import json
import logging
import os
import shutil
import sys
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from service import problems
from service.deadlines import FileThreads, OwnerLimit, suspended
from service.files.blobs import Blobs
from service.inputs import PLAN, JobParameters, WorkRequest, stage
from service.inspection.sandbox import missing
from service.settings import ServiceSettings
from service.store import Store
from service.store.tables import BlobRow
from sgsst_core import container
from sgsst_core.errors import WeightsError

_log = logging.getLogger(__name__)

#: Maximum number of waiting requests per owner; further ones are rejected with `BUSY`.
MAX_WAITING = 64


class Lanes:
    """Fair scheduling of owners: an owner with many requests delays only their own.

    Args:
        count: Number of requests at a time, at most one of each owner.
    """

    def __init__(self, count: int) -> None:
        self._free, self._own = asyncio.Semaphore(count), OwnerLimit(1)
        self._present: Counter[str] = Counter()

    @asynccontextmanager
    async def turn(self, owner: str) -> AsyncIterator[None]:
        """Wait for the owner's turn, which lasts for the duration of the block.

        Raises:
            BUSY: If too many requests of this owner wait already.
        """
        if self._present[owner] > MAX_WAITING:  # one of them has its turn
            raise problems.BUSY("Too many files of this key are being checked. Try again later.")
        self._present[owner] += 1
        try:
            # in this order, one request of each owner waits for its turn, behind those of the other owners
            async with self._own.of(owner), self._free:
                yield
        finally:
            self._present -= Counter([owner])


#: Task of the inspecting process: validate a job's inputs, or plan the job as well.
Work = Literal["validate", "plan"]
#: Version of the validation; raising it invalidates stored findings.
_VERSION = "8"
#: Number of requests of each kind at a time: checks of small and large jobs, so that small ones do not wait; plans;
#: files derived from results; and videos. Two owners check at once: the files of one may take the full time limit.
Kind = Literal["validate", "large", "plan", "file", "video"]
_AT_ONCE: dict[Kind, int] = {"validate": 2, "large": 1, "plan": 1, "file": 1, "video": 1}
_MAX_ANSWER = 64 << 20
_LEFTOVER_SECONDS = 3600.0
#: Additions to the limits of an inspection per byte of its files. CPU seconds: the slowest readers (text, images) read
#: at least 30 MB/s, and the limit allows for 8 MB/s. Memory: a number in a text file takes at least two bytes (a digit
#: and a space) and becomes a float64 (4x) and then a float32 (2x). A binary file is mapped (1x), and its numbers of one
#: byte or more become float32 (at most 4x).
_SECONDS_PER_BYTE = 120 / 1e9
MEMORY_PER_BYTE = 6
#: Maximum of the memory limit, as a fraction of the machine's memory.
_MEMORY_FRACTION = 0.8
#: Maximum size of the file of a plan, in bytes per Gaussian of the refined scene and besides, and number of plans that
#: are stored.
_PLAN_BYTES_PER_GAUSSIAN, _PLAN_BYTES, _MAX_PLANS = 32, 1 << 20, 16
#: CPU seconds that planning may take per Gaussian and view, per pixel of each view, and per pixel of the view that the
#: trial visits. Actual use is less than a third of them.
_SECONDS_PER_GAUSSIAN, _SECONDS_PER_PIXEL, _TRIAL_SECONDS_PER_PIXEL = 5e-6, 5e-6, 2e-4
#: Total size in bytes above which a job is large.
_LARGE_BYTES = 64 << 20

#: Environment variables passed to the inspecting process: locations of code, weights and kernels, and memory
#: allocation.
_ENVIRONMENT = (
    *("HOME", "LANG", "LC_ALL", "LD_LIBRARY_PATH", "PYTHONDONTWRITEBYTECODE", "PYTHONHOME", "PYTHONPATH"),
    *("SGSST_CACHE", "XDG_CACHE_HOME", "NUMBA_CACHE_DIR", "MALLOC_ARENA_MAX", "THP_MEM_ALLOC_ENABLE"),
    *("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"),
)
#: Command of the inspecting process, run without a shell; tests replace it by one with compromised readers.
COMMAND: tuple[str, ...] = (sys.executable, "-P", "-m", "service.inspection.process")

Show = Callable[[dict[str, Any]], None]


class InspectionProcess:
    """Inspecting process that handles one request at a time; it is started on first use and restarted after it dies.

    Args:
        threads: Maximum number of threads of a request.
    """

    def __init__(self, threads: int = 1) -> None:
        self.threads = threads
        self._process: asyncio.subprocess.Process | None = None
        self._starting = asyncio.Lock()

    async def ask(self, request: WorkRequest, show: Show = lambda now: None) -> dict[str, Any]:
        """Return the response to a request.

        Raises:
            BUSY: If the process died.
        """
        line = request.model_copy(update={"threads": self.threads}).model_dump_json().encode() + b"\n"
        process, answered = await self.start(), False
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            with suppress(OSError, ValueError):
                process.stdin.write(line)
                await process.stdin.drain()
                while response := await process.stdout.readline():
                    answer: dict[str, Any] = json.loads(response)
                    if "planning" not in answer:
                        answered = True
                        return answer
                    show(answer["planning"])
        finally:
            if not answered:  # a later response must not be read as that of another request
                await self.close()
        raise problems.BUSY("Files cannot be checked at the moment. Try again later.")

    async def start(self) -> asyncio.subprocess.Process:
        """Return the process, after starting it if it does not run."""
        async with self._starting:
            if self._process is None or self._process.returncode is not None:
                self._process = await asyncio.create_subprocess_exec(
                    *COMMAND,
                    stdin=asyncio.subprocess.PIPE,
                    stdout=asyncio.subprocess.PIPE,
                    limit=_MAX_ANSWER,
                    env=self._environment(),
                    start_new_session=True,
                )
            return self._process

    def _environment(self) -> dict[str, str]:
        """Return the environment variables of the process.

        They contain no secrets, because the process reads untrusted files. They keep libraries from starting threads on
        import, because the process forks.
        """
        inherited = {name: os.environ[name] for name in _ENVIRONMENT if name in os.environ}
        threads = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), str(self.threads))
        return {**inherited, **threads, "OPENBLAS_NUM_THREADS": "1", "CUDA_VISIBLE_DEVICES": ""}

    async def close(self) -> None:
        """Kill the process; its child that reads files dies with it."""
        process, self._process = self._process, None
        if process is not None and process.returncode is None:
            with suppress(ProcessLookupError):
                process.kill()
            await process.wait()


class Processes:
    """Inspecting processes, which are started when all others are busy; owners take turns on each kind of work."""

    def __init__(self, settings: ServiceSettings) -> None:
        self._threads = {"plan": _threads_of_a_job(settings), "video": _threads_of_a_job(settings)}
        self._lanes = {kind: Lanes(count) for kind, count in _AT_ONCE.items()}
        self._all: list[InspectionProcess] = []
        self._idle: list[InspectionProcess] = []

    @asynccontextmanager
    async def turn(self, owner: str, kind: Kind) -> AsyncIterator[InspectionProcess]:
        """Wait for the owner's turn, and provide a process for the duration of the block.

        Raises:
            BUSY: If too many requests of this owner wait already.
        """
        async with self._lanes[kind].turn(owner):
            process = self._take(self._threads.get(kind, 1))
            try:
                yield process
            finally:
                self._idle.append(process)

    def _take(self, threads: int) -> InspectionProcess:
        for process in self._idle:
            if process.threads == threads:
                self._idle.remove(process)
                return process
        self._all.append(InspectionProcess(threads))
        return self._all[-1]

    async def warm(self) -> None:
        """Start processes that check and plan jobs in advance: their imports take seconds."""
        for threads in {1, self._threads["plan"]}:
            self._idle.append(process := self._take(threads))
            with suppress(OSError):  # the next request starts it, or tells why it cannot
                await process.start()

    async def close(self) -> None:
        """Stop all processes, which also aborts any work in progress."""
        for process in self._all:
            await process.close()


def working_folder(settings: ServiceSettings, name: str) -> Path:
    """Return a folder for temporary files, without what a killed process has left there."""
    folder = settings.folder / name
    folder.mkdir(parents=True, exist_ok=True)
    for leftover in folder.iterdir():
        if time.time() - leftover.stat().st_mtime > _LEFTOVER_SECONDS:
            shutil.rmtree(leftover, ignore_errors=True)
    return folder


class Inspector:
    """Validator and planner of complete jobs; its findings are cached by files and parameters."""

    def __init__(self, settings: ServiceSettings, store: Store, blobs: Blobs, threads: FileThreads) -> None:
        self._settings = settings
        self._store, self._blobs, self._threads = store, blobs, threads
        self.processes = Processes(settings)
        self._folder = working_folder(settings, "inspections")
        for feature in missing():
            _log.warning("confinement incomplete: missing %s", feature)

    async def inspect(
        self,
        work: Work,
        owner: str,
        inputs: Sequence[Mapping[str, Any]],
        rows: Mapping[str, BlobRow],
        parameters: JobParameters,
        show: Show = lambda now: None,
    ) -> dict[str, Any]:
        """Return the findings of `service.inspection.process` about a job's inputs, from an earlier check if possible.

        Args:
            work: Task; inputs that are planned are validated first.
            owner: Owner of the job; waiting owners take turns.
            inputs: `role`, `name`, `sha256` and `size` of each file.
            rows: Blob rows by digest.
            show: Callback that receives the progress of planning: `stage`, `step`, `total`, `fraction` and `eta_s`. One
                step is one view.

        Raises:
            INVALID_INPUT: If the inputs cannot be used.
            BUSY: If the inputs cannot be checked now.
        """

        def find() -> tuple[str, dict[str, Any] | None]:
            key = _key(self._settings, work, owner, inputs, parameters)
            return key, self._store.inputs.inspection(key)

        key, known = await asyncio.to_thread(find)
        if known is not None:
            return findings_of(known)
        seconds = self._settings.inspection_seconds + _SECONDS_PER_BYTE * _size(inputs)
        if work == "plan" or parameters.renders_views:
            seconds += self._settings.dry_run_seconds
        if work == "plan":
            valid = await self.inspect("validate", owner, inputs, rows, parameters)
            seconds += _planning_seconds(valid, _limits(self._settings))
        kind: Kind = "plan" if work == "plan" else "large" if _size(inputs) > _LARGE_BYTES else "validate"
        with suspended():  # the process has its own limits
            async with (
                self.processes.turn(owner, kind) as process,
                self._threads.folder(owner, self._folder) as folder,
            ):
                paths = await self._threads.run(owner, self._blobs.fetch, rows, folder, size=_size(inputs))
                staged = await self._threads.run(owner, stage, folder, inputs, paths)
                most = _PLAN_BYTES_PER_GAUSSIAN * self._settings.max_gaussians + _PLAN_BYTES
                request = WorkRequest(
                    work=work,
                    folder=folder,
                    staged=staged,
                    parameters=parameters,
                    seconds=seconds,
                    memory=self._memory(inputs),
                    limits=_limits(self._settings),
                    output=(PLAN, most) if work == "plan" else None,
                )
                answer = await process.ask(request, show)
                if request.output and "findings" in answer:
                    target = stored_plan(self._settings, owner, inputs, parameters)
                    await self._threads.run(owner, _store_plan, folder / PLAN, target)
        transient = answer.get("error", {}).get("code") in (problems.INSPECTION_LIMIT.code, WeightsError.code)
        if not transient:  # a later check may succeed
            await asyncio.to_thread(self._store.inputs.add_inspection, key, answer)
        return findings_of(answer)

    def _memory(self, inputs: Sequence[Mapping[str, Any]]) -> int:
        """Return the memory limit of reading in bytes; photos do not add to it, because they are read one at a time."""
        size: int = sum(entry["size"] for entry in inputs if entry["role"] != "photos")
        minimum = self._settings.inspection_bytes
        maximum = max(minimum, int(_MEMORY_FRACTION * container.memory().total))
        return min(minimum + MEMORY_PER_BYTE * size, maximum)


def _limits(settings: ServiceSettings) -> dict[str, int]:
    """Return the limits of a job's inputs."""
    return {
        "gaussians": settings.max_gaussians,
        "views": settings.max_views,
        "pixels": settings.max_pixels,
        "image_pixels": settings.max_image_pixels,
    }


def _planning_seconds(findings: dict[str, Any], limits: dict[str, int]) -> float:
    """Return the CPU seconds that planning may take, from the findings of an untrusted process about the inputs."""
    sizes = {name: findings.get(name) for name in ("gaussians", "views", "pixels")}
    gaussians, views, pixels = (
        min(max(size, 0), limits[name]) if isinstance(size, int) else 0 for name, size in sizes.items()
    )
    trial = _TRIAL_SECONDS_PER_PIXEL * pixels / max(views, 1)
    return float(_SECONDS_PER_GAUSSIAN * gaussians * views + _SECONDS_PER_PIXEL * pixels + trial)


def _key(
    settings: ServiceSettings, work: str, owner: str, inputs: Sequence[Mapping[str, Any]], parameters: JobParameters
) -> str:
    """Return the key of a finding. It includes the owner, so that no finding shows what others have inspected."""
    files = sorted((entry["role"], entry["name"], entry["sha256"]) for entry in inputs)
    values = parameters.model_dump(mode="json", exclude={"name", "retention_days", "workers", "seed"})
    # style weights are matched to styles by their order, and views to painted files
    ordered = [entry["name"] for entry in inputs if entry["role"] in ("style", "painted")]
    order = ordered if len(ordered) > 1 else []
    text = json.dumps([_VERSION, work, owner, files, order, values, _limits(settings)], sort_keys=True)
    return f"{work}:{hashlib.sha256(text.encode()).hexdigest()}"


def stored_plan(
    settings: ServiceSettings, owner: str, inputs: Sequence[Mapping[str, Any]], parameters: JobParameters
) -> Path:
    """Return the path of the plan of an owner's last dry run for these inputs on this machine; it may not exist.

    The plan was written by a process that reads users' files: `worker.execute` decides whether a job uses it.
    """
    _, _, key = _key(settings, "plan", owner, inputs, parameters).partition(":")
    return settings.folder / "plans" / f"{key}.safetensors"


def _store_plan(file: Path, target: Path) -> None:
    """Move a plan to its place, and delete the oldest ones; a job whose plan is missing plans again."""
    with suppress(OSError):  # another process may delete the same ones
        target.parent.mkdir(exist_ok=True)
        file.replace(target)
        for old in sorted(target.parent.iterdir(), key=lambda path: path.stat().st_mtime)[:-_MAX_PLANS]:
            old.unlink()


def _size(inputs: Sequence[Mapping[str, Any]]) -> int:
    return sum(entry["size"] for entry in inputs)


def _threads_of_a_job(settings: ServiceSettings) -> int:
    """Return a job's number of threads on this machine; planning and rendering videos use as many."""
    threads = os.environ.get("OMP_NUM_THREADS", "")
    return (
        int(threads)
        if threads.isdigit() and int(threads)
        else max(1, container.cores() // (settings.parallel_jobs or 1))
    )


def findings_of(answer: Mapping[str, Any]) -> dict[str, Any]:
    """Return the findings in a response of the inspecting process.

    Raises:
        INVALID_INPUT: If the response is an error.
    """
    if "error" in answer:
        error = answer["error"]
        raise problems.INVALID_INPUT(error["message"], code=error["code"], input=error["input"])
    findings: dict[str, Any] = answer["findings"]
    return findings
