"""Files as HTTP responses: stored ones, whole or in ranges, with the SHA-256 of their content as the ETag, and static
ones.

Static files are those of `api/static`: the page at `/`, that of shared results, and the API's documentation at `/docs`.
They are read and compressed once, and served from memory. Their URLs, `/static/DIGEST/NAME`, contain a digest of all
files, so that browsers can cache them forever. JavaScript modules import each other by relative paths, so a page always
loads modules of the same version. All URLs in pages and modules are relative, so that a proxy can offer the service
below any path.
"""

import asyncio
import gzip
import hashlib
import json
import mimetypes
import re
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import quote

from fastapi import Depends, FastAPI, Header, Request, Response
from fastapi.responses import StreamingResponse
from pydantic import BaseModel

from api.http.context import memory
from api.http.problems import Responses, headers, raises
from api.http.schemas import path_of
from api.static_files import FOLDER, read_static
from service import problems
from service.deadlines import FileThreads
from service.problems import SHA256
from service.settings import ServiceSettings

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


@raises(problems.RANGE_NOT_SATISFIABLE, problems.PRECONDITION_FAILED)
@dataclass(frozen=True)
class Conditions:
    """Headers of a request that ask for a range of a file, or for the file only if it has changed."""

    range_: Annotated[
        str | None, Header(alias="Range", description="One range of bytes.", examples=["bytes=0-1023"])
    ] = None
    if_range: Annotated[
        str | None,
        Header(
            alias="If-Range",
            description="ETag of the partial file; if the file has changed, it is sent as a whole.",
            examples=[f'"{SHA256}"'],
        ),
    ] = None
    if_none_match: IfNoneMatch = None
    if_match: Annotated[
        str | None,
        Header(
            alias="If-Match",
            description="ETag of the expected content; if the file has changed, the answer is 412.",
            examples=[f'"{SHA256}"'],
        ),
    ] = None


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

#: Function that returns up to so many entries after a cursor, each with the cursor behind it; None is not shown.
ReadEntries = Callable[[str | None, int], Sequence[tuple[str, BaseModel | None]]]


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
        most = min(limit, at_once)
        page = read(cursor, most + 1)  # one more shows if more follow
        cursor = page[most - 1][0] if len(page) > most else None
        entries = [entry for _, entry in page[:most] if entry]
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


# --- static files ----------------------------------------------------------------------------------------------------

#: Placeholder in pages for the URL prefix of the files.
_PREFIX = b"{{static}}"
_DIGEST_LETTERS = 16
#: Minimum size in bytes of files to compress. Smaller files fit in one packet anyway.
_MIN_COMPRESSED = 1000
_TEXTS = (".css", ".html", ".js", ".json", ".map", ".md", ".svg", ".txt")
_KINDS = {
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".md": "text/plain; charset=utf-8",
}

POLICY = (
    "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob:; media-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: Content-Security-Policy of `/docs`. Swagger UI's style sheet has inline icons.
DOCS_POLICY = POLICY.replace("img-src 'self' blob:", "img-src 'self' data:")
_PAGES = {"/": ("index.html", POLICY), "/shared": ("shared.html", POLICY), "/docs": ("docs.html", DOCS_POLICY)}
#: Headers of pages: neither other sites nor scripts of other types get anything from them.
PAGE_HEADERS = {"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"}
#: Acceptance of gzip in an Accept-Encoding header; `q=0` refuses it.
_GZIP = re.compile(r"\bgzip\b(?!\s*;\s*q=0(\.0*)?\s*(,|$))")
_IMMUTABLE = "public, max-age=31536000, immutable"


@dataclass(frozen=True)
class StaticFile:
    """A file to be served.

    Attributes:
        compressed: Content with gzip compression; None if that saves nothing.
        digest: SHA-256 of the content.
        kind: Media type.
    """

    body: bytes
    compressed: bytes | None
    digest: str
    kind: str


@dataclass(frozen=True)
class StaticFiles:
    """All static files.

    Attributes:
        digest: Digest of all names and contents, as used in URLs.
        files: Files by name below `/static/DIGEST`.
        pages: Pages by name, with the URL prefix of the files filled in.
    """

    digest: str
    files: dict[str, StaticFile]
    pages: dict[str, StaticFile]


@cache
def static_files(folder: Path = FOLDER) -> StaticFiles:
    """Read and compress the files of a folder."""
    contents = read_static(folder)
    whole = hashlib.sha256()
    for name, body in contents.items():
        whole.update(f"{name}\0{len(body)}\0".encode() + body)
    digest = whole.hexdigest()[:_DIGEST_LETTERS]
    pages = {name: contents.pop(name).replace(_PREFIX, f"static/{digest}".encode()) for name, _ in _PAGES.values()}
    return StaticFiles(
        digest, *({name: _file(name, body) for name, body in part.items()} for part in (contents, pages))
    )


def _file(name: str, body: bytes) -> StaticFile:
    suffix = Path(name).suffix
    compressed = gzip.compress(body, mtime=0) if suffix in _TEXTS and len(body) >= _MIN_COMPRESSED else None
    kind = _KINDS.get(suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"
    return StaticFile(body, compressed, hashlib.sha256(body).hexdigest(), kind)


def add_static(app: FastAPI) -> None:
    """Add routes for all static files. They require no key, because they are the same for everybody."""
    static = static_files()

    async def get_page(request: Request) -> Response:
        name, policy = _PAGES[path_of(request.scope)]
        if name == "shared.html":
            policy = shared_policy(request, app.state.context.settings)
        return _answer(request, static.pages[name], "no-cache", policy)

    async def get_file(request: Request, digest: str, name: str) -> Response:
        file = static.files.get(name) if digest == static.digest else None
        if file is None:
            raise problems.NOT_FOUND("There is no such file in this version of the page. Load the page again.")
        return _answer(request, file, _IMMUTABLE, POLICY)

    options = {"methods": ["GET", "HEAD"], "include_in_schema": False}
    for path in _PAGES:
        app.add_api_route(path, get_page, **options)  # type: ignore[arg-type]
    app.add_api_route("/static/{digest}/{name:path}", get_file, **options)  # type: ignore[arg-type]


def shared_policy(request: Request, settings: ServiceSettings) -> str:
    """Return the policy of the page of a shared result; with `embed=1`, permitted origins may show it in a frame."""
    if request.query_params.get("embed") != "1":
        return POLICY
    return POLICY.replace("frame-ancestors 'none'", f"frame-ancestors {settings.frame_ancestors}")


def shared_page(head: str) -> bytes:
    """Return the page of a shared result for addresses one folder deeper than `/shared`, with more in its head."""
    body = static_files().pages["shared.html"].body
    return body.replace(b'"static/', b'"../static/').replace(b"</head>", f"{head}</head>".encode())


def _answer(request: Request, file: StaticFile, caching: str, policy: str) -> Response:
    compressed = file.compressed if _GZIP.search(request.headers.get("accept-encoding", "")) else None
    tag = f'"{file.digest}-gzip"' if compressed is not None else f'"{file.digest}"'
    response_headers = {
        "ETag": tag,
        "Cache-Control": caching,
        "Vary": "Accept-Encoding",
        "Content-Security-Policy": policy,
        **PAGE_HEADERS,
    }
    if names_etag(request.headers.get("if-none-match"), tag):
        return Response(status_code=304, headers=response_headers)
    if compressed is not None:
        response_headers["Content-Encoding"] = "gzip"
    return Response(file.body if compressed is None else compressed, headers=response_headers, media_type=file.kind)
