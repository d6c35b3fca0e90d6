"""Requests of the clients: retries after temporary failures, errors, streams of events, and downloads."""

import json
import os
import re
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import anyio.to_thread
import httpx2
import stamina

from service.states import ENDED
from sgsst_core.errors import InvalidInputError, SgsstError
from sgsst_core.files.atomic import disk_errors, file_digest, replace, temporary_path

DEFAULT_URL = "http://127.0.0.1:8000"
#: Maximum number of attempts of a request, with waits of 1, 2, 4 ... seconds between them.
TRIES = 6

#: Variables of the environment that name proxies and hosts to reach without them, and files for encrypted connections.
_PROXIES, _FILES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY", "NO_PROXY"), ("SSL_CERT_FILE", "SSLKEYLOGFILE")

#: Callback that receives the number of completed and of all bytes, or steps.
Progress = Callable[[int, int], None]

#: Bytes per read or write operation on the disk.
BLOCK = 1 << 20
#: SHA-256 in an ETag. A proxy may have made the tag weak, or appended to it.
_SHA256 = re.compile(r"[0-9a-f]{64}")

T = TypeVar("T")


class Transport:
    """Connections to a service.

    Args:
        url: Address of the service; None for the environment variable SGSST_URL, or else port 8000 of this machine.
        key: API key; None for the environment variable SGSST_KEY.

    Raises:
        RequestError: If the address is neither an http nor an https URL, or the key cannot be one, or a proxy or
            certificate file that the environment names cannot be used.

    Attributes:
        http: HTTP client for requests without retries.
        reached: Whether the service has responded. If it has, a refused connection may mean that it restarts.
    """

    def __init__(self, url: str | None, key: str | None) -> None:
        key = (key or os.environ.get("SGSST_KEY") or "").strip()
        url = url or os.environ.get("SGSST_URL") or DEFAULT_URL
        if not _is_address(url):
            raise RequestError(f"{url}: not an address of a service. Give one such as {DEFAULT_URL}.")
        if not (key.isascii() and key.isprintable()):
            raise RequestError("The API key contains invalid characters. Copy it again.")
        self.http = _http_client(url, {"Authorization": f"Bearer {key}"} if key else {})
        self.url = str(self.http.base_url).rstrip("/")
        self.reached = False
        self._retrying = stamina.AsyncRetryingCaller(
            attempts=TRIES,
            timeout=None,
            wait_initial=1.0,
            wait_max=2.0 ** (TRIES - 2),
            wait_jitter=0.0,
            wait_exp_base=2,
        )

    async def call(self, method: str, path: str, **options: Any) -> httpx2.Response:
        """Send a request, and return its complete response.

        Raises:
            RequestError: If the service refuses the request as faulty, or a number of its JSON is not finite.
            ApiError: If the service fails or does not respond, even after retries.
        """
        json_text(options.get("json"))

        async def once() -> httpx2.Response:
            response = await self.http.request(method, path, **options)
            self.reached = True
            return checked(response)

        return await self._retry(once)

    async def json(self, method: str, path: str, **options: Any) -> Any:
        """Send a request, and return the JSON of its response.

        Raises:
            RequestError, ApiError: As for `call`, or if the response is not JSON.
        """
        return parsed(await self.call(method, path, **options))

    async def work(self, path: str, step: str, progress: Progress, **options: Any) -> dict[str, Any]:
        """Request some work, and return its result.

        Args:
            step: Name of the events that report progress.
            progress: Callback that receives the number of completed steps and of all steps.

        Raises:
            RequestError, ApiError: As for `call`.
        """
        json_text(options.get("json"))

        async def once() -> dict[str, Any]:
            async with self.http.sse(path, method="POST", **options) as source:
                self.reached = True
                if not has_events(source.response):
                    await source.response.aread()
                    return dict(parsed(checked(source.response)))
                async for event in source:
                    data: dict[str, Any] = json.loads(event.data or "{}")
                    if event.event == "problem":
                        raise refusal(data["detail"], data["status"], data)
                    if data and event.event != step:  # messages without data only keep the connection alive
                        return data
                    if data.get("total"):  # stages of unknown length have no steps
                        progress(data["step"], data["total"])
            raise ApiError("The connection ended before the result arrived. Try again.", 502)  # a proxy cut it off

        return await self._retry(once)

    async def fetch(self, path: str, target: Path, progress: Progress) -> None:
        """Download a file, and check its SHA-256. A broken download is resumed, also that of an earlier process.

        The name of the partial file has the SHA-256 of the complete one.

        Raises:
            RequestError, ApiError: As for `call`, or if the response does not state the SHA-256, or has another one.
            OutputError: If the disk is full, or another program holds the target open.
        """

        async def once() -> None:
            digest, done = await in_thread(_partial_file, target)
            headers = {"Accept-Encoding": "identity"}  # keeps proxies from compressing
            if digest:
                headers |= {"Range": f"bytes={done}-", "If-Range": f'"{digest}"'}
            async with self.http.stream("GET", path, headers=headers) as response:
                self.reached = True
                if response.status_code != httpx2.codes.RANGE_NOT_SATISFIABLE:  # else all bytes were received before
                    if response.is_error:
                        await response.aread()
                        checked(response)
                    if response.status_code != httpx2.codes.PARTIAL_CONTENT:
                        digest, done = await in_thread(_start_file, target, digest, response), 0
                    size = done + int(response.headers.get("content-length", 0))
                    async for block in response.aiter_bytes(BLOCK):
                        await in_thread(_append, target, digest, block)
                        done += len(block)
                        progress(done, size)
            await in_thread(_finish_file, path, target, digest)

        await self._retry(once)

    def may_pass(self, error: Exception) -> bool:
        """Return whether the same request may succeed later: there was no response, or it reports a temporary failure.

        If the very first connection is refused, there is no service that could be restarting.
        """
        if isinstance(error, httpx2.ConnectError):
            return self.reached
        return isinstance(error, httpx2.RequestError) or getattr(error, "status", 0) in _TEMPORARY

    def unreachable(self, error: Exception) -> "ApiError":
        """Return the error for a service that did not respond."""
        names = _given(_PROXIES[:-1])
        advice = f"; {names} decides on a proxy" if names else ""
        return ApiError(
            f"{self.url} cannot be reached: {error}. Is `sgsst serve` running? --url names another address{advice}."
        )

    async def _retry(self, once: Callable[[], Awaitable[T]]) -> T:
        try:
            return await self._retrying(self.may_pass, once)
        except (httpx2.RequestError, ExceptionGroup) as error:  # the latter for a proxy's port that cannot be
            raise self.unreachable(error) from None


