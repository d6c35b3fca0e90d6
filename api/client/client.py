"""Clients of the service: `AsyncClient`, and `Client` with the same methods for programs without an event loop.

with Client("http://127.0.0.1:8000") as client:
    job = client.submit("scene.ply", "style.jpg", cameras="cameras.json", preset="preview")
    job = client.wait(job.id)
    client.download(job.id, "stylized.ply")
"""

from __future__ import annotations

import base64
import functools
import hashlib
import json
import os
import re
import secrets
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, Self, TypeVar, cast
from urllib.parse import quote

import anyio
import httpx2
from anyio.from_thread import start_blocking_portal

from api.client.transport import (
    TRIES,
    ApiError,
    Event,
    Job,
    Progress,
    RequestError,
    Transport,
    checked,
    has_events,
    in_thread,
    json_text,
)
from service.states import Transition
from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import ensure_writable_folder
from sgsst_core.files.camera_folder import find_cameras, label
from sgsst_core.files.formats import download_of_name, scene_path
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.sog import INDEX_NAME, pack
from worker.options import path_or_url

P = ParamSpec("P")
T = TypeVar("T")
_END = object()
#: Jobs per page of a list.
_PAGE = 200
#: Seconds of silence after which a stream is considered dead; the service sends something every 15 s.
_SILENCE_SECONDS = 60.0
#: Seconds to wait before reconnecting to a stream. The wait doubles with each further connection without an event.
FIRST_WAIT = 1.0


#: IDs that do not change the path of a request.
_ID = re.compile(r"\w+", re.ASCII)


def no_progress(done: int, total: int) -> None:
    """Ignore progress."""


