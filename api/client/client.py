"""A client of the service, for programs: `Client`, and `AsyncClient` with the same methods to await.

from api.client.client import Client

with Client("http://127.0.0.1:8000") as client:
    job = client.submit("scene.ply", "style.jpg", cameras="cameras.json", preset="preview")
    job = client.wait(job.id)
    client.download(job.id, "stylized.ply")
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import hashlib
import json
import os
import secrets
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from sgsst_core.errors import InvalidInputError, SgsstError

DEFAULT_URL = "http://127.0.0.1:8000"
#: Files from this size on are uploaded in parts, which go on after a lost connection.
PART_BYTES = 16 << 20
#: Connections that break are tried again so often, with waits of 1, 2, 4 ... seconds.
TRIES = 6
_FINISHED = ("succeeded", "failed", "canceled", "expired")
_PHOTO_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp"}

Progress = Callable[[int, int], None]


class ApiError(SgsstError):
    """The service refused a request, or could not be reached.

    Attributes:
        status: HTTP status; 0 where there was no answer.
        problem: the problem document.
    """

    code = "api-error"

    def __init__(self, message: str, status: int = 0, problem: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.problem = dict(problem or {})


class RequestError(ApiError, InvalidInputError):
    """The request is at fault: its files, parameters, key or id."""

    code = "api-request"


@dataclass(frozen=True)
class Job:
    """A job as the service last showed it; `data` is the whole answer."""

    id: str
    status: str
    progress: Mapping[str, Any] | None
    error: Mapping[str, Any] | None
    data: Mapping[str, Any]

    @property
    def finished(self) -> bool:
        """Whether nothing more will happen to it."""
        return self.status in _FINISHED

    @staticmethod
    def of(data: Mapping[str, Any]) -> Job:
        """From the service's JSON."""
        return Job(data["id"], data["status"], data.get("progress"), data.get("error"), data)


@dataclass(frozen=True)
class Event:
    """Something that happened to a job: `status`, `progress` or `artifact`."""

    id: int
    kind: str
    data: Mapping[str, Any]


def camera_files(path: Path) -> list[Path]:
    """The files to send for what `sgsst stylize --cameras` takes: a JSON file, a COLMAP model or a folder with either.

    Raises:
        RequestError: there are none.
    """
    if path.is_file() and path.suffix == ".json":
        companion = path.with_name("dataparser_transforms.json")
        return [path, companion] if companion.is_file() and companion != path else [path]
    folder = path if path.is_dir() else path.parent
    for model in (folder, folder / "sparse" / "0", folder / "sparse"):
        for suffix in (".bin", ".txt"):
            if (model / f"cameras{suffix}").is_file():
                names = ("cameras", "images", "points3D", "rigs", "frames")
                return [file for name in names if (file := model / f"{name}{suffix}").is_file()]
    for name in ("transforms.json", "cameras.json"):
        if (folder / name).is_file() and path.is_dir():
            return camera_files(folder / name)
    raise RequestError(f"{path}: holds no cameras. Give a cameras.json, a COLMAP model or a transforms.json.")


def photo_files(folder: Path) -> list[tuple[Path, str]]:
    """All photos below a folder, with the names under which they are sent.

    Raises:
        RequestError: there are none.
    """
    found = sorted(path for path in folder.rglob("*") if path.suffix.lower() in _PHOTO_SUFFIXES and path.is_file())
    if not found:
        raise RequestError(f"{folder}: holds no photos.")
    return [(path, path.relative_to(folder).as_posix()) for path in found]


def _parts(scene: Path, style: Path, cameras: Path | None, photos: Path | None) -> list[tuple[str, Path, str]]:
    """Role, file and name of everything that a job needs."""
    parts = [("scene", scene, scene.name), ("style", style, style.name)]
    parts += [("cameras", path, path.name) for path in (camera_files(cameras) if cameras else [])]
    parts += [("photos", path, name) for path, name in (photo_files(photos) if photos else [])]
    for _, path, _ in parts:
        if not path.is_file():
            raise RequestError(f"{path}: is not a file. Check the path.")
    return parts


def _answer(response: httpx.Response) -> httpx.Response:
    """The response, if it is a good one."""
    if response.status_code < 400:
        return response
    try:
        problem = response.json()
        message = str(problem["detail"])
    except (ValueError, KeyError, TypeError):
        problem, message = {}, f"{response.request.url} answered {response.status_code}"
    kind = RequestError if response.status_code < 500 else ApiError
    raise kind(message, response.status_code, problem)


def _unreachable(base: str, error: Exception) -> ApiError:
    return ApiError(f"{base} cannot be reached ({error}). Is `sgsst serve` running? --url names another address.")


