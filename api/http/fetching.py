"""Inputs by URL: files of allowed hosts, which are fetched into the content store while a request waits.

The servers are not trusted, and neither are the URLs. Every hop of a redirect must be allowed like the first one, and
is connected to by an address that was checked (`service.outgoing`).
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import AsyncExitStack, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import PurePosixPath

import httpx2

from api.http.multipart import check_size
from api.http.receipts import Receipt
from api.http.request_memory import memory
from service import problems
from service.deadlines import FileThreads, OwnerLimit
from service.files.blobs import Blobs, Receiver
from service.inputs import staged_name
from service.outgoing import origin, parse_origins, parse_url, send
from service.problems import ServiceError
from service.settings import ServiceSettings

_REDIRECTS = (301, 302, 303, 307, 308)
_MAX_REDIRECTS = 5
#: Maximum number of requests of one owner that fetch inputs at the same time.
_REQUESTS_PER_OWNER = 4
#: Maximum length of a reason, which may contain text from a server.
_MAX_REASON = 200
_INVALID_REDIRECT = "the server redirects to an invalid URL"
_HEADERS = {"accept": "*/*", "accept-encoding": "identity", "user-agent": "sgsst"}

_log = logging.getLogger(__name__)


def is_url(text: str) -> bool:
    """Return whether a text field of a request is meant as the URL of an input."""
    return text[:8].lower().startswith(("http://", "https://"))


def file_name(url: str) -> str:
    """Return the file name of an input by URL, which must be valid: the last component of its path."""
    return PurePosixPath(httpx2.URL(url).path).name


@dataclass
class _Fetch:
    """State of fetching the inputs of one request.

    Attributes:
        deadline: Time of the event loop at which the request gives up.
        left: Bytes that may still be fetched.
    """

    receipt: Receipt
    deadline: float
    left: int


@dataclass(frozen=True)
class _Input:
    """Input by URL: the URL as the client wrote it, and the role of the file."""

    url: str
    role: str


class Fetcher:
    """Fetcher of inputs by URL; `threads` write the files."""

    def __init__(self, settings: ServiceSettings, blobs: Blobs, threads: FileThreads) -> None:
        self._settings, self._blobs, self.threads = settings, blobs, threads
        self._allowed = parse_origins(settings.url_hosts)
        self._limit = OwnerLimit(_REQUESTS_PER_OWNER)

    def urls(self, references: Iterable[tuple[int, str, str]]) -> dict[str, str]:
        """Return the URLs among the references of a request, with their roles, after checking that they are allowed.

        Args:
            references: Index, role and text of each reference, as in `Received.uploads`.

        Raises:
            URLS_OFF: If the service fetches no inputs.
            INVALID_URL: If a URL may not be fetched.
        """
        urls = {text: role for _, role, text in references if is_url(text)}
        for url, role in urls.items():
            self._parse(url, _Input(url, role))
        return urls

    async def fetch(self, urls: dict[str, str], receipt: Receipt) -> dict[str, str]:
        """Fetch files into the content store, and return their SHA-256 by URL. The receipt holds them.

        Raises:
            BUSY: If the owner has several such requests.
            INVALID_URL: If a server redirects to a URL that may not be fetched.
            URL_NOT_FETCHED: If a server does not deliver its file in time.
            TOO_LARGE: If the files are too large.
            QUOTA_EXCEEDED: If the owner's quota of bytes would be exceeded.
            INVALID_INPUT: If a file is empty.
        """
        limit = self._limit.of(receipt.owner)
        if limit.locked():
            raise problems.BUSY("Too many inputs by URL are being fetched. Try again later.")
        async with limit:
            deadline = asyncio.get_running_loop().time() + self._settings.url_seconds
            state = _Fetch(receipt, deadline, self._settings.url_bytes)
            await asyncio.to_thread(receipt.charge, 0)
            return {url: await self._fetch(_Input(url, role), state) for url, role in urls.items()}

    def _parse(self, url: str, source: _Input) -> httpx2.URL:
        """Parse the URL of an input, or of a redirect from it, and check that its host is allowed."""
        if not self._allowed:
            raise problems.URLS_OFF(input=source.role)
        try:
            parsed = parse_url(url)
        except ValueError as error:
            raise _invalid(source, error) from error
        if origin(parsed) not in self._allowed:
            scheme, host, port = origin(parsed)
            raise _invalid(source, f"'{scheme}://{host}:{port}' is not among the hosts that its operator allows")
        return parsed

    async def _fetch(self, source: _Input, state: _Fetch) -> str:
        """Fetch one file, and return its SHA-256."""
        async with AsyncExitStack() as stack:
            chunks = await self._open(source, state, stack)
            run = partial(self.threads.run, state.receipt.owner)
            file = await run(self._blobs.receive, self._settings.max_upload_bytes)
            try:
                while chunk := await self._next(source, state, chunks):
                    state.left -= len(chunk)
                    self._check_size(0, state)
                    await run(_write, chunk, file, state.receipt)
                sha256 = await run(self._keep, source, file, state.receipt, size=file.size)
            except BaseException:
                await self.threads.clean_up(run(file.discard))
                raise
            _log.info("input fetched: host=%s bytes=%d", parse_url(source.url).host, file.size)
            return sha256

    async def _open(self, source: _Input, state: _Fetch, stack: AsyncExitStack) -> AsyncIterator[bytes]:
        """Follow redirects to the file, and return its chunks. The stack closes the connection."""
        url = self._parse(source.url, source)
        for _ in range(1 + _MAX_REDIRECTS):
            answer = send("GET", url, _HEADERS, private_allowed=self._settings.url_private_addresses)
            with self._failures(source):
                async with asyncio.timeout_at(state.deadline):
                    response = await stack.enter_async_context(answer)
            location = response.headers.get("location")
            if response.status_code not in _REDIRECTS or location is None:
                return await self._body(source, state, response)
            await stack.aclose()
            try:
                target = str(url.join(location))
            except (httpx2.InvalidURL, ValueError) as error:
                raise _not_fetched(source, _INVALID_REDIRECT) from error
            url = self._parse(target, source)
        raise _not_fetched(source, f"the server redirects more than {_MAX_REDIRECTS} times")

    async def _body(self, source: _Input, state: _Fetch, response: httpx2.Response) -> AsyncIterator[bytes]:
        """Check the head of a response, and return the chunks of its body."""
        if response.status_code != httpx2.codes.OK:
            raise _not_fetched(source, f"the server answered {response.status_code}")
        if response.headers.get("content-encoding", "identity").strip().lower() != "identity":
            raise _not_fetched(source, "the server compresses the file")
        declared = int(response.headers.get("content-length", "0"))  # only digits: h11 refuses anything else
        self._check_size(declared, state)
        await asyncio.to_thread(state.receipt.charge, declared)
        return response.aiter_raw(memory.share())

    async def _next(self, source: _Input, state: _Fetch, chunks: AsyncIterator[bytes]) -> bytes:
        """Return the next chunk of a file; b"" at its end."""
        with self._failures(source):
            async with asyncio.timeout_at(state.deadline):
                return await anext(chunks, b"")

    def _check_size(self, more: int, state: _Fetch) -> None:
        if more > state.left:
            limit = self._settings.url_bytes
            raise problems.TOO_LARGE(
                f"The inputs by URL have more than {limit:,} bytes. Upload large files.", limit=limit
            )

    def _keep(self, source: _Input, file: Receiver, receipt: Receipt) -> str:
        """Turn a complete file into a blob that the receipt holds, and return its SHA-256."""
        file.close()
        check_size(source.role, staged_name(source.role, file_name(source.url)), file.size)
        return self._blobs.add(file.path, receipt.id)

    @contextmanager
    def _failures(self, source: _Input) -> Iterator[None]:
        """Raise URL_NOT_FETCHED or INVALID_URL in place of failures of the network."""
        try:
            yield
        except TimeoutError as error:
            raise _not_fetched(source, f"it did not arrive within {self._settings.url_seconds:g} s") from error
        except PermissionError as error:  # its message has the address, which is none of the client's business
            raise _invalid(source, "its host has an address that is not public") from error
        except httpx2.InvalidURL as error:  # httpx2 parses the target of a redirect even if it does not follow it
            raise _not_fetched(source, _INVALID_REDIRECT) from error
        except (httpx2.HTTPError, OSError) as error:
            reason = (str(error) or type(error).__name__)[:_MAX_REASON].rstrip(".")
            raise _not_fetched(source, reason) from error


def _invalid(source: _Input, reason: object) -> ServiceError:
    return problems.INVALID_URL(url=source.url[:100], reason=reason, input=source.role)


def _not_fetched(source: _Input, reason: str) -> ServiceError:
    return problems.URL_NOT_FETCHED(url=source.url[:100], reason=reason, input=source.role)


def _write(chunk: bytes, file: Receiver, receipt: Receipt) -> None:
    receipt.take(len(chunk))
    file.write(chunk)
