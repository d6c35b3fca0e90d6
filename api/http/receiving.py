"""Files of requests, which are written to disk as they arrive, in constant memory: multipart bodies and inputs by URL.

Their bytes are charged to the quota of their owner by receipts, from the first byte until a job takes over the files,
or until the files are deleted.

The servers of inputs by URL are not trusted, and neither are the URLs. Every hop of a redirect must be allowed like the
first one, and is connected to by an address that was checked (`service.outgoing`).
"""

import asyncio
import gc
import json
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import PurePosixPath
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx2
from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, MultipartState, parse_options_header
from starlette.requests import ClientDisconnect

from api.http.context import memory
from api.http.problems import raises
from api.http.schemas import Model
from service import problems
from service.deadlines import FileThreads, OwnerLimit
from service.files.blobs import Blobs, Receiver
from service.inputs import MAX_CAMERA_FILES, MOST_STYLES, ROLES, staged_name
from service.outgoing import origin, parse_origins, parse_url, send
from service.problems import DatabaseUnavailableError, ServiceError, StoreError
from service.settings import ServiceSettings
from service.store.files import GRACE_SECONDS, InputRows
from service.store.keys import Quotas
from worker.options import MOST_REGIONS

#: Seconds between two renewals. If a process dies, its receipts and partial files expire.
_RENEWAL_SECONDS = GRACE_SECONDS / 6

_log = logging.getLogger(__name__)


class Receipts:
    """Receipts of this process. A background task renews each one until its request has ended."""

    def __init__(self, inputs: InputRows, blobs: Blobs, threads: FileThreads) -> None:
        self.inputs, self._blobs, self._threads = inputs, blobs, threads
        self.active: set[str] = set()
        self._renewing = asyncio.create_task(self._renew())

    def close(self) -> None:
        """Stop the renewal task."""
        self._renewing.cancel()

    async def end(self, owner: str, receipt: str) -> None:
        """Release the charge of a receipt, and delete the request's files unless other jobs or uploads use them."""
        self.active.discard(receipt)
        await self._threads.clean_up(self._end(owner, receipt))

    async def _end(self, owner: str, receipt: str) -> None:
        unused = await asyncio.to_thread(self.inputs.end_receipt, receipt)
        if unused:
            await self.remove(owner, partial(self._blobs.remove, unused))

    async def remove(self, owner: str, *removals: Callable[[], None]) -> None:
        """Remove files that no database row refers to any longer; housekeeping removes those that remain."""
        try:
            for remove in removals:
                await self._threads.clean_up(self._threads.run(owner, remove))
        except (StoreError, OSError) as error:
            _log.warning("unused files not deleted yet: %s", error.__cause__ or error)

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(_RENEWAL_SECONDS)
            if self.active:
                try:
                    await asyncio.to_thread(self.inputs.renew_receipts, list(self.active))
                except DatabaseUnavailableError:  # receipts survive several missed renewals
                    _log.warning("cannot renew receipts; retrying")


class Receipt:
    """Quota charge of one request, nothing at first, which also protects the request's files from deletion.

    At the end of the `async with` block, files that no job has taken over are deleted, unless other jobs or uploads use
    them.

    Attributes:
        id: Id in the database; None until something is charged.
        received: Number of received bytes.
    """

    def __init__(self, receipts: Receipts, owner: str, quotas: Quotas) -> None:
        self.id: str | None = None
        self._receipts, self.owner, self._quotas = receipts, owner, quotas
        self._charged = self.received = 0

    def charge(self, declared: int) -> None:
        """Charge bytes that the request, or a server it names, declares; 0 if it declares none.

        Raises:
            QUOTA_EXCEEDED: If the owner would exceed the quota.
        """
        if self.id is None:
            self.id = self._receipts.inputs.open_receipt(self.owner, declared, self._quotas)
            self._receipts.active.add(self.id)
        elif declared:
            self._receipts.inputs.grow_receipt(self.id, declared, self.owner, self._quotas)
        self._charged += declared

    def take(self, size: int) -> None:
        """Count received bytes, and charge those that were not declared.

        Raises:
            QUOTA_EXCEEDED: If the owner would exceed the quota.
        """
        self.received += size
        more = self.received - self._charged
        if more > 0 and self.id is not None:
            self._receipts.inputs.grow_receipt(self.id, more, self.owner, self._quotas)
            self._charged = self.received

    def hand_over(self) -> None:
        """Record that a job has taken over the files and their charge."""
        if self.id is not None:
            self._receipts.active.discard(self.id)
            self.id = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        receipt, self.id = self.id, None
        if receipt is not None:
            await self._receipts.end(self.owner, receipt)