class _Lines:
    """Server-sent events from lines of text."""

    def __init__(self) -> None:
        self._fields: dict[str, str] = {}

    def take(self, line: str) -> Event | None:
        if not line:
            fields, self._fields = self._fields, {}
            if "data" in fields:
                return Event(int(fields.get("id", 0)), fields.get("event", ""), json.loads(fields["data"]))
        elif not line.startswith(":"):
            name, _, value = line.partition(":")
            self._fields[name] = value.removeprefix(" ")
        return None


def _settings(url: str | None, key: str | None) -> dict[str, Any]:
    key = key or os.environ.get("SGSST_KEY")
    return {
        "base_url": url or os.environ.get("SGSST_URL") or DEFAULT_URL,
        "headers": {"Authorization": f"Bearer {key}"} if key else {},
        "timeout": httpx.Timeout(30.0, read=900.0, write=120.0),
    }


def _tus_headers(path: Path, name: str) -> dict[str, str]:
    encoded = base64.b64encode(name.encode()).decode()
    return {
        "Tus-Resumable": "1.0.0",
        "Upload-Length": str(path.stat().st_size),
        "Upload-Metadata": f"filename {encoded}",
        "Idempotency-Key": secrets.token_hex(16),
    }


def _part_headers(offset: int, part: bytes) -> dict[str, str]:
    digest = base64.b64encode(hashlib.sha256(part).digest()).decode()
    return {
        "Tus-Resumable": "1.0.0",
        "Upload-Offset": str(offset),
        "Upload-Checksum": f"sha256 {digest}",
        "Content-Type": "application/offset+octet-stream",
    }


def _again(error: Exception, attempt: int) -> bool:
    """Whether to send the same once more: nothing was answered, or that it is not possible now."""
    transient = isinstance(error, httpx.TransportError) or (
        isinstance(error, ApiError) and error.status in (423, 460, 502, 503, 504)
    )
    return transient and attempt + 1 < TRIES


