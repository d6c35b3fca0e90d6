"""Static files of `api/static`: the page at `/`, that of shared results, and the API's documentation at `/docs`.

The files are read and compressed once, and served from memory. Their URLs, `/static/DIGEST/NAME`, contain a digest of
all files, so that browsers can cache them forever. JavaScript modules import each other by relative paths, so a page
always loads modules of the same version. All URLs in pages and modules are relative, so that a proxy can offer the
service below any path.
"""

from __future__ import annotations

import gzip
import hashlib
import mimetypes
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from fastapi import FastAPI, Request, Response

from api.http.schemas import path_of
from api.http.sending import names_etag
from api.static_files import FOLDER, read_static
from service import problems
from service.settings import ServiceSettings

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
    accepted = _GZIP.search(request.headers.get("accept-encoding", ""))
    compressed = file.compressed if accepted else None
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