def _partial_file(target: Path) -> tuple[str, int]:
    """Return the SHA-256 in the name of a file's partial download, and its size; an empty text if there is none."""
    for path in target.parent.glob(temporary_path(target, "*").name):
        if (stated := _SHA256.search(path.name)) and path.is_file() and not path.is_symlink():
            return stated[0], path.stat().st_size
    return "", 0


def _start_file(target: Path, old: str, response: httpx2.Response) -> str:
    """Create the partial file of a download in place of an older one, and return the SHA-256 of the whole file."""
    stated = _SHA256.search(response.headers.get("etag", ""))
    if stated is None:
        raise ApiError(
            f"{response.url}: has no SHA-256 as its ETag, so the file cannot be checked. Check the address, and which "
            "headers a proxy removes."
        )
    temporary_path(target, old).unlink(missing_ok=True)
    part = temporary_path(target, stated[0])
    with disk_errors(target):
        part.open("xb").close()
    return stated[0]


def _append(target: Path, digest: str, block: bytes) -> None:
    """Append a block to a partial file."""
    with disk_errors(target), temporary_path(target, digest).open("ab") as file:
        file.write(block)


def _finish_file(path: str, target: Path, digest: str) -> None:
    """Check a whole file, then rename it to its target; a damaged one is deleted."""
    part = temporary_path(target, digest)
    if file_digest(part) != digest:
        part.unlink()
        raise ApiError(f"{path}: the download was damaged in transit. Try again.", 460)
    replace(part, target)


def _is_address(url: str) -> bool:
    """Return whether a text is an http or https URL with a host and a port that can exist."""
    try:
        parsed = httpx2.URL(url)
        parsed.host.encode("idna")
    except (httpx2.InvalidURL, UnicodeError):
        return False
    return parsed.scheme in ("http", "https") and bool(parsed.host) and 0 <= (parsed.port or 0) < 1 << 16


