"""Files as HTTP responses: whole or in ranges, with the SHA-256 of the content as the ETag."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import Depends, Header, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel

from api.http.context import memory
from api.http.problems import Responses, headers, raises
from service import problems
from service.deadlines import FileThreads
from service.problems import SHA256

#: Maximum size in bytes of two chunks. Sending 64 kB at a time takes several times as much CPU time per byte.
_MOST_BYTES = 1 << 20
#: Maximum number of characters of a suggested file name.
_MAX_NAME = 120

_ETAG = re.compile(r'(W/)?("[^"]*")')

IfNoneMatch = Annotated[
    str | None,
    Header(
        alias="If-None-Match",
        description="ETag of the known content; if it is current, the answer is 304.",
        examples=['"e7d2c939"'],
    ),
]
IfMatch = Annotated[
    str | None,
    Header(
        alias="If-Match",
        description="ETag of the expected content; if the file has changed, the answer is 412.",
        examples=[f'"{SHA256}"'],
    ),
]
RangeHeader = Annotated[str | None, Header(alias="Range", description="One range of bytes.", examples=["bytes=0-1023"])]
IfRange = Annotated[
    str | None,
    Header(
        alias="If-Range",
        description="ETag of the partial file; if the file has changed, it is sent as a whole.",
        examples=[f'"{SHA256}"'],
    ),
]


@raises(problems.RANGE_NOT_SATISFIABLE, problems.PRECONDITION_FAILED)
@dataclass(frozen=True)
class Conditions:
    """Headers of a request that ask for a range of a file, or for the file only if it has changed."""

    range_: RangeHeader = None
    if_range: IfRange = None
    if_none_match: IfNoneMatch = None
    if_match: IfMatch = None


ConditionsDep = Annotated[Conditions, Depends()]


#: Headers of every response with a file.
_SENT = ("ETag", "Accept-Ranges", "Cache-Control", "Content-Disposition", "X-Content-Type-Options")


@dataclass(frozen=True)
class SentFile:
    """File to send.

    Attributes:
        owner: Owner of the file, whose turn it is sent in.
        name: Suggested name for saving the file.
        kind: Media type.
        check: Function that checks that the stored file has this content. It is fast if the file was checked recently.
        read: Function that yields the bytes from one offset up to another, in chunks of at most a given size.
        policy: Content-Security-Policy; None for none.
        inline: Whether a browser may show the file inline.
    """

    owner: str
    sha256: str
    size: int
    name: str
    kind: str
    check: Callable[[], None]
    read: Callable[[int, int, int], Iterator[bytes]]
    policy: str | None = None
    inline: bool = False


def file_answers(starts: dict[str, Any], *, always_policy: bool = False) -> Responses:
    """Return the OpenAPI documentation of responses with a file.

    Args:
        starts: Start of a file's content for each media type, as examples.
        always_policy: Whether every file has a Content-Security-Policy.
    """
    content = {
        kind: {"schema": {} if "json" in kind else {"type": "string", "format": "binary"}, "example": start}
        for kind, start in starts.items()
    }
    always = (*_SENT, "Content-Security-Policy") if always_policy else _SENT
    maybe = () if always_policy else ("Content-Security-Policy",)
    return {
        200: {
            "description": "The file. Its ETag is the SHA-256 of its content.",
            "headers": headers(*always, "Content-Length", maybe=maybe),
            "content": content,
        },
        206: {
            "description": "The range requested by `Range`.",
            "headers": headers(*always, "Content-Length", "Content-Range", maybe=maybe),
            "content": content,
        },
        304: {
            "description": "The content has not changed since the ETag of `If-None-Match`.",
            "headers": headers(*always, maybe=maybe),
        },
    }


#: Size of the pieces in which a list is sent. No request holds more of it, except the entries that are read at once.
_PIECE_BYTES = 1 << 16

#: Function that returns up to so many entries after a cursor, and the cursor of the next ones; None for none.
ReadEntries = Callable[[str | None, int], tuple[Sequence[BaseModel], str | None]]


async def send_list(
    name: str, read: ReadEntries, cursor: str | None, limit: int, turn: asyncio.Semaphore, *, at_once: int = 250
) -> Response:
    """Return the response with a page of a list, `{NAME: [...], "next_cursor": ...}`, which is sent as it is read.

    Args:
        read: Function that reads entries.
        cursor: Cursor of the page; None for the first one.
        limit: Maximum number of entries on the page.
        turn: Semaphore of the list's owner, who occupies few threads at once.
        at_once: Number of entries to read at once.
    """
    pieces = _pieces(name, read, cursor, limit, at_once)

    async def following() -> bytes | None:
        async with turn:
            return await asyncio.to_thread(next, pieces, None)

    first, second = [await following() for _ in range(2)]
    if second is None:
        return Response(first, media_type="application/json")

    async def body() -> AsyncIterator[bytes]:
        piece: bytes | None = second
        yield first or b""
        while piece is not None:
            yield piece
            piece = await following()

    return StreamingResponse(body(), media_type="application/json")


def _pieces(name: str, read: ReadEntries, cursor: str | None, limit: int, at_once: int) -> Iterator[bytes]:
    text, separator = f'{{"{name}":[', ""
    while True:
        entries, cursor = read(cursor, min(limit, at_once))
        limit -= len(entries)
        if entries:
            text += separator + ",".join(entry.model_dump_json() for entry in entries)
            separator = ","
        if not limit or cursor is None:
            yield f'{text}],"next_cursor":{json.dumps(cursor)}}}'.encode()
            return
        if len(text) >= _PIECE_BYTES:
            yield text.encode()
            text = ""


def names_etag(header: str | None, tag: str, *, strong: bool = False) -> bool:
    """Return whether an If-None-Match or If-Match header names an entity tag (RFC 9110, section 13.1).

    Args:
        strong: Whether weak tags, which proxies make of strong ones when they compress, name nothing.
    """
    text = (header or "").strip()
    return text == "*" or any(tag == named and not (strong and weak) for weak, named in _ETAG.findall(text))


async def send_file(request: Request, threads: FileThreads, file: SentFile, conditions: Conditions) -> Response:
    """Return the response with a file or a range of it.

    Raises:
        PRECONDITION_FAILED: If the file is not the one that If-Match names.
        RANGE_NOT_SATISFIABLE: If the range starts after the end of the file.
        NotFoundError: If the file has just been deleted.
        LostFileError, DamagedFileError: If the stored file does not match its database row. No byte of it is sent.
    """
    tag = f'"{file.sha256}"'
    response_headers = {
        "ETag": tag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache, no-transform",  # compressed by a proxy, it would have no ranges
        "X-Content-Type-Options": "nosniff",
        "Content-Disposition": disposition(file.name, inline=file.inline),
    }
    if file.policy is not None:
        response_headers["Content-Security-Policy"] = file.policy
    if conditions.if_match is not None and not names_etag(conditions.if_match, tag, strong=True):
        raise problems.PRECONDITION_FAILED()
    if names_etag(conditions.if_none_match, tag):
        return Response(status_code=304, headers=response_headers)
    unchanged = conditions.if_range in (None, tag)
    span = _parse_range(conditions.range_, file.size) if conditions.range_ and unchanged else None
    start, stop = span or (0, file.size)
    response_headers["Content-Length"] = str(stop - start)
    if span:
        response_headers["Content-Range"] = f"bytes {start}-{stop - 1}/{file.size}"
    status = 206 if span else 200
    if request.method == "HEAD":
        return Response(status_code=status, headers=response_headers, media_type=file.kind)
    await threads.run(file.owner, file.check, size=file.size)
    body = file.read(start, stop, memory.share(_MOST_BYTES) // 2)  # one chunk is read while another is sent
    first = await threads.run(file.owner, _next, body)  # an error at this point can still be sent as a response
    return StreamingResponse(_chunks(threads, file.owner, first, body), status, response_headers, file.kind)


async def _chunks(threads: FileThreads, owner: str, chunk: bytes | None, body: Iterator[bytes]) -> AsyncIterator[bytes]:
    """Yield a chunk and the ones that follow it."""
    while chunk is not None:
        yield chunk
        chunk = await threads.run(owner, _next, body)


def _next(body: Iterator[bytes]) -> bytes | None:
    """Return the next chunk of a body; None at its end."""
    try:
        return next(body, None)
    except FileNotFoundError as error:
        raise problems.FILE_REMOVED() from error


def disposition(name: str, *, inline: bool) -> str:
    """Return a Content-Disposition header with a safe file name.

    `filename` contains only ASCII letters, digits and some punctuation. Names with other characters are also sent as
    `filename*` (RFC 6266, RFC 8187). Folders are removed.
    """
    last = re.sub(r"[\x00-\x1f\x7f-\x9f\"*:<>?|\u202a-\u202e\u2066-\u2069]+", "_", re.split(r"[/\\]", name)[-1])
    last = last[-_MAX_NAME:].strip(" .")
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", last).strip("._-") or "file"
    header = f'{"inline" if inline else "attachment"}; filename="{plain}"'
    if last.isascii() or not last:
        return header
    return f"{header}; filename*=UTF-8''{quote(last, safe='', errors='replace')}"


def _parse_range(text: str, size: int) -> tuple[int, int] | None:
    """Return start and end (exclusive) of a byte range; None if the header is malformed or has several ranges.

    Raises:
        RANGE_NOT_SATISFIABLE: If the range starts after the end of the file.
    """
    match = re.fullmatch(r"bytes=([0-9]{0,18})-([0-9]{0,18})", text.strip())
    if match is None or match[0] == "bytes=-":
        return None
    first, last = match[1], match[2]
    if not first:
        start, stop = max(0, size - int(last)), size
    else:
        start, stop = int(first), min(size, int(last) + 1) if last else size
        if last and int(last) < start:
            return None
    if start >= stop:
        raise problems.RANGE_NOT_SATISFIABLE(size=size)
    return start, stop
