"""The page at `/`, the API's documentation at `/docs`, and what both load: the files of `api/static`.

They are read and compressed once, and served from memory. One digest over all of them stands in their address,
`/static/DIGEST/NAME`: browsers keep them for ever, and modules, which import each other by relative paths, are always
of one version.
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

from service.errors import NotFoundError

FOLDER = Path(__file__).parents[1] / "static"
#: In pages, stands for the address of the files.
_PLACE = b"{{static}}"
_DIGEST_LETTERS = 16
#: Smaller files are one packet in any case.
_LEAST_PACKED = 1000
_TEXTS = (".css", ".html", ".js", ".json", ".map", ".md", ".svg", ".txt")
_KINDS = {
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".md": "text/plain; charset=utf-8",
}

POLICY = (
    "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
#: Swagger UI's style sheet has its icons in it.
DOCS_POLICY = POLICY.replace("img-src 'self' blob:", "img-src 'self' data:")
_PAGES = {"/": ("index.html", POLICY), "/docs": ("docs.html", DOCS_POLICY)}
_FOR_EVER = "public, max-age=31536000, immutable"


@dataclass(frozen=True)
class StaticFile:
    """A file as it is sent.

    Attributes:
        body: its bytes.
        packed: the same by gzip; None where that is no gain.
        digest: SHA-256 of the bytes.
        kind: media type.
    """

    body: bytes
    packed: bytes | None
    digest: str
    kind: str


@dataclass(frozen=True)
class StaticFiles:
    """All files.

    Attributes:
        digest: of all names and bytes, as it stands in addresses.
        files: by name, below `/static/DIGEST`.
        pages: by name, with the files' address filled in.
    """

    digest: str
    files: dict[str, StaticFile]
    pages: dict[str, StaticFile]


@cache
def static_files(folder: Path = FOLDER) -> StaticFiles:
    """What is in the folder now."""
    contents = {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not any(part.startswith(".") for part in path.relative_to(folder).parts)
    }
    whole = hashlib.sha256()
    for name, body in contents.items():
        whole.update(f"{name}\0{len(body)}\0".encode() + body)
    digest = whole.hexdigest()[:_DIGEST_LETTERS]
    pages = {name: contents.pop(name).replace(_PLACE, f"/static/{digest}".encode()) for name, _ in _PAGES.values()}
    return StaticFiles(
        digest, *({name: _file(name, body) for name, body in part.items()} for part in (contents, pages))
    )


def _file(name: str, body: bytes) -> StaticFile:
    suffix = Path(name).suffix
    packed = gzip.compress(body, mtime=0) if suffix in _TEXTS and len(body) >= _LEAST_PACKED else None
    kind = _KINDS.get(suffix) or mimetypes.guess_type(name)[0] or "application/octet-stream"
    return StaticFile(body, packed, hashlib.sha256(body).hexdigest(), kind)


def add_static(app: FastAPI) -> None:
    """Serve all of it. None of it needs a key: it is the same for everybody."""
    found = static_files()

    async def get_page(request: Request) -> Response:
        name, policy = _PAGES[request.url.path]
        return _answer(request, found.pages[name], "no-cache", policy)

    async def get_file(request: Request, digest: str, name: str) -> Response:
        file = found.files.get(name) if digest == found.digest else None
        if file is None:
            raise NotFoundError("There is no such file in this version of the page. Load the page again.")
        return _answer(request, file, _FOR_EVER, POLICY)

    options = {"methods": ["GET", "HEAD"], "include_in_schema": False}
    for path in _PAGES:
        app.add_api_route(path, get_page, **options)  # type: ignore[arg-type]
    app.add_api_route("/static/{digest}/{name:path}", get_file, **options)  # type: ignore[arg-type]


def _answer(request: Request, file: StaticFile, caching: str, policy: str) -> Response:
    packed = file.packed if _takes_gzip(request.headers.get("accept-encoding", "")) else None
    tag = f'"{file.digest}-gzip"' if packed is not None else f'"{file.digest}"'
    sent = {
        "ETag": tag,
        "Cache-Control": caching,
        "Vary": "Accept-Encoding",
        "Content-Security-Policy": policy,
        "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer",
    }
    if tag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=sent)
    if packed is not None:
        sent["Content-Encoding"] = "gzip"
    return Response(file.body if packed is None else packed, headers=sent, media_type=file.kind)


def _takes_gzip(accepted: str) -> bool:
    """Whether an Accept-Encoding has gzip, and not with `q=0`."""
    return re.search(r"\bgzip\b(?!\s*;\s*q=0(\.0*)?\s*(,|$))", accepted) is not None
