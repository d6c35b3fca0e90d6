"""Files as answers: whole or in ranges, with an ETag that is the SHA-256 of their content."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Annotated, Any
from urllib.parse import quote

import anyio
import anyio.to_thread
from fastapi import Header, Request, Response
from fastapi.responses import StreamingResponse

from api.http.documentation import Responses, headers
from api.http.schemas import SHA256
from service.errors import NotFoundError, ServiceError

#: Files of more bytes are checked two at a time, so that neither small files nor other requests wait for them.
_LARGE_BYTES, _LARGE_CHECKS = 64 << 20, anyio.CapacityLimiter(2)
#: Letters of a name that is suggested for a file.
_MAX_NAME = 120

IfNoneMatch = Annotated[
    str | None,
    Header(alias="If-None-Match", description="An ETag; the same one is answered with 304.", examples=['"e7d2c939"']),
]
RangeHeader = Annotated[str | None, Header(alias="Range", description="One range of bytes.", examples=["bytes=0-1023"])]
IfRange = Annotated[
    str | None,
    Header(alias="If-Range", description="An ETag; for another one all is sent.", examples=[f'"{SHA256}"']),
]


class RangeError(ServiceError):
    """A range that the file does not have."""

    code, status = "range-not-satisfiable", 416


#: Of every answer that has a file, and as an example of a refused range.
_SENT = ("ETag", "Accept-Ranges", "Cache-Control", "Content-Disposition", "X-Content-Type-Options")
JUST_REMOVED = NotFoundError("The file has just been removed.")
NO_SUCH_RANGE = RangeError("The file has 42301 bytes.", headers={"Content-Range": "bytes */42301"})


@dataclass(frozen=True)
class SentFile:
    """A file that is asked for.

    Attributes:
        sha256, size: of its content.
        name: under which a browser saves it.
        kind: media type.
        inline: a browser may show it in place.
        policy: Content-Security-Policy; None for none.
        check: proves that the stored file has this content; quick where that has just been done.
        read: its bytes from one up to another, in pieces.
    """

    sha256: str
    size: int
    name: str
    kind: str
    inline: bool
    policy: str | None
    check: Callable[[], None]
    read: Callable[[int, int], Iterator[bytes]]


def file_answers(begins: dict[str, Any], *, always_policy: bool = False) -> Responses:
    """What the OpenAPI document says of answers with a file.

    Args:
        begins: how files of each media type begin, as examples.
        always_policy: every file has a Content-Security-Policy.
    """
    content = {
        kind: {"schema": {} if "json" in kind else {"type": "string", "format": "binary"}, "example": begin}
        for kind, begin in begins.items()
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
            "description": "The part that `Range` asks for.",
            "headers": headers(*always, "Content-Length", "Content-Range", maybe=maybe),
            "content": content,
        },
        304: {"description": "`If-None-Match` names what is there.", "headers": headers(*always, maybe=maybe)},
    }


async def send_file(
    request: Request, file: SentFile, range_: str | None, if_range: str | None, if_none_match: str | None
) -> Response:
    """Answer with a file, or with a part of it.

    Raises:
        RangeError: the range lies behind the end.
        NotFoundError: the file has just been removed.
        LostFileError, DamagedFileError: it is not what its row says; nothing of it is sent.
    """
    tag = f'"{file.sha256}"'
    sent = _headers(file, tag)
    if if_none_match is not None and (tag in if_none_match or if_none_match.strip() == "*"):
        return Response(status_code=304, headers=sent)
    span = _parse_range(range_, file.size) if range_ and if_range in (None, tag) else None
    start, stop = span or (0, file.size)
    sent["Content-Length"] = str(stop - start)
    if span:
        sent["Content-Range"] = f"bytes {start}-{stop - 1}/{file.size}"
    status = 206 if span else 200
    if request.method == "HEAD":
        return Response(status_code=status, headers=sent, media_type=file.kind)
    await anyio.to_thread.run_sync(file.check, limiter=_LARGE_CHECKS if file.size > _LARGE_BYTES else None)
    body = file.read(start, stop)
    first = await asyncio.to_thread(_first, body)  # what fails now can still be answered
    return StreamingResponse(chain(first, body), status, sent, file.kind)


def _first(body: Iterator[bytes]) -> list[bytes]:
    """The first piece of a body, where it has one."""
    try:
        return [piece for piece in (next(body, None),) if piece is not None]
    except FileNotFoundError as error:
        raise JUST_REMOVED from error


def _headers(file: SentFile, tag: str) -> dict[str, str]:
    sent = {
        "ETag": tag,
        "Accept-Ranges": "bytes",
        "Cache-Control": "private, no-cache",
        "X-Content-Type-Options": "nosniff",
        "Content-Disposition": disposition(file.name, inline=file.inline),
    }
    if file.policy is not None:
        sent["Content-Security-Policy"] = file.policy
    return sent


def disposition(name: str, *, inline: bool) -> str:
    """Content-Disposition with a name that needs no care: plain letters, and where it has others, these beside, as
    RFC 6266 and RFC 8187 have it. Folders are left out.
    """
    last = re.sub(r"[\x00-\x1f\x7f-\x9f\"*:<>?|\u202a-\u202e\u2066-\u2069]+", "_", re.split(r"[/\\]", name)[-1])
    last = last[-_MAX_NAME:].strip(" .")
    plain = re.sub(r"[^A-Za-z0-9._-]+", "_", last).strip("._") or "file"
    found = f'{"inline" if inline else "attachment"}; filename="{plain}"'
    if last.isascii() or not last:
        return found
    return f"{found}; filename*=UTF-8''{quote(last, safe='', errors='replace')}"


def _parse_range(text: str, size: int) -> tuple[int, int] | None:
    """First byte and the one behind the last; None where the header asks for several ranges or makes no sense.

    Raises:
        RangeError: the range lies behind the end.
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
        raise RangeError(f"The file has {size} bytes.", headers={"Content-Range": f"bytes */{size}"})
    return start, stop
