"""A client of the service, for programs: `Client`, and `AsyncClient` with the same methods to await.

from api.client import Client

with Client("http://127.0.0.1:8000") as client:
    job = client.submit("scene.ply", "style.jpg", cameras="cameras.json", preset="preview")
    job = client.wait(job.id)
    client.download(job.id, "stylized.ply")

Both have their methods from `JobMethods`, which says once what each of them does; see `api.client.transport`.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import httpx

from api.client import uploads
from api.client.answers import Event, Job, unreachable
from api.client.downloads import Download, Progress
from api.client.events import EventStream
from api.client.transport import (
    TRIES,
    AwaitingDriver,
    BlockingDriver,
    Call,
    Fetch,
    Item,
    Iteration,
    Listen,
    Methods,
    Operation,
    Steps,
    Wait,
    Walk,
)

#: Jobs that are asked for at a time.
_PAGE = 200


def no_progress(done: int, total: int) -> None:
    """Tell nobody."""


class JobMethods(Methods):
    """What the clients can do."""

    @Operation
    def submit(
        self,
        /,
        scene: str | Path,
        style: str | Path | Sequence[str | Path],
        *,
        cameras: str | Path | None = None,
        photos: str | Path | None = None,
        webhook: str | None = None,
        progress: Progress = no_progress,
        **parameters: Any,
    ) -> Steps[Job]:
        """Queue a job. Large files go up in parts, and go on after a lost connection.

        Args:
            scene: file.
            style: file; several are mixed, by the parameter `style_weights`.
            cameras: as `sgsst stylize --cameras`; None needs the parameter `orbit`.
            photos: folder, for the content term.
            webhook: URL that is told when the job has ended.
            progress: called with the bytes that are up and those of all large files.
            parameters: see `JobParameters`; None leaves one out.

        Raises:
            RequestError: something cannot be used; the message says what.
        """
        files = Path(scene), _paths(style), _path(cameras), _path(photos)
        return Job.of((yield from uploads.create_job(files, parameters, webhook=webhook, progress=progress)))

    @Operation
    def plan(
        self,
        /,
        scene: str | Path,
        style: str | Path | Sequence[str | Path],
        *,
        cameras: str | Path | None = None,
        photos: str | Path | None = None,
        progress: Progress = no_progress,
        planning: Progress = no_progress,
        **parameters: Any,
    ) -> Steps[dict[str, Any]]:
        """What a job would do and need; nothing is queued. Arguments are those of `submit`.

        Args:
            planning: called with the views that have been looked at and all of them.
        """
        files = Path(scene), _paths(style), _path(cameras), _path(photos)
        return (yield from uploads.plan_job(files, parameters, progress=progress, planning=planning))

    @Operation
    def upload(self, path: str | Path, name: str | None = None, progress: Progress = no_progress) -> Steps[str]:
        """Send a file in parts; returns the upload's id, which many jobs may name."""
        path = Path(path)
        return (yield from uploads.upload(path, name or path.name, progress))

    @Operation
    def job(self, job_id: str) -> Steps[Job]:
        """A job as it is now."""
        return (yield from _job(job_id))

    @Iteration
    def jobs(self, *, status: Sequence[str] = (), limit: int | None = None) -> Walk[Job]:
        """Jobs of this key, the newest first."""
        left = limit
        params: dict[str, Any] = {"status": list(status)}
        while left is None or left > 0:
            params["limit"] = min(left or _PAGE, _PAGE)
            page = (yield Call("GET", "/v1/jobs", {"params": params})).json()
            for data in page["jobs"]:
                yield Item(Job.of(data))
            params["cursor"] = page["next_cursor"]
            left = None if left is None else left - len(page["jobs"])
            if params["cursor"] is None:
                return

    @Iteration
    def watch(self, job_id: str, after: int = 0) -> Walk[Event]:
        """What happens to a job, as it happens, until it has ended; lost connections are taken up again."""
        yield from self._watch(job_id, after)

    def _watch(self, job_id: str, after: int) -> Steps[None]:
        stream = EventStream(job_id, after)
        while not stream.over:
            try:
                yield Listen(stream)
            except httpx.TransportError as error:
                # not stamina's business: each event that comes makes the count of failures begin anew
                seconds = stream.broken()
                if stream.failures >= TRIES:
                    raise unreachable(self.url, error) from None
                yield Wait(seconds)
                continue
            if not stream.over and (yield from _job(job_id)).finished:
                return

    @Operation
    def wait(self, job_id: str) -> Steps[Job]:
        """Wait for a job's end, and return it as it is then."""
        yield from self._watch(job_id, 0)
        return (yield from _job(job_id))

    @Operation
    def artifacts(self, job_id: str) -> Steps[list[dict[str, Any]]]:
        """The files that a job has made so far."""
        found: list[dict[str, Any]] = (yield Call("GET", f"/v1/jobs/{job_id}/artifacts")).json()["artifacts"]
        return found

    @Operation
    def download(
        self,
        job_id: str,
        target: str | Path,
        name: str = "stylized.ply",
        progress: Progress = no_progress,
        form: str | None = None,
    ) -> Steps[Path]:
        """Download a file of a job; a part that is there goes on, and the whole is checked by its SHA-256.

        Args:
            form: of stylized.ply, "compressed.ply" or "spz": the service makes it where it is first asked for.

        Raises:
            RequestError: there is no such file (yet).
        """
        target = Path(target)
        query = f"?format={form}" if form else ""
        yield Fetch(Download(f"/v1/jobs/{job_id}/artifacts/{name}{query}", target, progress))
        return target

    @Operation
    def cancel(self, job_id: str) -> Steps[Job]:
        """Cancel a job."""
        return Job.of((yield Call("POST", f"/v1/jobs/{job_id}/cancel")).json())

    @Operation
    def retry(self, job_id: str) -> Steps[Job]:
        """Queue a job again that failed or was canceled."""
        return Job.of((yield Call("POST", f"/v1/jobs/{job_id}/retry")).json())

    @Operation
    def delete(self, job_id: str) -> Steps[None]:
        """Remove a job that has ended, with its results."""
        yield Call("DELETE", f"/v1/jobs/{job_id}")


def _job(job_id: str) -> Steps[Job]:
    return Job.of((yield Call("GET", f"/v1/jobs/{job_id}")).json())


def _paths(value: str | Path | Sequence[str | Path]) -> list[Path]:
    return [Path(value)] if isinstance(value, str | Path) else [Path(each) for each in value]


def _path(value: str | Path | None) -> Path | None:
    return None if value is None else Path(value)


class Client(JobMethods, BlockingDriver):
    """The service over HTTP.

    Args:
        url: of the service; None for the environment's SGSST_URL, else this machine's port 8000.
        key: API key; None for the environment's SGSST_KEY.
    """


class AsyncClient(JobMethods, AwaitingDriver):
    """As `Client`, with methods to await, and `watch` and `jobs` for `async for`."""