class AsyncClient:
    """Client of the service over HTTP.

    Args:
        url: Address of the service. None uses the environment variable SGSST_URL, or port 8000 of this machine if the
            variable is not set.
        key: API key; None uses the environment variable SGSST_KEY.

    Raises:
        RequestError: If address, key, or a proxy or certificate file that the environment names cannot be used.

    Attributes:
        url: Address of the service.
    """

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        self._transport = Transport(url, key)
        self.url = self._transport.url

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *ignored: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        await self._transport.http.aclose()

    async def submit(
        self,
        /,
        scene: str | Path,
        style: str | Path | Sequence[str | Path] = (),
        *,
        cameras: str | Path | None = None,
        photos: str | Path | None = None,
        masks: Mapping[str, str | Path] | None = None,
        painted: Mapping[str | Path, Mapping[str, Any]] | None = None,
        webhook: str | None = None,
        webhook_events: Sequence[str] = (),
        progress: Progress = no_progress,
        **parameters: Any,
    ) -> Job:
        """Queue a job. Large files are uploaded in parts, and resume after a lost connection.

        Scene, styles and cameras may be URLs that the service fetches, if its operator allows their hosts, or files of
        earlier jobs, such as "/v1/jobs/JOB/artifacts/stylized.ply".

        Args:
            style: Style image, or several that are mixed with the weights of the parameter `style_weights`; none with
                `painted`.
            cameras: Camera file or folder, as for `sgsst stylize --cameras`; None for an orbit.
            photos: Folder of photos for the content term; None for unstylized renders.
            masks: Mask files, or folders of mask images, by the names that the parameter `regions` gives them
                (`mask=NAME`, `masks=NAME`).
            painted: Painted images, which the scene follows, each with its view: {"view": NAME}, {"camera": {...}} as
                in the REST API, or {} for a PNG that states its view.
            webhook: URL that gets a message when the job has ended; None for none.
            webhook_events: Messages that it gets instead: of "started", "progress", "completed".
            progress: Callback that receives the uploaded bytes and the total bytes of all large files.
            parameters: Fields of `JobParameters`; those that are None are not sent.

        Raises:
            RequestError: If an input cannot be used; the message says which and why.
        """
        fields = await self._send(parameters, progress, scene, style, cameras, photos, masks, painted)
        given = {"webhook": webhook, "webhook_events": ",".join(webhook_events)}
        fields += [(name, (None, value)) for name, value in given.items() if value]
        headers = {"Idempotency-Key": secrets.token_hex(16)}
        return Job.of(await self._transport.json("POST", "/v1/jobs", files=fields, headers=headers))

    async def plan(
        self,
        /,
        scene: str | Path,
        style: str | Path | Sequence[str | Path] = (),
        *,
        cameras: str | Path | None = None,
        photos: str | Path | None = None,
        masks: Mapping[str, str | Path] | None = None,
        painted: Mapping[str | Path, Mapping[str, Any]] | None = None,
        progress: Progress = no_progress,
        planning: Progress = no_progress,
        **parameters: Any,
    ) -> dict[str, Any]:
        """Plan a job without queueing it, and return the plan. The other arguments are the same as for `submit`.

        Args:
            planning: Callback that receives the number of completed views of the survey, and of all.
        """
        fields = await self._send(parameters, progress, scene, style, cameras, photos, masks, painted)
        return await self._transport.work("/v1/jobs", "planning", planning, params={"dry_run": True}, files=fields)

    async def _send(
        self,
        parameters: dict[str, Any],
        progress: Progress,
        scene: str | Path,
        style: str | Path | Sequence[str | Path],
        cameras: str | Path | None,
        photos: str | Path | None,
        masks: Mapping[str, str | Path] | None,
        painted: Mapping[str | Path, Mapping[str, Any]] | None,
    ) -> list[tuple[str, Any]]:
        """Upload the large files of a job, and return the form fields of its request, which hold all else."""
        parameters |= {"painted": [*painted.values()]} if painted else {}
        given = json_text({name: value for name, value in parameters.items() if value is not None})
        styles = [style] if isinstance(style, str | Path) else style
        with tempfile.TemporaryDirectory() as folder:
            packed = await in_thread(_packed, path_or_url(scene), Path(folder))
            inputs = await in_thread(
                input_files,
                packed,
                [path_or_url(each) for each in styles],
                None if cameras is None else path_or_url(cameras),
                None if photos is None else Path(photos),
                {name: Path(path) for name, path in (masks or {}).items()},
                [Path(path) for path in painted or ()],
            )
            total = sum(file.size for file in inputs if file.size > PART_BYTES)
            done = 0
            fields: list[tuple[str, Any]] = [("parameters", (None, given))]
            for file in inputs:
                if isinstance(file.source, str):
                    fields.append((file.role, (None, file.source)))
                elif file.size > PART_BYTES:
                    report = partial(lambda before, now, _size: progress(before + now, total), done)
                    fields.append((file.role, (None, await self.upload(file.source, file.name, report))))
                    done += file.size
                else:
                    content = await in_thread(file.source.read_bytes)
                    fields.append((file.role, (file.name, content, "application/octet-stream")))
        return fields

    async def upload(self, path: str | Path, name: str | None = None, progress: Progress = no_progress) -> str:
        """Upload a file in parts, and return the upload's id. Any number of jobs may use the upload."""
        path = Path(path)
        size = (await in_thread(path.stat)).st_size
        creation = {
            **_TUS,
            "Upload-Length": str(size),
            "Upload-Metadata": f"filename {base64.b64encode((name or path.name).encode()).decode()}",
            "Idempotency-Key": secrets.token_hex(16),
        }
        created = await self._transport.json("POST", "/v1/uploads", headers=creation)
        where = f"/v1/uploads/{created['id']}"
        offset = int(created["offset"])
        while offset < size:
            part, headers = await in_thread(_read_part, path, offset)
            try:
                await self._transport.call("PATCH", where, content=part, headers=headers)
                offset += len(part)
            except ApiError as error:
                if error.status != 409:
                    raise
                offset = int((await self._transport.call("HEAD", where, headers=_TUS)).headers["Upload-Offset"])
            progress(offset, size)
        return str(created["id"])

    async def job(self, job_id: str) -> Job:
        """Return the current state of a job."""
        return Job.of(await self._transport.json("GET", _job_path(job_id)))

    async def jobs(self, *, status: Sequence[str] = (), limit: int | None = None) -> AsyncIterator[Job]:
        """Yield the jobs of this key, newest first."""
        left = limit
        params: dict[str, Any] = {"status": list(status)}
        while left is None or left > 0:
            params["limit"] = min(left or _PAGE, _PAGE)
            page = await self._transport.json("GET", "/v1/jobs", params=params)
            for data in page["jobs"]:
                yield Job.of(data)
            params["cursor"] = page["next_cursor"]
            left = None if left is None else left - len(page["jobs"])
            if params["cursor"] is None:
                return

    async def watch(self, job_id: str, after: int = 0) -> AsyncIterator[Event]:
        """Yield the events of a job as they happen, until it has ended. No event is lost when a connection breaks."""
        failures = 0
        timeout = httpx2.Timeout(30.0, read=_SILENCE_SECONDS)
        while True:
            headers = {"Last-Event-ID": str(after)} if after else {}
            path = f"{_job_path(job_id)}/events"
            try:
                async with self._transport.http.sse(path, headers=headers, timeout=timeout) as source:
                    self._transport.reached = True
                    if not has_events(source.response):  # 204: no events will follow
                        await source.response.aread()
                        checked(source.response)
                        return
                    async for sent in source:
                        if sent.data:  # messages without data only keep the connection alive
                            event = Event(int(sent.id or 0), sent.event, json.loads(sent.data))
                            after, failures = event.id, 0
                            yield event
            except (httpx2.RequestError, ApiError, ExceptionGroup) as error:
                # stamina cannot do this: each event resets the count of failures
                failures += 1
                if failures >= TRIES or not self._transport.may_pass(error):
                    raise (error if isinstance(error, ApiError) else self._transport.unreachable(error)) from None
                await anyio.sleep(FIRST_WAIT * 2.0 ** (failures - 1))
                continue
            if (await self.job(job_id)).finished:
                return

    async def wait(self, job_id: str) -> Job:
        """Wait until a job has ended, and return its final state."""
        async for _ in self.watch(job_id):
            pass
        return await self.job(job_id)

    async def artifacts(self, job_id: str) -> list[dict[str, Any]]:
        """Return the files that a job has made so far."""
        artifacts: list[dict[str, Any]] = []
        cursor: str | None = ""
        while cursor is not None:
            page = await self._transport.json(
                "GET", f"{_job_path(job_id)}/artifacts", params={"cursor": cursor} if cursor else {}
            )
            artifacts += page["artifacts"]
            cursor = page.get("next_cursor")  # services of earlier versions send all at once
        return artifacts

    async def download(
        self,
        job_id: str,
        target: str | Path,
        name: str = "stylized.ply",
        progress: Progress = no_progress,
        format: str | None = None,
    ) -> Path:
        """Download a file of a job, and check its SHA-256. If part of it was downloaded before, resume from there.

        Args:
            format: Format of stylized.ply, such as "spz"; None for that of the target's name. The service converts
                the file on the first request.

        Raises:
            RequestError: If the file does not exist, or does not exist yet.
            OutputError: If the target is a folder, its folder cannot be written or created, or stylized.ply cannot be
                saved with its suffix.
        """
        target = Path(target)
        if format is None and name == "stylized.ply":
            format = download_of_name(target.name)
        if target.is_dir():
            raise OutputError(f"{target}: is a folder. Name the file to write.")
        await in_thread(ensure_writable_folder, target.parent)
        query = f"?format={format}" if format and format != PLY.name else ""
        await self._transport.fetch(f"{_job_path(job_id)}/artifacts/{quote(name)}{query}", target, progress)
        return target

    async def blend(
        self, job_id: str, weight: float, others: Mapping[str, float] | None = None, format: str = "ply"
    ) -> str:
        """Blend a finished job's scene with its result, and return the name of the blend for `download`.

        Args:
            job_id: Job whose scene and result are blended, and that stores the blend.
            weight: Weight of the job's result. The scene has the remaining weight up to 1.
            others: Weights of results of other jobs of the same scene by job id.
            format: Format of the blend, such as "spz".

        Raises:
            RequestError: If a job has no result, or its result has other Gaussians than the scene.
        """
        parts = [{"job_id": other, "weight": each} for other, each in (others or {}).items()]
        body = {"weight": weight, "others": parts, "format": format}
        return str((await self._transport.json("POST", f"{_job_path(job_id)}/blends", json=body))["name"])

    async def video(self, /, job_id: str, progress: Progress = no_progress, **options: Any) -> str:
        """Render a video of a finished job's result, and return its name for `download`. It takes minutes.

        Args:
            job_id: Job whose result is shown, and whose earlier video is replaced.
            progress: Callback that receives the number of rendered frames and the number of all frames.
            options: Options of `POST /v1/jobs/{id}/video`, such as `path="cameras"`, `seconds=8` and `compare=True`.

        Raises:
            RequestError: If the job has no result, or an option is invalid.
        """
        video = await self._transport.work(f"{_job_path(job_id)}/video", "rendering", progress, json=options)
        return str(video["name"])

    async def usage(self, since: str | None = None, until: str | None = None) -> list[dict[str, Any]]:
        """Return the usage of the key by day; with an operator's key, or without keys, that of all keys.

        Args:
            since: First day (UTC), such as "2026-11-01"; None for the 30 days up to `until`.
            until: Last day; None for today.
        """
        days = {name: day for name, day in (("since", since), ("until", until)) if day is not None}
        return list((await self._transport.json("GET", "/v1/usage", params=days))["usage"])

    async def act(self, job_id: str, action: str) -> Job:
        """Request an action on a job by its name in `service.states.ACTIONS`."""
        return Job.of(await self._transport.json("POST", f"{_job_path(job_id)}/{action}"))

    async def finish(self, job_id: str) -> Job:
        """End a running job after its current step, and keep its result so far."""
        return await self.act(job_id, Transition.FINISH)

    async def cancel(self, job_id: str) -> Job:
        """Cancel a job."""
        return await self.act(job_id, Transition.CANCEL)

    async def retry(self, job_id: str) -> Job:
        """Queue a failed, canceled or stopped job again."""
        return await self.act(job_id, Transition.RETRY)

    async def share(self, job_id: str, days: float = 7.0, *, poster: bool = False) -> dict[str, Any]:
        """Create a read-only link to a result; `url` is its address, `embed_url` that for a frame in another page.

        Args:
            days: Lifetime of the link, from a minute (1 / 1440) to 90.
            poster: Whether sites where the link is posted can show an image of the result.
        """
        body = {"days": days, "poster": poster}
        share: dict[str, Any] = await self._transport.json("POST", f"{_job_path(job_id)}/shares", json=body)
        for name in ("url", "embed_url"):
            if share.get(name):
                share[name] = f"{self.url}/shared{share[name].rpartition('/shared')[2]}"
        return share

    async def delete(self, job_id: str) -> None:
        """Delete a job that has ended, with its results."""
        await self._transport.call("DELETE", _job_path(job_id))


