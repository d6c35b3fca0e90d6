"""Results in compressed formats, created on the first request and stored beside the PLY.

`service.inspection.process` creates them in a child process with resource limits, so that the API process
never reads a scene.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from service.errors import NoArtifactError, NotFoundError
from service.files.artifacts import Artifacts
from service.files.blobs import Blobs
from service.files.staging import RESULT, Staged, stage
from service.inspection.inspector import LEFTOVER_SECONDS, MEMORY_PER_BYTE, InspectionProcess, findings_of
from service.parameters import stored_parameters
from service.settings import ServiceSettings
from service.store import Store
from service.store.leases import Published
from service.store.tables import ArtifactRow, JobRow
from sgsst_core.files.formats import result_name
from sgsst_core.files.formats.scene_format import SceneFormat

#: Additional CPU seconds per byte of a result, for reading, sorting, compressing, and rendering it several times.
#: Actual use is less than a fifth.
_SECONDS_PER_BYTE = 600 / 1e9


class Compressor:
    """Compressor of results, one at a time; concurrent requests for the same result share one task."""

    def __init__(self, settings: ServiceSettings, store: Store, blobs: Blobs, artifacts: Artifacts) -> None:
        self._settings, self._store, self._blobs, self._artifacts = settings, store, blobs, artifacts
        self._process = InspectionProcess()
        self._tasks: dict[tuple[str, str], asyncio.Task[None]] = {}
        self._folder = settings.folder / "packing"
        self._folder.mkdir(parents=True, exist_ok=True)
        for leftover in self._folder.iterdir():  # left behind by a killed process
            if time.time() - leftover.stat().st_mtime > LEFTOVER_SECONDS:
                shutil.rmtree(leftover, ignore_errors=True)

    async def compressed(self, job: JobRow, format: SceneFormat) -> ArtifactRow:
        """Return a job's result in a compressed format; the compression error is stored beside it as JSON.

        Raises:
            NotFoundError: If the job has no result yet, or the result is gone.
            RefusedInputError: If the format cannot represent the result, or compressing exceeds the limits.
            BusyError, NoSpaceError: If the result cannot be compressed now.
        """
        name = result_name(RESULT, format)
        result = await asyncio.to_thread(self._store.jobs.artifact, job.id, RESULT)
        if result is None:
            raise NoArtifactError(job.id, RESULT)
        row = await asyncio.to_thread(self._store.jobs.artifact, job.id, name)
        if row is None:
            task = self._tasks.get((job.id, name))
            if task is None:
                task = asyncio.create_task(self._compress(job, result, name))
                self._tasks[job.id, name] = task
                task.add_done_callback(lambda done: self._tasks.pop((job.id, name), None))
            await asyncio.shield(task)
            row = await asyncio.to_thread(self._store.jobs.artifact, job.id, name)
        if row is None:
            raise NotFoundError(f"The results of job {job.id} are gone.")
        return row

    async def _compress(self, job: JobRow, result: ArtifactRow, name: str) -> None:
        """Compress the result, store the files, and make them visible."""
        self._blobs.ensure_space(3 * result.size)
        with tempfile.TemporaryDirectory(dir=self._folder) as folder:
            staged = await asyncio.to_thread(self._stage, Path(folder), job, result)
            request = {
                "work": "compress",
                "folder": folder,
                "staged": staged.as_json(),
                "parameters": stored_parameters(job.parameters).model_dump(mode="json"),
                "limits": {"name": name},
                "seconds": self._settings.inspection_seconds + _SECONDS_PER_BYTE * result.size,
                "bytes": self._settings.inspection_bytes + MEMORY_PER_BYTE * result.size,
            }
            loss = findings_of(await self._process.ask(request))
            await asyncio.to_thread(self._publish, Path(folder), job, result, name, loss)

    def _stage(self, folder: Path, job: JobRow, result: ArtifactRow) -> Staged:
        """Stage the job's inputs, with the result in place of the scene."""
        rows = self._store.inputs.blobs(sorted({entry["sha256"] for entry in job.inputs}))
        staged = stage(folder, job.inputs, self._blobs.fetch(rows, folder))
        self._artifacts.fetch(result.location, folder / RESULT, result.sha256)
        return replace(staged, scene=Path(RESULT))

    def _publish(self, folder: Path, job: JobRow, result: ArtifactRow, name: str, loss: dict[str, Any]) -> None:
        loss_file = folder / "loss.json"
        loss_file.write_text(json.dumps(loss, indent=1) + "\n")
        # later than the epoch of the last lease, so that the files are not swept as leftovers of an attempt
        epoch = job.lease_epoch + 1
        files: list[Published] = [
            self._artifacts.put(job.id, epoch, f"{name}.json", loss_file, final=True),
            self._artifacts.put(job.id, epoch, name, folder / name, final=True),
        ]
        for location in self._store.jobs.add_derived(result, files):
            self._artifacts.remove(location)

    async def close(self) -> None:
        """Stop the process, which also aborts any compression in progress."""
        await self._process.close()
