"""Files derived from results on request, and stored beside them: compressed formats, and blends with other results.

`service.inspection.process` creates them in a child process with resource limits, so that the API process
never reads a scene.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from service import problems
from service.deadlines import suspended
from service.errors import LostFileError
from service.files.artifacts import Artifacts
from service.files.blobs import Blobs
from service.files.staging import RESULT, Staged, stage
from service.files.threads import FileThreads
from service.inspection.inspector import LEFTOVER_SECONDS, MEMORY_PER_BYTE, InspectionProcess, findings_of
from service.inspection.lanes import Lanes
from service.parameters import stored_parameters
from service.settings import ServiceSettings
from service.store import Store
from service.store.leases import Published
from service.store.quotas import Quotas
from service.store.tables import ArtifactRow, JobRow
from sgsst_core.files.formats import result_name
from sgsst_core.files.formats.scene_format import SceneFormat

#: Additional CPU seconds per byte of results, for reading, sorting, compressing, and rendering them several times.
#: Actual use is less than a fifth.
_SECONDS_PER_BYTE = 600 / 1e9
#: Additional bytes of a derived file, for headers.
_HEADER_BYTES = 1 << 20
#: Largest size of a blend relative to the result; a PLY with 8-bit values may become one with float32 values.
_BLEND_SIZE = 4
#: Maximum number of blends that are stored with a job.
MOST_BLENDS = 20
_BLENDS = "blends/"


@dataclass(frozen=True)
class Blend:
    """Blend of a job's scene with its result, and with results of other jobs.

    Attributes:
        weight: Weight of the job's result. The scene has the remaining weight up to 1.
        others: Weights of the results of other jobs by job id.
        format: Format of the blend.
    """

    weight: float
    others: dict[str, float]
    format: SceneFormat

    @property
    def name(self) -> str:
        """Name of the artifact: `blends/stylized_0.7.ply`, with the end of the id before other jobs' weights."""
        parts = [f"{self.weight:g}", *(f"{job_id[-8:]}_{weight:g}" for job_id, weight in sorted(self.others.items()))]
        return f"{_BLENDS}{Path(RESULT).stem}_{'_'.join(parts)}{self.format.suffix}"


