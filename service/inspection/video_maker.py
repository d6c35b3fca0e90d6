"""Videos of finished jobs, rendered on request and stored beside the result.

`service.inspection.process` renders them in a child process with resource limits, so that the API process never reads
a scene.
"""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from service import problems
from service.deadlines import suspended
from service.files.artifacts import Artifacts
from service.files.blobs import Blobs
from service.files.staging import RESULT, Staged, stage
from service.files.threads import FileThreads
from service.inspection.derived import input_bytes, publish_derived, remove_leftovers
from service.inspection.inspector import (
    MEMORY_PER_BYTE,
    InspectionProcess,
    Show,
    findings_of,
    threads_of_a_job,
)
from service.inspection.lanes import Lanes
from service.parameters import stored_parameters
from service.settings import ServiceSettings
from service.store import Store
from service.store.quotas import Quotas
from service.store.tables import ArtifactRow, JobRow
from worker.options import DEFAULT_SIDE, JobVideo

#: Name of the video among a job's artifacts.
VIDEO = "video.mp4"
#: Limits per frame: CPU seconds per byte of the result and per pixel, of which a fifth is needed, and bytes of the file
#: per pixel, which H.264 does not reach even for noise. Videos take an eighth of them at most.
_SECONDS_PER_BYTE, _SECONDS_PER_PIXEL, _BYTES_PER_PIXEL, _USUAL_BYTES = 4e-8, 1e-6, 1.5, 1 / 8
#: Memory of the encoder, which looks some frames ahead.
_ENCODER_BYTES = 1 << 30

_log = logging.getLogger(__name__)


@dataclass
class _Making:
    """Video that is being rendered.

    Attributes:
        options: Options of the video.
        watchers: Callbacks that receive the progress.
        task: Task that renders and publishes it.
    """

    options: JobVideo
    watchers: list[Show] = field(default_factory=list)
    task: asyncio.Task[None] | None = None

    def show(self, now: dict[str, Any]) -> None:
        """Pass progress on to everyone who waits for the video."""
        for watcher in self.watchers:
            watcher(now)


class VideoMaker:
    """Renderer of videos, one at a time; owners take turns.

    A video is rendered to its end even if nobody waits for it any longer, unless the service ends.
    """

    def __init__(
        self, settings: ServiceSettings, store: Store, blobs: Blobs, artifacts: Artifacts, threads: FileThreads
    ) -> None:
        self._settings, self._store, self._blobs, self._artifacts = settings, store, blobs, artifacts
        self._threads = threads
        self._lanes = Lanes([InspectionProcess(threads_of_a_job(settings))])
        self._making: dict[str, _Making] = {}
        self._folder = settings.folder / "videos"
        self._folder.mkdir(parents=True, exist_ok=True)
        remove_leftovers(self._folder)

    async def make(self, job: JobRow, options: JobVideo, quotas: Quotas, show: Show = lambda now: None) -> ArtifactRow:
        """Render a video of a job's result, which replaces an earlier one, and return it.

        Requests for the video that is being rendered share its task.

        Args:
            job: Job with a result.
            options: Options of the video.
            quotas: Quotas of the job's owner.
            show: Callback that receives the progress: `stage`, `step`, `total`, `fraction` and `eta_s`. One step is one
                frame.

        Raises:
            NotFoundError: If the job has no result, or was deleted meanwhile.
            INVALID_INPUT: If the video cannot be rendered, or exceeds the limits.
            QUOTA_EXCEEDED: If the video exceeds the owner's quota of stored bytes.
            BUSY, NoSpaceError: If it cannot be rendered now; another video of the job may be in progress.
        """
        making = self._making.get(job.id)
        if making is None:
            making = self._making[job.id] = _Making(options)
            making.task = asyncio.create_task(self._render(job, making, quotas))
            making.task.add_done_callback(lambda task: self._end(job, task))
        elif making.options != options:
            raise problems.BUSY("Another video of this job is being rendered. Try again when it is done.")
        assert making.task is not None
        making.watchers.append(show)
        try:
            with suspended():  # each part of the task has its own limit
                await asyncio.shield(making.task)
        finally:
            making.watchers.remove(show)
        row = await asyncio.to_thread(self._store.jobs.artifact, job.id, VIDEO)
        if row is None:
            raise problems.NOT_FOUND(f"The results of job {job.id} are gone.")
        return row

    def _end(self, job: JobRow, task: asyncio.Task[None]) -> None:
        del self._making[job.id]
        if not task.cancelled() and (error := task.exception()) is not None:  # perhaps nobody waits any longer
            _log.info("video not made: %s", error, extra={"job": job.id})

    async def _render(self, job: JobRow, making: _Making, quotas: Quotas) -> None:
        """Render the video, store it and make it visible."""
        result = await asyncio.to_thread(self._store.jobs.artifact, job.id, RESULT)
        if result is None:
            raise problems.NO_ARTIFACT(job_id=job.id, name=RESULT)
        options = making.options
        side = options.resolution or DEFAULT_SIDE
        pixels = side * side * options.frames * (2 if options.compare else 1)
        most_bytes = round(_BYTES_PER_PIXEL * pixels) + (1 << 20)
        run = partial(self._threads.run, job.owner)
        await run(self._blobs.ensure_space, 2 * result.size + round(_USUAL_BYTES * most_bytes))
        seconds = _SECONDS_PER_PIXEL * pixels + _SECONDS_PER_BYTE * result.size * options.frames
        async with self._lanes.turn(job.owner) as process, self._threads.folder(job.owner, self._folder) as folder:
            size = result.size + await input_bytes(self._store, job)
            staged = await run(self._stage, folder, job, result, size=size)
            request = {
                "work": "video",
                "folder": str(folder),
                "staged": {**staged.model_dump(mode="json"), "scene": RESULT},
                "parameters": stored_parameters(job.parameters).model_dump(mode="json"),
                "limits": {
                    "name": VIDEO,
                    "options": options.model_dump(mode="json"),
                    "unstylized": str(staged.scene),
                    "bytes": most_bytes,
                },
                "seconds": self._settings.inspection_seconds + seconds,
                "bytes": self._settings.inspection_bytes + 2 * MEMORY_PER_BYTE * result.size + _ENCODER_BYTES,
            }
            findings_of(await process.ask(request, making.show))
            await run(self._publish, folder, job, result, quotas, size=most_bytes)

    def _stage(self, folder: Path, job: JobRow, result: ArtifactRow) -> Staged:
        """Stage the job's inputs, with the result beside them."""
        inputs = self._store.jobs.inputs(job.id)
        rows = self._store.inputs.hold(sorted({entry["sha256"] for entry in inputs}))
        staged = stage(folder, inputs, self._blobs.fetch(rows, folder))
        self._artifacts.fetch(result.location, folder / RESULT, result.sha256)
        return staged

    def _publish(self, folder: Path, job: JobRow, result: ArtifactRow, quotas: Quotas) -> None:
        files = {VIDEO: folder / VIDEO}
        publish_derived(self._store, self._artifacts, job, result, files, quotas, replace=True)

    async def close(self) -> None:
        """Stop the process, which also aborts the video in progress."""
        for process in self._lanes.slots:
            await process.close()