#: Maximum bytes of a text field: JSON parameters or an id.
MAX_TEXT = 1 << 16
#: Maximum bytes of a small JSON body.
_MAX_SMALL = 4096
_TEXT_FIELDS = ("parameters", "webhook", "webhook_events")
#: Maximum number of headers of a part, and bytes of each. They hold the file's role and name.
_MAX_HEADERS, _MAX_HEADER = 8, 4224
#: Minimum rate of a body in bytes per second, averaged from its start, after the first `receive_seconds`.
_LEAST_RATE = 1000
#: Limits in bytes and seconds for reading and discarding the rest of a refused body. Otherwise, a client that is still
#: sending would not see the response.
_DRAIN_BYTES, _DRAIN_SECONDS = 64 << 20, 10.0


Value = TypeVar("Value")


@dataclass
class Received:
    """Contents of a request.

    Attributes:
        files: `role`, `name`, `sha256`, `size` of each file.
        uploads: Index and role of each file that is not in the request, with the id of its upload, the path of an
            input, or a URL. The index counts all files together.
    """

    files: list[dict[str, Any]] = field(default_factory=list)
    uploads: list[tuple[int, str, str]] = field(default_factory=list)
    texts: dict[str, str] = field(default_factory=dict)


async def body_parts(request: Request, settings: ServiceSettings, limit: int, advice: str) -> AsyncIterator[bytes]:
    """Yield a body in chunks as they arrive.

    Args:
        limit: Maximum number of bytes.
        advice: End of the error message for a body that is too long.

    Raises:
        UNSUPPORTED_TYPE: If the body is compressed.
        TOO_LARGE: If the body is too long. A declared length is checked before the body is read.
        TOO_SLOW: If the body stalls or arrives too slowly.
        MALFORMED_BODY: If the body is cut off.
    """
    declared_bytes(request, limit, advice)
    total = 0
    stream = aiter(request.stream())
    started = time.monotonic()
    while True:
        # A client that sends a byte now and then never stalls, but would hold the connection forever.
        allowed = settings.receive_seconds + total / _LEAST_RATE - (time.monotonic() - started)
        try:
            part = await asyncio.wait_for(anext(stream), max(0.0, min(allowed, settings.receive_seconds)))
        except StopAsyncIteration:
            return
        except TimeoutError as error:
            raise problems.TOO_SLOW(seconds=settings.receive_seconds, rate=_LEAST_RATE) from error
        except ClientDisconnect as error:
            raise problems.MALFORMED_BODY() from error
        total += len(part)
        if total > limit:
            raise problems.TOO_LARGE(f"The request has more than {limit:,} bytes. {advice}", limit=limit)
        yield part


async def body_blocks(request: Request, settings: ServiceSettings) -> AsyncIterator[bytes]:
    """Yield a body in large blocks, because writing each block costs two thread switches.

    Raises:
        ServiceError: Same errors as `body_parts`.
    """
    block = bytearray()
    try:
        async for part in body_parts(request, settings, settings.max_request_bytes, "Use uploads."):
            block += part
            if len(block) >= memory.share():
                full = bytes(block)
                block.clear()
                yield full
    except ServiceError as error:
        if block and error.problem in (problems.TOO_SLOW, problems.MALFORMED_BODY):
            yield bytes(block)  # resumable uploads keep the bytes that have arrived
        raise
    if block:
        yield bytes(block)


