"""Receiver of multipart requests: the files of a job are written to disk as they arrive, in constant memory."""

from __future__ import annotations

import asyncio
import gc
import json
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, TypeVar

from fastapi import Request
from pydantic import BaseModel
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, MultipartState, parse_options_header
from starlette.requests import ClientDisconnect

from api.http.documentation import raises
from api.http.receipts import Receipt
from api.http.request_memory import memory
from service import problems
from service.deadlines import FileThreads
from service.files.blobs import Blobs, Receiver
from service.inputs import MAX_CAMERA_FILES, MOST_STYLES, ROLES, staged_name
from service.problems import ServiceError
from service.settings import ServiceSettings
from worker.options import MOST_REGIONS

#: Maximum bytes of a text field: JSON parameters or an id.
MAX_TEXT = 1 << 16
#: Media types of the body of a new job.
MEDIA_TYPES = "multipart/form-data or application/json"
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


Model = TypeVar("Model", bound=BaseModel)


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
        raise problems.UNSUPPORTED_TYPE(supported=MEDIA_TYPES)
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
            file, self._file = self._file, None
            file.close()
            try:
                check_size(self._role, self._name, file.size)
            except ServiceError:
                file.discard()
                raise
            sha256 = self._blobs.add(file.path, self._receipt.id)
            entry = {"role": self._role, "name": self._name, "sha256": sha256, "size": file.size}
            self.received.files.append(entry)
            return
        text = self._text.decode("utf-8", "replace")
        if self._role not in _TEXT_FIELDS:
            index = len(self.received.files) + len(self.received.uploads)
            self.received.uploads.append((index, self._role, text.strip()))
        elif self._role in self.received.texts:
            raise problems.INVALID_REQUEST(f"The field {self._role!r} was sent twice. Send it once.")
        else:
            self.received.texts[self._role] = text


def most_files(settings: ServiceSettings) -> int:
    """Return the maximum number of files of a job."""
    return settings.max_photos + MAX_CAMERA_FILES + MOST_STYLES + MOST_REGIONS + 1


def check_size(role: str, name: str, size: int) -> None:
    """Check that a file is not empty; the confined inspection process reads it and checks the rest.

    Raises:
        INVALID_INPUT: If the file is empty.
    """
    if not size:
        code = f"invalid-{'image' if role in ('style', 'photos') else role}"
        raise problems.INVALID_INPUT(f"{name}: is empty. Send the file's content.", code=code, input=role)


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