class Client:
    """The service over HTTP.

    Args:
        url: of the service; None for the environment's SGSST_URL, else this machine's port 8000.
        key: API key; None for the environment's SGSST_KEY.
    """

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        self._http = httpx.Client(**_settings(url, key))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *ignored: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all connections."""
        self._http.close()

    def _call(self, method: str, path: str, **options: Any) -> httpx.Response:
        for attempt in range(TRIES):
            try:
                return _answer(self._http.request(method, path, **options))
            except (httpx.TransportError, ApiError) as error:
                if not _again(error, attempt):
                    if isinstance(error, ApiError):
                        raise
                    raise _unreachable(str(self._http.base_url), error) from None
                time.sleep(2.0**attempt)
        raise AssertionError("unreachable")

    def submit(
        self,
        scene: str | Path,
        style: str | Path,
        *,
        cameras: str | Path | None = None,
        photos: str | Path | None = None,
        webhook: str | None = None,
        progress: Progress = lambda done, total: None,
        **parameters: Any,
    ) -> Job:
        """Queue a job. Large files go up in parts, and go on after a lost connection.

        Args:
            scene, style: files.
            cameras: as `sgsst stylize --cameras`; None needs the parameter `orbit`.
            photos: folder, for the content term.
            webhook: URL that is told when the job has ended.
            progress: called with the bytes that are up and those of all large files.
            parameters: see `JobParameters`; None leaves one out.

        Raises:
            RequestError: something cannot be used; the message says what.
        """
        response = self._submit(scene, style, cameras, photos, webhook, progress, parameters, dry_run=False)
        return Job.of(response.json())

    def plan(
        self,
        scene: str | Path,
        style: str | Path,
        *,
        cameras: str | Path | None = None,
        photos: str | Path | None = None,
        **parameters: Any,
    ) -> dict[str, Any]:
        """What a job would do and need; nothing is queued. Arguments are those of `submit`."""
        response = self._submit(scene, style, cameras, photos, None, lambda *_: None, parameters, dry_run=True)
        answer: dict[str, Any] = response.json()
        return answer

    def _submit(
        self,
        scene: str | Path,
        style: str | Path,
        cameras: str | Path | None,
        photos: str | Path | None,
        webhook: str | None,
        progress: Progress,
        parameters: Mapping[str, Any],
        *,
        dry_run: bool,
    ) -> httpx.Response:
        parts = _parts(Path(scene), Path(style), _path(cameras), _path(photos))
        large = [part for part in parts if part[1].stat().st_size > PART_BYTES]
        total = sum(path.stat().st_size for _, path, _ in large)
        texts = _texts(parameters, webhook)
        done = 0
        fields: list[tuple[str, Any]] = []
        for role, path, name in parts:
            if (role, path, name) in large:
                before = done
                upload = self.upload(path, name, lambda up, _, before=before: progress(before + up, total))  # type: ignore[misc]
                done += path.stat().st_size
                fields.append((role, (None, upload)))
            else:
                fields.append((role, (name, path.read_bytes(), "application/octet-stream")))
        fields += [(name, (None, text)) for name, text in texts]
        headers = {} if dry_run else {"Idempotency-Key": secrets.token_hex(16)}
        return self._call("POST", "/v1/jobs", params={"dry_run": dry_run}, files=fields, headers=headers)

    def upload(self, path: str | Path, name: str | None = None, progress: Progress = lambda done, total: None) -> str:
        """Send a file in parts; returns the upload's id, which many jobs may name."""
        path = Path(path)
        size = path.stat().st_size
        created = self._call("POST", "/v1/uploads", headers=_tus_headers(path, name or path.name)).json()
        where = f"/v1/uploads/{created['id']}"
        offset = int(created["offset"])
        with path.open("rb") as file:
            while offset < size:
                file.seek(offset)
                part = file.read(PART_BYTES)
                try:
                    self._call("PATCH", where, content=part, headers=_part_headers(offset, part))
                    offset += len(part)
                except ApiError as error:
                    if error.status != 409:
                        raise
                    offset = int(self._call("HEAD", where).headers["Upload-Offset"])
                progress(offset, size)
        return str(created["id"])

    def job(self, job_id: str) -> Job:
        """A job as it is now."""
        return Job.of(self._call("GET", f"/v1/jobs/{job_id}").json())

    def jobs(self, *, status: Sequence[str] = (), limit: int | None = None) -> Iterator[Job]:
        """Jobs of this key, the newest first."""
        cursor: str | None = None
        left = limit
        while left is None or left > 0:
            params: dict[str, Any] = {"limit": min(left or 200, 200), "status": list(status)}
            page = self._call("GET", "/v1/jobs", params=params | ({"cursor": cursor} if cursor else {})).json()
            yield from map(Job.of, page["jobs"])
            cursor = page["next_cursor"]
            left = None if left is None else left - len(page["jobs"])
            if cursor is None:
                return

    def watch(self, job_id: str, after: int = 0) -> Iterator[Event]:
        """What happens to a job, as it happens, until it has ended; lost connections are taken up again."""
        failures = 0
        while True:
            lines = _Lines()
            try:
                headers = {"Last-Event-ID": str(after)} if after else {}
                timeout = httpx.Timeout(30.0, read=60.0)
                with self._http.stream("GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout) as stream:
                    if stream.status_code != 200:
                        stream.read()
                        _answer(stream)
                        return
                    for line in stream.iter_lines():
                        event = lines.take(line)
                        if event is not None:
                            after, failures = event.id, 0
                            yield event
                if self.job(job_id).finished:
                    return
            except httpx.TransportError as error:
                failures += 1
                if failures >= TRIES:
                    raise _unreachable(str(self._http.base_url), error) from None
                time.sleep(2.0 ** (failures - 1))

    def wait(self, job_id: str) -> Job:
        """Wait for a job's end, and return it as it is then."""
        for _ in self.watch(job_id):
            pass
        return self.job(job_id)

    def artifacts(self, job_id: str) -> list[dict[str, Any]]:
        """The files that a job has made so far."""
        found: list[dict[str, Any]] = self._call("GET", f"/v1/jobs/{job_id}/artifacts").json()["artifacts"]
        return found

    def download(
        self,
        job_id: str,
        target: str | Path,
        name: str = "stylized.ply",
        progress: Progress = lambda done, total: None,
    ) -> Path:
        """Download a file of a job; a part that is there goes on, and the whole is checked by its SHA-256.

        Raises:
            RequestError: there is no such file (yet).
        """
        target = Path(target)
        part = target.with_name(target.name + ".part")
        for attempt in range(TRIES):
            try:
                self._fetch(job_id, name, part, progress)
                part.replace(target)
                return target
            except (httpx.TransportError, ApiError) as error:
                if not _again(error, attempt):
                    raise
                time.sleep(2.0**attempt)
        raise AssertionError("unreachable")

    def _fetch(self, job_id: str, name: str, part: Path, progress: Progress) -> None:
        done = part.stat().st_size if part.exists() else 0
        stamp = part.with_name(part.name + ".etag")
        headers = {}
        if done and stamp.exists():
            headers = {"Range": f"bytes={done}-", "If-Range": stamp.read_text()}
        with self._http.stream("GET", f"/v1/jobs/{job_id}/artifacts/{name}", headers=headers) as stream:
            if stream.status_code >= 400 and stream.status_code != 416:
                stream.read()
                _answer(stream)
            tag = stream.headers.get("etag", "")
            if stream.status_code == 200:
                done = 0
                stamp.write_text(tag)
            if stream.status_code != 416:
                size = done + int(stream.headers.get("content-length", 0))
                with part.open("ab" if done else "wb") as file:
                    for block in stream.iter_bytes(1 << 20):
                        file.write(block)
                        done += len(block)
                        progress(done, size)
        stamp_text = stamp.read_text() if stamp.exists() else tag
        stamp.unlink(missing_ok=True)
        if _sha256(part) != stamp_text.strip('"'):
            part.unlink()
            raise ApiError(f"{name}: what arrived is not what was sent. Try again.", 460)

    def cancel(self, job_id: str) -> Job:
        """Cancel a job."""
        return Job.of(self._call("POST", f"/v1/jobs/{job_id}/cancel").json())

    def retry(self, job_id: str) -> Job:
        """Queue a job again that failed or was canceled."""
        return Job.of(self._call("POST", f"/v1/jobs/{job_id}/retry").json())

    def delete(self, job_id: str) -> None:
        """Remove a job that has ended, with its results."""
        self._call("DELETE", f"/v1/jobs/{job_id}")


class AsyncClient:
    """As `Client`, with methods to await. What reads and writes files does so in threads of its own."""

    def __init__(self, url: str | None = None, key: str | None = None) -> None:
        self._sync = Client(url, key)
        self._http = httpx.AsyncClient(**_settings(url, key))

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *ignored: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Close all connections."""
        self._sync.close()
        await self._http.aclose()

    async def _call(self, method: str, path: str, **options: Any) -> httpx.Response:
        try:
            return _answer(await self._http.request(method, path, **options))
        except httpx.TransportError as error:
            raise _unreachable(str(self._http.base_url), error) from None

    async def submit(self, scene: str | Path, style: str | Path, **options: Any) -> Job:
        """As `Client.submit`."""
        return await asyncio.to_thread(self._sync.submit, scene, style, **options)

    async def plan(self, scene: str | Path, style: str | Path, **options: Any) -> dict[str, Any]:
        """As `Client.plan`."""
        return await asyncio.to_thread(self._sync.plan, scene, style, **options)

    async def upload(self, path: str | Path, name: str | None = None) -> str:
        """As `Client.upload`."""
        return await asyncio.to_thread(self._sync.upload, path, name)

    async def download(self, job_id: str, target: str | Path, name: str = "stylized.ply") -> Path:
        """As `Client.download`."""
        return await asyncio.to_thread(self._sync.download, job_id, target, name)

    async def job(self, job_id: str) -> Job:
        """As `Client.job`."""
        return Job.of((await self._call("GET", f"/v1/jobs/{job_id}")).json())

    async def artifacts(self, job_id: str) -> list[dict[str, Any]]:
        """As `Client.artifacts`."""
        found: list[dict[str, Any]] = (await self._call("GET", f"/v1/jobs/{job_id}/artifacts")).json()["artifacts"]
        return found

    async def watch(self, job_id: str, after: int = 0) -> AsyncIterator[Event]:
        """As `Client.watch`."""
        failures = 0
        while True:
            lines = _Lines()
            with contextlib.suppress(httpx.TransportError):
                headers = {"Last-Event-ID": str(after)} if after else {}
                timeout = httpx.Timeout(30.0, read=60.0)
                async with self._http.stream(
                    "GET", f"/v1/jobs/{job_id}/events", headers=headers, timeout=timeout
                ) as stream:
                    if stream.status_code != 200:
                        await stream.aread()
                        _answer(stream)
                        return
                    async for line in stream.aiter_lines():
                        event = lines.take(line)
                        if event is not None:
                            after, failures = event.id, 0
                            yield event
                if (await self.job(job_id)).finished:
                    return
            failures += 1
            if failures >= TRIES:
                raise _unreachable(str(self._http.base_url), ConnectionError("the stream breaks again and again"))
            await asyncio.sleep(2.0 ** (failures - 1))

    async def wait(self, job_id: str) -> Job:
        """As `Client.wait`."""
        async for _ in self.watch(job_id):
            pass
        return await self.job(job_id)

    async def cancel(self, job_id: str) -> Job:
        """As `Client.cancel`."""
        return Job.of((await self._call("POST", f"/v1/jobs/{job_id}/cancel")).json())

    async def retry(self, job_id: str) -> Job:
        """As `Client.retry`."""
        return Job.of((await self._call("POST", f"/v1/jobs/{job_id}/retry")).json())

    async def delete(self, job_id: str) -> None:
        """As `Client.delete`."""
        await self._call("DELETE", f"/v1/jobs/{job_id}")


def _path(value: str | Path | None) -> Path | None:
    return None if value is None else Path(value)


def _texts(parameters: Mapping[str, Any], webhook: str | None) -> list[tuple[str, str]]:
    told = {name: value for name, value in parameters.items() if value is not None}
    texts = [("parameters", json.dumps(told))]
    return [*texts, ("webhook", webhook)] if webhook else texts


def _sha256(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