def check_media_type(request: Request, supported: str) -> None:
    """Raise UNSUPPORTED_TYPE if the body has another media type; parameters such as `charset` are ignored."""
    if media_type(request) != supported:
        raise problems.UNSUPPORTED_TYPE(supported=supported)


def media_type(request: Request) -> str:
    """Return the media type of the body, without parameters."""
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def declared_bytes(request: Request, limit: int, advice: str = "Use uploads.") -> int:
    """Return the length of a body from its headers, or 0 if they do not declare it.

    Raises:
        UNSUPPORTED_TYPE: If the body is compressed.
        TOO_LARGE: If the body is too long.
    """
    if request.headers.get("content-encoding", "identity").strip().lower() != "identity":
        raise problems.UNSUPPORTED_TYPE("Encoded bodies are not accepted. Send the body without Content-Encoding.")
    total = int(request.headers.get("content-length", "0"))  # only digits: the HTTP parser refuses anything else
    if total > limit:
        raise problems.TOO_LARGE(
            f"The request has {total:,} bytes. At most {limit:,} are allowed. {advice}", limit=limit
        )
    return total


async def receive(
    request: Request, blobs: Blobs, settings: ServiceSettings, receipt: Receipt, threads: FileThreads
) -> Received:
    """Read a multipart request to its end, and store its files as blobs, which the receipt protects from deletion.

    Raises:
        QUOTA_EXCEEDED: If the owner's quota of bytes would be exceeded. A declared length is checked before the body is
            read.
        ServiceError: If the request is invalid. The files that have arrived are deleted at the end of the receipt.
    """
    kind, options = parse_options_header(request.headers.get("content-type", ""))
    boundary = options.get(b"boundary")
    if kind != b"multipart/form-data":
        raise problems.UNSUPPORTED_TYPE(supported="multipart/form-data or application/json")
    if not boundary:
        raise problems.MALFORMED_BODY("The Content-Type multipart/form-data must name a boundary.")
    await asyncio.to_thread(receipt.charge, declared_bytes(request, settings.max_request_bytes))
    form = _Form(boundary, blobs, settings, receipt)
    blocks = body_blocks(request, settings)
    try:
        async for block in blocks:
            await threads.run(receipt.owner, form.feed, block, size=form.unsaved)
        form.check_complete()
    except BaseException as error:
        await threads.clean_up(threads.run(receipt.owner, form.discard))
        if isinstance(error, ServiceError) and error.problem not in (problems.TOO_SLOW, problems.TOO_LARGE):
            await _drain(blocks)
        raise
    return form.received


async def _drain(blocks: AsyncIterator[bytes]) -> None:
    left = _DRAIN_BYTES
    with suppress(TimeoutError, ServiceError):
        async with asyncio.timeout(_DRAIN_SECONDS):
            async for block in blocks:
                left -= len(block)
                if left < 0:
                    return


