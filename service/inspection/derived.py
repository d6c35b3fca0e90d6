"""Files derived from results on request, and stored beside them: compressed formats, blends, pages and videos.

`service.inspection.process` creates them in a child process with resource limits, so that the API process
never reads a scene.
"""

import asyncio
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from service import problems
from service.deadlines import FileThreads, suspended
from service.files.blobs import Blobs
from service.files.objects import Artifacts
from service.inputs import RESULT, Staged, WorkRequest, stage, stored_parameters
from service.inspection.inspector import (
    MEMORY_PER_BYTE,
    Kind,
    Processes,
    Show,
    findings_of,
    working_folder,
)
from service.problems import LostFileError
from service.settings import ServiceSettings
from service.states import Published
from service.store import Store
from service.store.keys import Quotas
from service.store.tables import ArtifactRow, JobRow
from sgsst_core.files.formats import result_name
from sgsst_core.files.formats.scene_format import SceneFormat
from worker.options import DEFAULT_SIDE, JobVideo, Viewpoints

#: Additional CPU seconds per byte of scene and results, for reading, sorting, compressing, and rendering them several
#: times. Actual use is less than a fifth.
_SECONDS_PER_BYTE = 600 / 1e9
#: Additional bytes of a derived file: headers, the viewer of a page, or the image of a viewpoint, which takes less than
#: 3 per pixel even for noise.
_MORE_BYTES = 3 << 20
#: Largest sizes relative to the result: of a blend, because a PLY with 8-bit values may become one with float32 values,
#: and of a page with geometry and two color sets in base 85.
_BLEND_SIZE, _PAGE_SIZE = 4, 2
#: Maximum number of blends that are stored with a job.
MOST_BLENDS = 20
#: Names among a job's artifacts: the HTML page that shows the result, the video, and the image of the page's start.
PAGE, VIDEO, POSTER = result_name(RESULT, "html"), "video.mp4", "previews/start.jpg"
#: Limits per frame of a video: CPU seconds per byte of the result and per pixel, of which a fifth is needed, and bytes
#: of the file per pixel, which H.264 does not reach even for noise.
_VIDEO_SECONDS_PER_BYTE, _VIDEO_SECONDS_PER_PIXEL, _VIDEO_BYTES_PER_PIXEL = 4e-8, 1e-6, 1.5
#: Memory of the encoder, which looks some frames ahead.
_ENCODER_BYTES = 1 << 30
_BLENDS = "blends/"


@dataclass(frozen=True)
class Blend:
    """Blend of a job's scene with its result, and with results of other jobs.

    Attributes:
        weight: Weight of the job's result. The scene has the remaining weight up to 1.
        others: Weights of the results of other jobs by job id.
    """

    weight: float
    others: dict[str, float]
    format: SceneFormat

    @property
    def name(self) -> str:
        """Name of the artifact: `blends/stylized_0.7.ply`, with the end of the id before other jobs' weights."""
        parts = [f"{self.weight:g}", *(f"{job_id[-8:]}_{weight:g}" for job_id, weight in sorted(self.others.items()))]
        return f"{_BLENDS}{Path(RESULT).stem}_{'_'.join(parts)}{self.format.suffix}"


@dataclass(frozen=True)
class _Work:
    """Work of the inspecting process that makes a file of a job's result.

    Attributes:
        work: Key of `process.WORK`.
        name: Name of the file among the job's artifacts.
        growth: Largest size of the file relative to the result.
        more: Bytes of the file in addition.
        options: Values for the inspecting process.
        others: Ids of other jobs whose results are needed, by the names of their staged files.
        seconds, memory: CPU seconds and bytes of memory in addition to those for all such work.
    """

    work: str
    name: str
    growth: int = 0
    more: int = _MORE_BYTES
    options: dict[str, Any] = field(default_factory=dict)
    others: dict[str, str] = field(default_factory=dict)
    kind: Kind = "file"
    seconds: float = 0.0
    memory: int = 0


@dataclass
class _Making:
    """File that is being made.

    Attributes:
        watchers: Callbacks that receive the progress.
    """

    work: _Work
    watchers: list[Show] = field(default_factory=list)
    task: asyncio.Task[None] | None = None

    def show(self, now: dict[str, Any]) -> None:
        """Pass progress on to everyone who waits for the file."""
        for watcher in self.watchers:
            watcher(now)