def _job_path(job_id: str) -> str:
    """Return the path of a job in the API.

    Raises:
        RequestError: If no job can have this ID.
    """
    if not _ID.fullmatch(job_id):
        raise RequestError(f"There is no job {job_id!r}. `sgsst jobs` lists the IDs of jobs.", 404)
    return f"/v1/jobs/{job_id}"


def _blocking(
    method: Callable[Concatenate[AsyncClient, P], Coroutine[Any, Any, T]],
) -> Callable[Concatenate[Client, P], T]:
    """Return a blocking method for a coroutine method, with its signature and docstring."""

    @functools.wraps(method)
    def blocking(client: Client, *args: P.args, **options: P.kwargs) -> T:
        return client._run(functools.partial(method, client._client, *args, **options))

    return cast("Callable[Concatenate[Client, P], T]", blocking)


def _iterating(
    method: Callable[Concatenate[AsyncClient, P], AsyncIterator[T]],
) -> Callable[Concatenate[Client, P], Iterator[T]]:
    """Return an iterator method for an asynchronous iterator method, with its signature and docstring."""

    @functools.wraps(method)
    def iterating(client: Client, *args: P.args, **options: P.kwargs) -> Iterator[T]:
        items: Any = method(client._client, *args, **options)

        async def following() -> Any:
            return await anext(items, _END)

        try:
            while (item := client._run(following)) is not _END:
                yield item
        finally:
            # An interrupt can leave the iteration running; it is canceled with the portal.
            with suppress(RuntimeError):
                client._run(items.aclose)

    return cast("Callable[Concatenate[Client, P], Iterator[T]]", iterating)