class _Form:
    """Callbacks of the multipart parser, which write the bytes of the current part to a file or a text field."""

    def __init__(self, boundary: bytes, blobs: Blobs, settings: ServiceSettings, receipt: Receipt) -> None:
        self.received = Received()
        self._blobs, self._settings, self._receipt = blobs, settings, receipt
        self._most_files = most_files(settings)
        self._header: tuple[bytearray, bytearray] = (bytearray(), bytearray())
        self._parts = 0
        self._headers: dict[bytes, bytes] = {}
        self._role = self._name = ""
        self._file: Receiver | None = None
        self._text = bytearray()
        callbacks: dict[str, Callable[..., None]] = {
            "on_part_begin": self._begin,
            "on_header_field": lambda data, start, end: self._header[0].extend(data[start:end]),
            "on_header_value": lambda data, start, end: self._header[1].extend(data[start:end]),
            "on_header_end": self._header_end,
            "on_headers_finished": self._open,
            "on_part_data": self._data,
            "on_part_end": self._end,
        }
        try:
            self._parser = MultipartParser(
                boundary,
                callbacks,  # type: ignore[arg-type]
                max_header_count=_MAX_HEADERS,
                max_header_size=_MAX_HEADER,
            )
        except FormParserError as error:
            raise problems.MALFORMED_BODY(f"The multipart boundary is invalid: {error}.") from error

    def feed(self, block: bytes) -> None:
        """Charge a block of the body to the receipt, then parse it."""
        self._receipt.take(len(block))
        try:
            self._parser.write(block)
        except FormParserError as error:
            raise problems.MALFORMED_BODY(f"The multipart body is invalid: {error}.") from error

    def check_complete(self) -> None:
        """Raise MALFORMED_BODY if the last boundary of the body is missing."""
        if self._parser.state is not MultipartState.END:
            raise problems.MALFORMED_BODY("The multipart body ends before its last boundary. Send it again.")

    @property
    def unsaved(self) -> int:
        """Bytes of the current file, which become a blob at its end."""
        return 0 if self._file is None else self._file.size

    def discard(self) -> None:
        """Delete the received bytes of a file that is not complete."""
        if self._file is not None:
            self._file.discard()
            self._file = None

    def _begin(self) -> None:
        self._parts += 1
        if self._parts > self._most_files + len(_TEXT_FIELDS):
            raise problems.TOO_MANY_FILES(limit=self._parts - 1, what="fields")
        self._headers, self._header = {}, (bytearray(), bytearray())

    def _header_end(self) -> None:
        self._headers[bytes(self._header[0]).lower()] = bytes(self._header[1])
        self._header = bytearray(), bytearray()

    def _open(self) -> None:
        _, options = parse_options_header(self._headers.get(b"content-disposition", b""))
        self._role = options.get(b"name", b"").decode("utf-8", "replace")
        filename = options.get(b"filename")
        self._text.clear()
        if self._role not in (*ROLES, *_TEXT_FIELDS):
            known = ", ".join((*ROLES, *_TEXT_FIELDS))
            raise problems.INVALID_REQUEST(f"Unknown field {self._role[:60]!r}. Use {known}.")
        if filename is None or self._role in _TEXT_FIELDS:
            return
        count = len(self.received.files)
        if count >= self._most_files:
            raise problems.TOO_MANY_FILES(limit=count, what="files")
        self._name = staged_name(self._role, filename.decode("utf-8", "surrogateescape"), count)
        self._file = self._blobs.receive(self._settings.max_upload_bytes)

    def _data(self, data: bytes, start: int, end: int) -> None:
        if self._file is not None:
            self._file.write(data[start:end])
            return
        self._text += data[start:end]
        if len(self._text) > MAX_TEXT:
            raise problems.INVALID_REQUEST(f"The field {self._role!r} has more than {MAX_TEXT} bytes.")

    def _end(self) -> None:
        if self._file is not None:
            sha256 = _keep(self._file, self._role, self._name, self._blobs, self._receipt)
            entry = {"role": self._role, "name": self._name, "sha256": sha256, "size": self._file.size}
            self.received.files.append(entry)
            self._file = None
            return
        text = self._text.decode("utf-8", "replace")
        if self._role not in _TEXT_FIELDS:
            index = len(self.received.files) + len(self.received.uploads)
            self.received.uploads.append((index, self._role, text.strip()))
        elif self._role in self.received.texts:
            raise problems.INVALID_REQUEST(f"The field {self._role!r} was sent twice. Send it once.")
        else:
            self.received.texts[self._role] = text


def _keep(file: Receiver, role: str, name: str, blobs: Blobs, receipt: Receipt) -> str:
    """Turn a complete file into a blob that the receipt holds, and return its SHA-256.

    The confined inspection process reads the file and checks the rest.

    Raises:
        INVALID_INPUT: If the file is empty.
    """
    file.close()
    if not file.size:
        code = f"invalid-{'image' if role in ('style', 'photos', 'painted') else role}"
        raise problems.INVALID_INPUT(f"{name}: is empty. Send the file's content.", code=code, input=role)
    return blobs.add(file.path, receipt.id)