def _http_client(url: str, headers: dict[str, str]) -> httpx2.AsyncClient:
    """Return an HTTP client, which takes proxies and certificate authorities from the environment.

    Raises:
        RequestError: If one of these cannot be used.
    """
    try:
        return httpx2.AsyncClient(base_url=url, headers=headers, timeout=httpx2.Timeout(30.0, read=900.0, write=120.0))
    except Exception as error:  # httpx2 raises errors of many types here, some of them built-in
        raise RequestError(
            f"{_given(_PROXIES + _FILES)} cannot be used: {str(error).rstrip('.')}. Correct or unset it."
        ) from error


def _given(variables: tuple[str, ...]) -> str:
    """Return the names of those variables that are set, as a text."""
    return " or ".join(name for name in sorted(os.environ) if name.upper() in variables and os.environ[name])


def json_text(value: object) -> str:
    """Return a value as JSON.

    Raises:
        RequestError: If it contains a number that is not finite, which JSON lacks.
    """
    try:
        return json.dumps(value, allow_nan=False)
    except ValueError as error:
        raise RequestError(f"{value}: contains a number that is not finite. Give finite numbers.") from error


async def in_thread(function: Callable[..., T], *args: Any) -> T:
    """Run blocking file access in another thread, and return its result."""
    return await anyio.to_thread.run_sync(function, *args)


#: Statuses of temporary failures: locked by another request, damaged in transit, overloaded, starting.
_TEMPORARY = (423, 460, 502, 503, 504)


class ApiError(SgsstError):
    """A request that the service refused, or a service that cannot be reached.

    Attributes:
        status: HTTP status; 0 if there was no response.
        problem: Problem document; empty if there is none.
    """

    code = "api-error"

    def __init__(self, message: str, status: int = 0, problem: Mapping[str, Any] | None = None) -> None:
        super().__init__(message)
        self.status = status
        self.problem = dict(problem or {})


class RequestError(ApiError, InvalidInputError):
    """Request that the service refused because of its files, parameters, key or id."""

    code = "api-request"


@dataclass(frozen=True)
class Job:
    """State of a job as the service last sent it; `data` is the complete JSON response."""

    id: str
    status: str
    progress: Mapping[str, Any] | None
    error: Mapping[str, Any] | None
    data: Mapping[str, Any]

    @property
    def finished(self) -> bool:
        """Whether the job has ended."""
        return self.status in ENDED

    @staticmethod
    def of(data: Mapping[str, Any]) -> "Job":
        """Return the job from the service's JSON."""
        return Job(data["id"], data["status"], data.get("progress"), data.get("error"), data)


@dataclass(frozen=True)
class Event:
    """Event of a job: `status`, `progress` or `artifact`."""

    id: int
    kind: str
    data: Mapping[str, Any]


def checked(response: httpx2.Response) -> httpx2.Response:
    """Return the response if it is not an error. Its body must have been read.

    Raises:
        RequestError: If the service refused the request as faulty.
        ApiError: If the service failed, or another program answered.
    """
    if response.is_success and (not response.content or "json" in response.headers.get("content-type", "")):
        return response
    try:
        problem = response.json()
        message = str(problem["detail"])
    except (ValueError, KeyError, TypeError):
        problem, message = {}, _strangeness(response)
    raise refusal(message, response.status_code, problem)


def has_events(response: httpx2.Response) -> bool:
    """Return whether a response is a stream of events."""
    return bool(response.headers.get("content-type", "").startswith("text/event-stream"))


def parsed(response: httpx2.Response) -> Any:
    """Return the JSON of a response.

    Raises:
        ApiError: If the response is not JSON, so that another program has sent it.
    """
    try:
        return response.json()
    except ValueError as error:
        raise ApiError(_strangeness(response), response.status_code) from error


def _strangeness(response: httpx2.Response) -> str:
    """Return what distinguishes a response from those of the service; one without content may be the service's."""
    location, kind = response.headers.get("location"), response.headers.get("content-type", "no JSON")
    what = f" and redirects to {location}" if response.has_redirect_location else f" and sends {kind}"
    unlike = "" if response.is_error and not response.content else f"{what}, unlike the service"
    advice = "Try again later, or check" if response.status_code in _TEMPORARY else "Check"
    return f"{response.request.url} answers {response.status_code}{unlike}. {advice} the address."


def refusal(message: str, status: int, problem: Mapping[str, Any]) -> ApiError:
    """Return the error for a refused request: RequestError if the request is at fault, ApiError if the service is."""
    return (RequestError if 400 <= status < 500 else ApiError)(message, status, problem)