class Client:
    """Client of the service over HTTP, with the arguments, errors and attributes of `AsyncClient`."""

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        self._client = AsyncClient(url, key)  # first: if it raises, no thread may be left running
        self._stack = ExitStack()
        self._portal = self._stack.enter_context(start_blocking_portal())
        # cancels coroutines that interrupted calls left running
        self._stack.callback(self._portal.call, self._portal.stop, True)
        self._stack.callback(self._portal.call, self._client.close)
        self.url = self._client.url

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ignored: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._stack.close()

    def _run(self, function: Callable[[], Awaitable[T]]) -> T:
        """Run a coroutine function in the portal's thread. If this thread is interrupted, the coroutine is canceled."""
        future = self._portal.start_task_soon(function)
        try:
            return future.result()
        except BaseException:
            future.cancel()
            raise

    submit = _blocking(AsyncClient.submit)
    plan = _blocking(AsyncClient.plan)
    upload = _blocking(AsyncClient.upload)
    job = _blocking(AsyncClient.job)
    jobs = _iterating(AsyncClient.jobs)
    watch = _iterating(AsyncClient.watch)
    wait = _blocking(AsyncClient.wait)
    artifacts = _blocking(AsyncClient.artifacts)
    download = _blocking(AsyncClient.download)
    blend = _blocking(AsyncClient.blend)
    video = _blocking(AsyncClient.video)
    usage = _blocking(AsyncClient.usage)
    act = _blocking(AsyncClient.act)
    finish = _blocking(AsyncClient.finish)
    cancel = _blocking(AsyncClient.cancel)
    retry = _blocking(AsyncClient.retry)
    share = _blocking(AsyncClient.share)
    delete = _blocking(AsyncClient.delete)