def most_files(settings: ServiceSettings) -> int:
    """Return the maximum number of files of a job."""
    return settings.max_photos + MAX_CAMERA_FILES + MOST_STYLES + MOST_REGIONS + 1


async def read_json(request: Request, settings: ServiceSettings, most: int) -> Any:
    """Read and parse a JSON body.

    Args:
        most: Maximum number of bytes.

    Raises:
        MALFORMED_BODY: If the body is not UTF-8.
        INVALID_REQUEST: If the body is not JSON.
        BUSY: If many large bodies are arriving.
        ServiceError: Same errors as `body_parts`.
    """
    body = bytearray()
    try:
        async for part in body_parts(request, settings, most, "JSON bodies hold no files."):
            memory.take(len(part), len(body))
            body += part
        return parse_json(body.decode(), "body")
    except UnicodeDecodeError as error:
        raise problems.MALFORMED_BODY("The body is not UTF-8.") from error
    finally:
        memory.give_back(len(body))


def json_body(model: type[Model]) -> Callable[[Request], Awaitable[Model]]:
    """Return a dependency that reads the small JSON body of a request."""

    @raises(problems.MALFORMED_BODY, problems.TOO_SLOW, problems.TOO_LARGE, problems.UNSUPPORTED_TYPE, body=model)
    async def read(request: Request) -> Model:
        check_media_type(request, "application/json")
        return model.model_validate(await read_json(request, request.app.state.context.settings, _MAX_SMALL))

    return read


def parse_json(text: str, what: str) -> Any:
    """Parse the JSON of a field or body.

    Raises:
        INVALID_REQUEST: If the text is not JSON.
    """
    gc.disable()  # Garbage collections would slow the parsing of a megabyte of lists from 0.04 s to 0.2 s.
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise problems.INVALID_REQUEST(f"{what}: is not JSON: {error}.", input=what) from error
    finally:
        gc.enable()


_MAX_REDIRECTS = 5
#: Maximum number of requests of one owner that fetch inputs at the same time.
_REQUESTS_PER_OWNER = 4
#: Maximum length of a reason, which may contain text from a server.
_MAX_REASON = 200
_INVALID_REDIRECT = "the server redirects to an invalid URL"
_HEADERS = {"accept": "*/*", "accept-encoding": "identity", "user-agent": "sgsst"}


def is_url(text: str) -> bool:
    """Return whether a text field of a request is meant as the URL of an input."""
    return text[:8].lower().startswith(("http://", "https://"))


def file_name(url: str) -> str:
    """Return the file name of an input by URL, which must be valid: the last component of its path."""
    return PurePosixPath(httpx2.URL(url).path).name


