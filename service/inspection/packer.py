"""Results in packed forms: made once, when somebody asks for them, and kept beside the PLY.

They are made by `service.inspection.process`, in a child with limits: the API's process never reads a scene.
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

from service.errors import NotFoundError
from service.files.artifacts import Artifacts
from service.files.blobs import Blobs
from service.files.names import RESULT
from service.files.staging import Staged, stage
from service.inspection.inspector import LEFT_SECONDS, MEMORY_PER_BYTE, InspectionProcess, found_or_refused
from service.parameters import stored_parameters
from service.settings import ServiceSettings
from service.store import Store
from service.store.leases import Published
from service.store.tables import ArtifactRow, JobRow
from sgsst_core.files.scene_headers import PackedForm, packed_name

#: Processor seconds for each byte of a result, on top of those that its inspection may take: it is read, sorted and
#: compressed, and rendered some times. That takes less than a fifth.
_SECONDS_PER_BYTE = 600 / 1e9


class Packer:
    """Makes packed results, one after the other; those who ask for the same wait for the same."""

    def __init__(self, settings: ServiceSettings, store: Store, blobs: Blobs, artifacts: Artifacts) -> None:
        self._settings, self._store, self._blobs, self._artifacts = settings, store, blobs, artifacts
        self._process = InspectionProcess()
        self._making: dict[tuple[str, str], asyncio.Task[None]] = {}
        self._folder = settings.folder / "packing"
        self._folder.mkdir(parents=True, exist_ok=True)
        for left in self._folder.iterdir():  # by a process that was killed
            if time.time() - left.stat().st_mtime > LEFT_SECONDS:
                shutil.rmtree(left, ignore_errors=True)

    async def packed(self, job: JobRow, form: PackedForm) -> ArtifactRow:
        """A job's result in a packed form; beside it lies what that loses, as JSON.

        Raises:
            NotFoundError: the job has no result (yet), or it is gone.
            RefusedInputError: the form cannot hold it, or making it takes more than allowed.
            BusyError, NoSpaceError: it cannot be made now.
        """
        name = packed_name(RESULT, form)
        result = await asyncio.to_thread(self._store.jobs.artifact, job.id, RESULT)
        if result is None:
            raise NotFoundError(f"Job {job.id} has no file {RESULT!r} (yet). Its artifacts list has all there are.")
        found = await asyncio.to_thread(self._store.jobs.artifact, job.id, name)
        if found is None:
            task = self._making.get((job.id, name))
            if task is None:
                task = asyncio.create_task(self._make(job, result, name))
                self._making[job.id, name] = task
                task.add_done_callback(lambda done: self._making.pop((job.id, name), None))
            await asyncio.shield(task)
            found = await asyncio.to_thread(self._store.jobs.artifact, job.id, name)
        if found is None:
            raise NotFoundError(f"The results of job {job.id} are gone.")
        return found

    async def _make(self, job: JobRow, result: ArtifactRow, name: str) -> None:
        """Pack, put the files to their place, and make them visible."""
        self._blobs.ensure_room(3 * result.size)
        with tempfile.TemporaryDirectory(dir=self._folder) as folder:
            staged = await asyncio.to_thread(self._stage, Path(folder), job, result)
            request = {
                "work": "pack",
                "folder": folder,
                "staged": staged.as_json(),
                "parameters": stored_parameters(job.parameters).model_dump(mode="json"),
                "limits": {"name": name},
                "seconds": self._settings.inspection_seconds + _SECONDS_PER_BYTE * result.size,
                "bytes": self._settings.inspection_bytes + MEMORY_PER_BYTE * result.size,
            }
            loss = found_or_refused(await self._process.ask(request))
            await asyncio.to_thread(self._publish, Path(folder), job, result, name, loss)

    def _stage(self, folder: Path, job: JobRow, result: ArtifactRow) -> Staged:
        """The job's inputs, and the result in the scene's place."""
        rows = self._store.inputs.blobs(sorted({entry["sha256"] for entry in job.inputs}))
        staged = stage(folder, job.inputs, self._blobs.bring(rows, folder))
        self._artifacts.fetch(result.location, folder / RESULT, result.sha256)
        return replace(staged, scene=Path(RESULT))

    def _publish(self, folder: Path, job: JobRow, result: ArtifactRow, name: str, loss: dict[str, Any]) -> None:
        loss_file = folder / "loss.json"
        loss_file.write_text(json.dumps(loss, indent=1) + "\n")
        # behind the last lease's epoch, so that no sweep takes them for what an attempt has left
        epoch = job.lease_epoch + 1
        files: list[Published] = [
            self._artifacts.put(job.id, epoch, f"{name}.json", loss_file, final=True),
            self._artifacts.put(job.id, epoch, name, folder / name, final=True),
        ]
        for location in self._store.jobs.add_made(result, files):
            self._artifacts.remove(location)

    async def close(self) -> None:
        """End what is being made."""
        await self._process.close()