class DerivedFiles:
    """Writer of files derived from results, one at a time; owners take turns.

    Concurrent requests for the same file share one task.
    """

    def __init__(
        self, settings: ServiceSettings, store: Store, blobs: Blobs, artifacts: Artifacts, threads: FileThreads
    ) -> None:
        self._settings, self._store, self._blobs, self._artifacts = settings, store, blobs, artifacts
        self._threads = threads
        self._lanes = Lanes([InspectionProcess()])
        self._tasks: dict[tuple[str, str], asyncio.Task[None]] = {}
        self._folder = settings.folder / "packing"
        self._folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self._folder)

    async def compressed(self, job: JobRow, format: SceneFormat, quotas: Quotas) -> ArtifactRow:
        """Return a job's result in a compressed format; the compression error is stored beside it as JSON.

        Raises:
            NotFoundError: If the job has no result yet, or the result is gone.
            INVALID_INPUT: If the format cannot represent the result, or compressing exceeds the limits.
            QUOTA_EXCEEDED: If the files exceed the owner's quota of stored bytes.
            BUSY, NoSpaceError: If the result cannot be compressed now.
        """
        name = result_name(RESULT, format)
        return await self._derived(job, name, lambda: self._compress(job, name, quotas))

    async def blended(self, job: JobRow, blend: Blend, quotas: Quotas) -> ArtifactRow:
        """Return a blend of a job's scene and results. The owner of the job must also own the others.

        Raises:
            NotFoundError: If a job has no result yet, or a result is gone.
            INVALID_INPUT: If the results have other Gaussians than the scene, the format cannot represent the
                blend, or blending exceeds the limits.
            TOO_MANY_BLENDS: If the job has `MOST_BLENDS` already.
            QUOTA_EXCEEDED: If the blend exceeds the owner's quota of stored bytes.
            BUSY, NoSpaceError: If the results cannot be blended now.
        """
        return await self._derived(job, blend.name, lambda: self._blend(job, blend, quotas))

    async def _derived(self, job: JobRow, name: str, derive: Callable[[], Awaitable[None]]) -> ArtifactRow:
        """Return the database row of a derived file, which `derive` creates from the job's result if there is none."""
        await asyncio.to_thread(self._result, job.id)
        row = await asyncio.to_thread(self._store.jobs.artifact, job.id, name)
        if row is None:
            task = self._tasks.get((job.id, name))
            if task is None:
                task = asyncio.ensure_future(derive())
                self._tasks[job.id, name] = task
                task.add_done_callback(lambda done: self._tasks.pop((job.id, name), None))
            try:
                with suspended():  # each part of the task has its own limit
                    await asyncio.shield(task)
            except LostFileError:
                await asyncio.to_thread(self._result, job.id)  # fails if the job was deleted meanwhile
                raise
            row = await asyncio.to_thread(self._store.jobs.artifact, job.id, name)
        if row is None:
            raise problems.NOT_FOUND(f"The results of job {job.id} are gone.")
        return row

    def _result(self, job_id: str) -> ArtifactRow:
        row = self._store.jobs.artifact(job_id, RESULT)
        if row is None:
            raise problems.NO_ARTIFACT(job_id=job_id, name=RESULT)
        return row

    # --- compressed formats ---------------------------------------------------------------------------------------

    async def _compress(self, job: JobRow, name: str, quotas: Quotas) -> None:
        """Compress the result, store the files, and make them visible."""
        async with self._turn(job) as (process, folder, result):
            await self._threads.run(job.owner, self._blobs.ensure_space, 3 * result.size)
            size = result.size + await input_bytes(self._store, job)
            staged = await self._threads.run(job.owner, self._stage, folder, job, [result], size=size)
            limits = {"name": name, "bytes": result.size + _HEADER_BYTES}  # a compressed scene is smaller
            staged = staged.model_copy(update={"scene": Path(RESULT)})
            request = self._request("compress", folder, job, staged, limits, result.size)
            loss = json.dumps(findings_of(await process.ask(request)), indent=1) + "\n"
            loss_file = folder / "loss.json"
            await self._threads.run(job.owner, loss_file.write_text, loss)
            files = {f"{name}.json": loss_file, name: folder / name}
            await self._threads.run(job.owner, self._publish, job, result, files, quotas, size=result.size)

    # --- blends ---------------------------------------------------------------------------------------------------

    async def _blend(self, job: JobRow, blend: Blend, quotas: Quotas) -> None:
        """Blend the results, store the file, and make it visible."""
        async with self._turn(job) as (process, folder, result):
            await asyncio.to_thread(self._check_count, job)
            others = [await asyncio.to_thread(self._result, job_id) for job_id in blend.others]
            scene = await asyncio.to_thread(self._store.jobs.input, job.id, "scene", 0)
            size = (scene["size"] if scene else 0) + sum(row.size for row in (result, *others))
            run = partial(self._threads.run, job.owner)
            await run(self._blobs.ensure_space, size + _BLEND_SIZE * result.size)
            size_of_all = await input_bytes(self._store, job) + size
            staged = await run(self._stage, folder, job, [result, *others], size=size_of_all)
            parts = {RESULT: blend.weight, **{_staged_name(job, row): blend.others[row.job_id] for row in others}}
            file = f"blend{blend.format.suffix}"
            limits = {"name": file, "parts": parts, "bytes": _BLEND_SIZE * result.size + _HEADER_BYTES}
            findings_of(await process.ask(self._request("blend", folder, job, staged, limits, size)))
            files = {blend.name: folder / file}
            await run(self._publish, job, result, files, quotas, size=_BLEND_SIZE * result.size)

    def _check_count(self, job: JobRow) -> None:
        if sum(row.name.startswith(_BLENDS) for row in self._store.jobs.artifacts(job.id)) >= MOST_BLENDS:
            raise problems.TOO_MANY_BLENDS(job_id=job.id, limit=MOST_BLENDS)

    # --- both -----------------------------------------------------------------------------------------------------

    @asynccontextmanager
    async def _turn(self, job: JobRow) -> AsyncIterator[tuple[InspectionProcess, Path, ArtifactRow]]:
        """Wait for the owner's turn, and provide the process, an empty folder, and the job's result."""
        async with self._lanes.turn(job.owner) as process:
            result = await asyncio.to_thread(self._result, job.id)  # the job may have been deleted meanwhile
            async with self._threads.folder(job.owner, self._folder) as folder:
                yield process, folder, result

    def _stage(self, folder: Path, job: JobRow, results: list[ArtifactRow]) -> Staged:
        """Stage the job's inputs, with results beside them."""
        inputs = self._store.jobs.inputs(job.id)
        rows = self._store.inputs.hold(sorted({entry["sha256"] for entry in inputs}))
        staged = stage(folder, inputs, self._blobs.fetch(rows, folder))
        for result in results:
            self._artifacts.fetch(result.location, folder / _staged_name(job, result), result.sha256)
        return staged

    def _request(
        self, work: str, folder: Path, job: JobRow, staged: Staged, limits: dict[str, Any], size: int
    ) -> dict[str, Any]:
        """Return a request to the inspecting process about scenes of `size` bytes in total."""
        return {
            "work": work,
            "folder": str(folder),
            "staged": staged.model_dump(mode="json"),
            "parameters": stored_parameters(job.parameters).model_dump(mode="json"),
            "limits": limits,
            "seconds": self._settings.inspection_seconds + _SECONDS_PER_BYTE * size,
            "bytes": self._settings.inspection_bytes + MEMORY_PER_BYTE * size,
        }

    def _publish(self, job: JobRow, result: ArtifactRow, files: dict[str, Path], quotas: Quotas) -> None:
        publish_derived(self._store, self._artifacts, job, result, files, quotas)

    async def close(self) -> None:
        """Stop the process, which also aborts any work in progress."""
        for process in self._lanes.slots:
            await process.close()