# --- files that a client sends for a job -----------------------------------------------------------------------------

#: Maximum bytes of a part; larger files are uploaded in parts.
PART_BYTES = 16 << 20
#: Protocol version of uploads, which every request must state.
_TUS = {"Tus-Resumable": "1.0.0"}


def _read_part(path: Path, offset: int) -> tuple[bytes, dict[str, str]]:
    """Return a part of a file, and the headers to send it with."""
    with path.open("rb") as file:
        file.seek(offset)
        part = file.read(PART_BYTES)
    if not part:
        raise RequestError(f"{path}: was truncated during the upload. Send it again.")
    digest = base64.b64encode(hashlib.sha256(part).digest()).decode()
    return part, {
        **_TUS,
        "Upload-Offset": str(offset),
        "Upload-Checksum": f"sha256 {digest}",
        "Content-Type": "application/offset+octet-stream",
    }


def _packed(scene: Path | str, folder: Path) -> Path | str:
    """Return the scene, in an archive in `folder` if it is an unpacked streamed SOG."""
    index = scene_path(scene) if isinstance(scene, Path) else None
    if index is None or index.name != INDEX_NAME or not index.is_file():
        return scene
    archive = folder / f"{index.absolute().parent.name or 'scene'}.zip"
    pack(index, archive)
    return archive


IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp", ".gif", ".avif", ".heic", ".heif", ".hif")


@dataclass(frozen=True)
class InputFile:
    """File of a job: its role, its path or the URL that the service fetches it from, its name there, and its bytes."""

    role: str
    source: Path | str
    name: str = ""
    size: int = 0


def input_files(
    scene: Path | str,
    styles: Sequence[Path | str],
    cameras: Path | str | None,
    photos: Path | None,
    masks: Mapping[str, Path],
    painted: Sequence[Path],
) -> list[InputFile]:
    """Return all files that a job needs, given paths of local files, or URLs as text.

    Args:
        cameras: Camera file or folder; None for an orbit.
        masks: Mask files, or folders of mask images, by the names that the job's regions give them.
        painted: Painted images of views.

    Raises:
        RequestError: If a local file is missing.
    """
    local_styles = [style for style in styles if isinstance(style, Path)]
    names = iter(different_names(local_styles))
    files = [_input("scene", scene)]
    files += [_input("style", style, next(names) if isinstance(style, Path) else "") for style in styles]
    if cameras is not None:
        files += [
            _input("cameras", each) for each in ([cameras] if isinstance(cameras, str) else camera_files(cameras))
        ]
    files += [_input("photos", path, name) for path, name in (image_files(photos) if photos else [])]
    for mask, path in masks.items():
        images = [(each, f"{mask}/{name}") for each, name in image_files(path)] if path.is_dir() else [(path, mask)]
        files += [_input("mask", each, name) for each, name in images]
    return files + [_input("painted", *each) for each in zip(painted, different_names(painted), strict=True)]


def _input(role: str, source: Path | str, name: str = "") -> InputFile:
    if isinstance(source, str):
        return InputFile(role, source)
    if not source.is_file():
        raise RequestError(f"{source}: not a file. Check the path.")
    return InputFile(role, source, name or source.name, source.stat().st_size)


def different_names(paths: Sequence[Path]) -> list[str]:
    """Return a unique name for each file: its own, prefixed by a number if an earlier file has the same name."""
    names: list[str] = []
    for number, path in enumerate(paths, 1):
        taken, name = {name.lower() for name in names}, path.name
        while name.lower() in taken:
            name = f"{number}_{name}"
        names.append(name)
    return names


def camera_files(path: Path) -> list[Path]:
    """Return the camera files for a path: a JSON file, a COLMAP model or a folder with either.

    It accepts the same paths as `sgsst stylize --cameras`.

    Raises:
        CameraError: If there are none.
    """
    cameras = find_cameras(path)
    if cameras.is_dir():
        suffix = ".bin" if (cameras / "cameras.bin").is_file() else ".txt"
        files = (cameras / f"{name}{suffix}" for name in ("cameras", "images"))  # nothing else of a model is read
        return [file for file in files if file.is_file()] or [path]
    companion = cameras.with_name("dataparser_transforms.json")
    return [cameras, companion] if companion.is_file() and companion != cameras else [cameras]


def image_files(folder: Path) -> list[tuple[Path, str]]:
    """Return all images below a folder, with their paths relative to it.

    Raises:
        RequestError: If there are none.
    """
    visible = (path for path in folder.rglob("*") if not path.name.startswith("."))
    images = sorted(path for path in visible if path.suffix.lower() in IMAGE_SUFFIXES and path.is_file())
    if not images:
        raise RequestError(f"{folder}: contains no images. Give a folder of image files.")
    return [(path, label(os.fsencode(path.relative_to(folder).as_posix()))) for path in images]
