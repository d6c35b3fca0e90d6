"""Clients of the service for programs: `Client`, and `AsyncClient` with the same methods as coroutines.

with Client("http://127.0.0.1:8000") as client:
    job = client.submit("scene.ply", "style.jpg", cameras="cameras.json", preset="preview")
    job = client.wait(job.id)
    client.download(job.id, "stylized.ply")

Both get their methods from `JobMethods`, which implements each method once; see `api.client.transport`.
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

#: Jobs per page of a list.
_PAGE = 200


def no_progress(done: int, total: int) -> None:
    """Ignore progress."""


class JobMethods(Methods):
    """Methods of both clients."""

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
        """Queue a job. Large files are uploaded in parts, and resume after a lost connection.

        Args:
            scene: Scene file.
            style: Style image, or several that are mixed with the weights of the parameter `style_weights`.
            cameras: Camera file or folder, as for `sgsst stylize --cameras`; None requires the parameter `orbit`.
            photos: Folder of photos for the content term; None for unstylized renders.
            webhook: URL that is called when the job has ended; None for none.
            progress: Callback that receives the uploaded bytes and the total bytes of all large files.
            parameters: Fields of `JobParameters`; those that are None are not sent.

        Raises:
            RequestError: If an input cannot be used; the message says which and why.
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
        """Plan a job without queueing it, and return the plan. The other arguments are the same as for `submit`.

        Args:
            planning: Callback that receives the number of surveyed views and the number of all views.
        """
        files = Path(scene), _paths(style), _path(cameras), _path(photos)
        return (yield from uploads.plan_job(files, parameters, progress=progress, planning=planning))

    @Operation
    def upload(self, path: str | Path, name: str | None = None, progress: Progress = no_progress) -> Steps[str]:
        """Upload a file in parts, and return the upload's id. Any number of jobs may use the upload."""
        path = Path(path)
        return (yield from uploads.upload(path, name or path.name, progress))

    @Operation
    def job(self, job_id: str) -> Steps[Job]:
        """Return the current state of a job."""
        return (yield from _job(job_id))

    @Iteration
    def jobs(self, *, status: Sequence[str] = (), limit: int | None = None) -> Walk[Job]:
        """Yield the jobs of this key, newest first."""
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
        """Yield the events of a job as they happen, until it has ended. No event is lost when a connection breaks."""
        yield from self._watch(job_id, after)

    def _watch(self, job_id: str, after: int) -> Steps[None]:
        stream = EventStream(job_id, after)
        while not stream.over:
            try:
                yield Listen(stream)
            except httpx.TransportError as error:
                # stamina cannot do this: each event resets the count of failures
                seconds = stream.broken()
                if stream.failures >= TRIES:
                    raise unreachable(self.url, error) from None
                yield Wait(seconds)
                continue
            if not stream.over and (yield from _job(job_id)).finished:
                return

    @Operation
    def wait(self, job_id: str) -> Steps[Job]:
        """Wait until a job has ended, and return its final state."""
        yield from self._watch(job_id, 0)
        return (yield from _job(job_id))

    @Operation
    def artifacts(self, job_id: str) -> Steps[list[dict[str, Any]]]:
        """Return the files that a job has made so far."""
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
        """Download a file of a job, and check its SHA-256. If part of it was downloaded before, resume from there.

        Args:
            form: Format of stylized.ply, such as "spz"; None for PLY. The service converts the file on the
                first request.

        Raises:
            RequestError: If the file does not exist, or does not exist yet.
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
        """Queue a failed or canceled job again."""
        return Job.of((yield Call("POST", f"/v1/jobs/{job_id}/retry")).json())

    @Operation
    def delete(self, job_id: str) -> Steps[None]:
        """Delete a job that has ended, with its results."""
        yield Call("DELETE", f"/v1/jobs/{job_id}")


def _job(job_id: str) -> Steps[Job]:
    return Job.of((yield Call("GET", f"/v1/jobs/{job_id}")).json())


def _paths(value: str | Path | Sequence[str | Path]) -> list[Path]:
    return [Path(value)] if isinstance(value, str | Path) else [Path(each) for each in value]


def _path(value: str | Path | None) -> Path | None:
    return None if value is None else Path(value)


class Client(JobMethods, BlockingDriver):
    """Client of the service over HTTP.

    Args:
        url: Address of the service. None uses the environment variable SGSST_URL, or port 8000 of this machine if the
            variable is not set.
        key: API key; None uses the environment variable SGSST_KEY.
    """


class AsyncClient(JobMethods, AwaitingDriver):
    """Client like `Client`, with coroutines as methods; `watch` and `jobs` are asynchronous iterators."""