class DerivedFiles:
    """Writer of files derived from results: one video at a time, and one other file; owners take turns.

    Concurrent requests for the same file share one task, which continues even if nobody waits for it any longer, unless
    the service ends. All methods that return a file raise these errors.

    Raises:
        NotFoundError: If a job has no result yet, or the result is gone.
        INVALID_INPUT: If the file cannot be made of it, or making it exceeds the limits.
        QUOTA_EXCEEDED: If the file exceeds the owner's quota of stored bytes.
        BUSY, NoSpaceError: If the file cannot be made now.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        store: Store,
        blobs: Blobs,
        artifacts: Artifacts,
        threads: FileThreads,
        processes: Processes,
    ) -> None:
        self._settings, self._store, self._blobs, self._artifacts = settings, store, blobs, artifacts
        self._threads, self._processes = threads, processes
        self._making: dict[tuple[str, str], _Making] = {}
        self._folder = working_folder(settings, "packing")

    async def compressed(self, job: JobRow, format: SceneFormat, quotas: Quotas) -> ArtifactRow:
        """Return a job's result in a compressed format; the compression error is stored beside it as JSON."""
        work = _Work("compress", result_name(RESULT, format.name), growth=1)
        return await self._existing(job, work.name) or await self._derived(job, work, quotas)

    async def blended(self, job: JobRow, blend: Blend, quotas: Quotas) -> ArtifactRow:
        """Return a blend of a job's scene and results. The owner of the job must also own the others.

        Raises:
            INVALID_INPUT: If the results have other Gaussians than the scene.
            TOO_MANY_BLENDS: If the job has `MOST_BLENDS` already.
        """
        others = {f"{job_id}.ply": job_id for job_id in blend.others}
        parts = {RESULT: blend.weight, **{name: blend.others[job_id] for name, job_id in others.items()}}
        work = _Work("blend", blend.name, _BLEND_SIZE, options={"parts": parts}, others=others)
        return await self._existing(job, work.name) or await self._derived(job, work, quotas)

    async def page(self, job: JobRow, viewer: dict[str, str], quotas: Quotas) -> ArtifactRow:
        """Return the HTML page that shows a job's result in 3D, beside its scene if both have the same Gaussians.

        Args:
            viewer: Sources of the page; see `worker.derived`.
        """
        options = {"viewer": viewer, "title": job.name, "viewpoints": job.viewpoints or {}}
        work = _Work("page", PAGE, _PAGE_SIZE, options=options)
        return await self._existing(job, work.name) or await self._derived(job, work, quotas)

    async def poster(self, job: JobRow, start: dict[str, Any], quotas: Quotas) -> ArtifactRow:
        """Return the image of a job's result at the viewpoint where its page starts; the left half is unstylized.

        Args:
            start: Viewpoint as JSON. If it is not the job's, the image is rendered and replaces the job's.

        Raises:
            BUSY: If the image of another viewpoint is in progress.
        """
        row = await self._existing(job, POSTER)
        if row is not None and job.viewpoints and job.viewpoints["start"] == start:
            return row
        work = _Work("poster", POSTER, options={"viewpoint": start})
        return await self._derived(job, work, quotas)

    async def set_viewpoints(self, job: JobRow, viewpoints: Viewpoints, quotas: Quotas) -> None:
        """Set the viewpoints of the page that shows a job's result, once there is an image of its start."""
        chosen, outdated = viewpoints.model_dump(mode="json"), [PAGE]
        if chosen["start"] is None:
            outdated.append(POSTER)
        else:
            await self.poster(job, chosen["start"], quotas)
        unused = await asyncio.to_thread(self._store.jobs.set_viewpoints, job.id, chosen, outdated)
        if unused:
            await self._threads.run(job.owner, self._artifacts.objects.discard, unused)

    async def video(self, job: JobRow, options: JobVideo, quotas: Quotas, show: Show = lambda now: None) -> ArtifactRow:
        """Render a video of a job's result, which replaces an earlier one, and return it.

        Args:
            show: Callback that receives the progress: `stage`, `step`, `total`, `fraction` and `eta_s`. One step is one
                frame.

        Raises:
            BUSY: If another video of the job is in progress.
        """
        size = (await asyncio.to_thread(self._result, job.id)).size
        side = options.resolution or DEFAULT_SIDE
        pixels = side * side * options.frames * (2 if options.compare else 1)
        work = _Work(
            "video",
            VIDEO,
            more=round(_VIDEO_BYTES_PER_PIXEL * pixels) + _MORE_BYTES,
            options={"video": options.model_dump(mode="json")},
            kind="video",
            seconds=_VIDEO_SECONDS_PER_PIXEL * pixels + _VIDEO_SECONDS_PER_BYTE * size * options.frames,
            memory=MEMORY_PER_BYTE * size + _ENCODER_BYTES,
        )
        return await self._derived(job, work, quotas, show)

    async def _existing(self, job: JobRow, name: str) -> ArtifactRow | None:
        await asyncio.to_thread(self._result, job.id)
        return await asyncio.to_thread(self._store.jobs.artifact, job.id, name)

    async def _derived(self, job: JobRow, work: _Work, quotas: Quotas, show: Show = lambda now: None) -> ArtifactRow:
        """Return the database row of a file after it has been made, in a task that later requests share."""
        key = job.id, work.name
        making = self._making.get(key)
        if making is None:
            making = self._making[key] = _Making(work)
            making.task = asyncio.create_task(self._make(job, work, quotas, making.show))
            making.task.add_done_callback(lambda _: self._making.pop(key))
        elif making.work != work:
            raise problems.BUSY(f"Another {work.name} of this job is being rendered. Try again when it is done.")
        assert making.task is not None
        making.watchers.append(show)
        try:
            with suspended():  # each part of the task has its own limit
                await asyncio.shield(making.task)
        except LostFileError:
            await asyncio.to_thread(self._result, job.id)  # fails if the job was deleted meanwhile
            raise
        finally:
            making.watchers.remove(show)
        row = await asyncio.to_thread(self._store.jobs.artifact, job.id, work.name)
        if row is None:
            raise problems.NOT_FOUND(f"The results of job {job.id} are gone.")
        return row

    def _result(self, job_id: str) -> ArtifactRow:
        row = self._store.jobs.artifact(job_id, RESULT)
        if row is None:
            raise problems.NO_ARTIFACT(job_id=job_id, name=RESULT)
        return row

    async def _make(self, job: JobRow, work: _Work, quotas: Quotas, show: Show) -> None:
        """Wait for the owner's turn, let the inspecting process make a file, store it, and make it visible."""
        run = partial(self._threads.run, job.owner)
        async with (
            self._processes.turn(job.owner, work.kind) as process,
            self._threads.folder(job.owner, self._folder) as folder,
        ):
            result = await asyncio.to_thread(self._result, job.id)  # the job may have been deleted meanwhile
            results = {RESULT: result}
            for name, job_id in work.others.items():
                results[name] = await asyncio.to_thread(self._result, job_id)
            artifacts = await asyncio.to_thread(self._store.jobs.artifacts, job.id)
            if work.work == "blend" and sum(row.name.startswith(_BLENDS) for row in artifacts) >= MOST_BLENDS:
                raise problems.TOO_MANY_BLENDS(job_id=job.id, limit=MOST_BLENDS)
            scene = await asyncio.to_thread(self._store.jobs.input, job.id, "scene", 0)
            size = (scene["size"] if scene else 0) + sum(row.size for row in results.values())
            await run(self._blobs.ensure_space, size + work.growth * result.size)
            most = work.growth * result.size + work.more
            request = WorkRequest(
                work=work.work,
                folder=folder,
                staged=await self._stage(folder, job, results),
                parameters=stored_parameters(job.parameters),
                seconds=self._settings.inspection_seconds + _SECONDS_PER_BYTE * size + work.seconds,
                memory=self._settings.inspection_bytes + MEMORY_PER_BYTE * size + work.memory,
                options=work.options,
                output=(Path(work.name).name, most),
            )
            findings = findings_of(await process.ask(request, show))
            files = {work.name: folder / request.output_file}
            if work.work == "compress":
                files[f"{work.name}.json"] = loss = folder / "loss.json"
                await run(loss.write_text, json.dumps(findings, indent=1) + "\n")
            await run(self._publish, job, result, files, quotas, size=most)

    async def _stage(self, folder: Path, job: JobRow, results: Mapping[str, ArtifactRow]) -> Staged:
        """Stage the job's inputs, with results beside them, given by their names there."""
        inputs = await asyncio.to_thread(self._store.jobs.inputs, job.id)

        def staging() -> Staged:
            rows = self._store.inputs.hold(sorted({entry["sha256"] for entry in inputs}))
            staged = stage(folder, inputs, self._blobs.fetch(rows, folder))
            for name, result in results.items():
                self._artifacts.fetch(result.location, folder / name, result.sha256)
            return staged

        size = sum(entry["size"] for entry in inputs) + sum(result.size for result in results.values())
        return await self._threads.run(job.owner, staging, size=size)

    def _publish(self, job: JobRow, result: ArtifactRow, files: dict[str, Path], quotas: Quotas) -> None:
        """Store files derived from a job's result, and make them visible.

        Raises:
            QUOTA_EXCEEDED: If they exceed the owner's quota of stored bytes; nothing remains stored.
        """
        put: list[Published] = []
        unused: list[str] | None = None
        try:
            for name, path in files.items():
                # later than the epoch of the last lease, so that the file is not swept as a leftover of an attempt
                put.append(self._artifacts.put(job.id, job.lease_epoch + 1, name, path, final=True))
            unused = self._store.jobs.add_derived(result, put, job.owner, quotas)
        finally:
            self._artifacts.objects.discard([file.location for file in put] if unused is None else unused)