def publish_derived(
    store: Store,
    artifacts: Artifacts,
    job: JobRow,
    result: ArtifactRow,
    files: dict[str, Path],
    quotas: Quotas,
    *,
    replace: bool = False,
) -> None:
    """Charge the owner of a job for files derived from its result, store them, and make them visible.

    The charge is a receipt until the files have rows. It ends if they cannot be stored, and expires if this process
    dies.

    Args:
        files: Files by name.
        replace: Whether files replace those of the same names.

    Raises:
        QUOTA_EXCEEDED: If they exceed the owner's quota of stored bytes; nothing is stored.
    """
    known = {row.name: row.size for row in store.jobs.artifacts(job.id)} if replace else {}
    size = sum(path.stat().st_size - known.get(name, 0) for name, path in files.items())
    receipt = store.inputs.open_receipt(job.owner, max(0, size), quotas)
    put: list[Published] = []
    unused: list[str] | None = None
    try:
        for name, path in files.items():
            # later than the epoch of the last lease, so that the file is not swept as a leftover of an attempt
            put.append(artifacts.put(job.id, job.lease_epoch + 1, name, path, final=True))
        unused = store.jobs.add_derived(result, put, job.owner, quotas, replace=replace, receipt=receipt)
    finally:
        if unused is None:
            store.inputs.end_receipt(receipt)
        for location in [file.location for file in put] if unused is None else unused:
            artifacts.objects.remove(location)


def remove_leftovers(folder: Path) -> None:
    """Delete folders that a killed process has left behind."""
    for leftover in folder.iterdir():
        if time.time() - leftover.stat().st_mtime > LEFTOVER_SECONDS:
            shutil.rmtree(leftover, ignore_errors=True)


async def input_bytes(store: Store, job: JobRow) -> int:
    """Return the bytes of a job's inputs."""
    return sum(entry["size"] for entry in await asyncio.to_thread(store.jobs.inputs, job.id))


def _staged_name(job: JobRow, result: ArtifactRow) -> str:
    """Return the name of a staged result; those of other jobs are named by the job."""
    return RESULT if result.job_id == job.id else f"{result.job_id}.ply"