@dataclass(frozen=True)
class _Fetch:
    """Input by URL that is being fetched.

    Attributes:
        url: URL as the client wrote it.
        deadline: Time of the event loop at which the request gives up.
        most: Limit of the receipt's received bytes.
    """

    url: str
    role: str
    receipt: Receipt
    deadline: float
    most: int


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
            self._parse(url, url, role)
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
            most = receipt.received + self._settings.url_bytes
            await asyncio.to_thread(receipt.charge, 0)
            return {url: await self._fetch(_Fetch(url, role, receipt, deadline, most)) for url, role in urls.items()}

    def _parse(self, url: str, given: str, role: str) -> httpx2.URL:
        """Parse the given URL of an input, or of a redirect from it, and check that its host is allowed."""
        if not self._allowed:
            raise problems.URLS_OFF(input=role)
        try:
            parsed = parse_url(url)
        except ValueError as error:
            raise _invalid(given, role, error) from error
        if origin(parsed) not in self._allowed:
            scheme, host, port = origin(parsed)
            raise _invalid(given, role, f"'{scheme}://{host}:{port}' is not among the hosts that its operator allows")
        return parsed

    async def _fetch(self, source: _Fetch) -> str:
        """Fetch one file, and return its SHA-256."""
        async with AsyncExitStack() as stack:
            response = await self._open(source, stack)
            declared = int(response.headers.get("content-length", "0"))  # only digits: h11 refuses anything else
            self._check_size(declared, source)
            await asyncio.to_thread(source.receipt.charge, declared)
            chunks = response.aiter_raw(memory.share())
            run = partial(self.threads.run, source.receipt.owner)
            file = await run(self._blobs.receive, self._settings.max_upload_bytes)
            try:
                while chunk := await self._in_time(source, anext(chunks, b"")):
                    self._check_size(len(chunk), source)
                    await run(_write, chunk, file, source.receipt)
                name = staged_name(source.role, file_name(source.url))
                sha256 = await run(_keep, file, source.role, name, self._blobs, source.receipt, size=file.size)
            except BaseException:
                await self.threads.clean_up(run(file.discard))
                raise
            _log.info("input fetched: host=%s bytes=%d", parse_url(source.url).host, file.size)
            return sha256

    async def _open(self, source: _Fetch, stack: AsyncExitStack) -> httpx2.Response:
        """Follow redirects to the file, and return the response with it. The stack closes the connection."""
        url = self._parse(source.url, source.url, source.role)
        for _ in range(1 + _MAX_REDIRECTS):
            answer = send("GET", url, _HEADERS, private_allowed=self._settings.url_private_addresses)
            response = await self._in_time(source, stack.enter_async_context(answer))
            if not response.has_redirect_location:
                if response.status_code != httpx2.codes.OK:
                    raise _not_fetched(source, f"the server answered {response.status_code}")
                if response.headers.get("content-encoding", "identity").strip().lower() != "identity":
                    raise _not_fetched(source, "the server compresses the file")
                return response
            await stack.aclose()
            try:
                target = str(url.join(response.headers["location"]))
            except (httpx2.InvalidURL, ValueError) as error:
                raise _not_fetched(source, _INVALID_REDIRECT) from error
            url = self._parse(target, source.url, source.role)
        raise _not_fetched(source, f"the server redirects more than {_MAX_REDIRECTS} times")

    def _check_size(self, more: int, source: _Fetch) -> None:
        if source.receipt.received + more > source.most:
            limit = self._settings.url_bytes
            raise problems.TOO_LARGE(
                f"The inputs by URL have more than {limit:,} bytes. Upload large files.", limit=limit
            )

    async def _in_time(self, source: _Fetch, step: Awaitable[Value]) -> Value:
        """Wait for a step until the deadline; raise URL_NOT_FETCHED or INVALID_URL if the network fails."""
        try:
            async with asyncio.timeout_at(source.deadline):
                return await step
        except TimeoutError as error:
            raise _not_fetched(source, f"it did not arrive within {self._settings.url_seconds:g} s") from error
        except PermissionError as error:  # its message has the address, which is none of the client's business
            raise _invalid(source.url, source.role, "its host has an address that is not public") from error
        except httpx2.InvalidURL as error:  # httpx2 parses the target of a redirect even if it does not follow it
            raise _not_fetched(source, _INVALID_REDIRECT) from error
        except (httpx2.HTTPError, OSError) as error:
            reason = (str(error) or type(error).__name__)[:_MAX_REASON].rstrip(".")
            raise _not_fetched(source, reason) from error


def _invalid(url: str, role: str, reason: object) -> ServiceError:
    return problems.INVALID_URL(url=url[:100], reason=reason, input=role)


def _not_fetched(source: _Fetch, reason: str) -> ServiceError:
    return problems.URL_NOT_FETCHED(url=source.url[:100], reason=reason, input=source.role)


def _write(chunk: bytes, file: Receiver, receipt: Receipt) -> None:
    receipt.take(len(chunk))
    file.write(chunk)
