"""`/v1/uploads`: resumable uploads in parts, by the tus protocol 1.0 (https://tus.io/protocols/resumable-upload)."""

from __future__ import annotations

import asyncio
import base64
import hashlib
import threading
from collections.abc import Sequence
from datetime import UTC, datetime
from email.utils import format_datetime
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Path, Request, Response

from api.http.context import CallerDep, Context, ContextDep, Digits, is_id
from api.http.problems import headers, links, raises
from api.http.receiving import body_blocks, check_media_type, media_type
from api.http.schemas import UploadView, address, upload_view
from service import problems
from service.inputs import staged_name
from service.problems import UPLOAD_ID, ServiceError, StoreError
from service.store.files import check_offset
from service.store.tables import UploadRow

router = APIRouter(prefix="/v1/uploads", tags=["uploads"])

VERSION = "1.0.0"
#: Supported extensions of the protocol, and headers of others: name, part of the value, extension.
EXTENSIONS = "creation,expiration,checksum,termination"
_UNSUPPORTED = (
    ("Upload-Concat", "", "concatenation"),
    ("Upload-Defer-Length", "", "creation-defer-length"),
    ("Trailer", "upload-checksum", "checksum-trailer"),
)
#: Digest algorithms of `Upload-Checksum`.
_ALGORITHMS = ("sha256", "sha1", "md5")
#: Number of bytes after which an upload's state is saved. A crash loses at most this many bytes.
_SAVE_BYTES = 64 << 20
#: Media type of a part of a file.
_PART_TYPE = "application/offset+octet-stream"
_HEADERS = {"Tus-Resumable": VERSION, "Cache-Control": "no-store"}


IdempotencyHeader = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=180,
        description="Unique key of the request. Repeating it within a day creates nothing twice.",
        examples=["5f0c9a52-9a3b-4c39-8a1c-0d9a2b8b6d1e"],
    ),
]
UploadId = Annotated[str, Path(description="ID of an upload.", examples=[UPLOAD_ID])]
Tus = Annotated[
    str,
    Header(
        alias="Tus-Resumable",
        description="Protocol version. Requests without it are rejected.",
        examples=[VERSION],
        json_schema_extra={"const": VERSION},
    ),
]
LengthHeader = Annotated[
    Digits,
    Header(alias="Upload-Length", ge=0, lt=2**60, description="Size of the whole file in bytes.", examples=[42301]),
]
OffsetHeader = Annotated[
    Digits,
    Header(alias="Upload-Offset", ge=0, lt=2**60, description="Offset of these bytes in the file.", examples=[16384]),
]


@raises(problems.TUS_VERSION, problems.TUS_EXTENSION)
def check_protocol(request: Request, tus: Tus = "") -> None:
    """Refuse a request that does not state the protocol version, or uses an unsupported extension.

    tus requires the version for all methods except OPTIONS.

    Raises:
        TUS_VERSION: If the version is missing or not supported.
        TUS_EXTENSION: If a header belongs to an unsupported extension. Ignoring it would store other bytes than meant.
    """
    if tus != VERSION:
        reason = f"{tus[:20]!r} is not supported" if tus else "is missing"
        raise problems.TUS_VERSION(reason=reason, version=VERSION)
    for header, value, extension in _UNSUPPORTED:
        if value in request.headers.get(header, "").lower() and header in request.headers:
            raise problems.TUS_EXTENSION(header=header, extension=extension, supported=EXTENSIONS)
    empty = request.headers.get("content-length", "0") == "0" and "transfer-encoding" not in request.headers
    if request.method == "POST" and media_type(request) == _PART_TYPE and not empty:
        raise problems.TUS_EXTENSION(header="Content-Type", extension="creation-with-upload", supported=EXTENSIONS)


_REQUIRES_TUS = [Depends(check_protocol)]


_NEW = {"upload_id": "$response.body#/id"}
#: OpenAPI links to the operations that a client may call next on a new upload.
_FOLLOWING_OPERATIONS = {
    **links("get_upload", "head_upload", "delete_upload", **_NEW),
    **links("append_upload", **_NEW, **{"Upload-Offset": "0"}),
}


@router.options(
    "",
    status_code=204,
    responses={
        204: {
            "description": "The answer is in the headers.",
            "headers": headers(
                "Tus-Resumable", "Tus-Version", "Tus-Extension", "Tus-Checksum-Algorithm", "Tus-Max-Size"
            ),
        }
    },
)
def describe_uploads(context: ContextDep) -> Response:
    """Describe the supported protocol version and extensions."""
    response_headers = {
        "Tus-Resumable": VERSION,
        "Tus-Version": VERSION,
        "Tus-Extension": EXTENSIONS,
        "Tus-Checksum-Algorithm": ",".join(_ALGORITHMS),
        "Tus-Max-Size": str(context.settings.max_upload_bytes),
    }
    return Response(status_code=204, headers=response_headers)


@router.post(
    "",
    status_code=201,
    dependencies=_REQUIRES_TUS,
    response_model=UploadView,
    responses={
        201: {
            "description": "The upload is created; send its bytes to the `Location`.",
            "headers": headers("Location", "Tus-Resumable", "Upload-Expires", "Cache-Control"),
            "links": _FOLLOWING_OPERATIONS,
        }
    },
)
async def create_upload(
    context: ContextDep,
    caller: CallerDep,
    length: LengthHeader,
    metadata: Annotated[
        str,
        Header(
            alias="Upload-Metadata",
            max_length=4000,
            description="`filename` and its base64.",
            examples=["filename c2NlbmUucGx5"],
        ),
    ] = "",
    idempotency_key: IdempotencyHeader = None,
) -> Response:
    """Start an upload. Send its bytes with PATCH to the `Location` of the answer."""
    limit = context.settings.max_upload_bytes
    if length > limit:
        raise problems.TOO_LARGE(f"The file has {length:,} bytes. At most {limit:,} are allowed.", limit=limit)
    name = staged_name("upload", uploaded_name(metadata))
    if not length:
        raise problems.MALFORMED_BODY(f"{name}: is empty (Upload-Length: 0). Choose a file with content.")
    seconds = context.settings.upload_hours * 3600
    await context.threads.run(caller.owner, context.blobs.ensure_space, length)
    row = await asyncio.to_thread(
        context.store.inputs.create_upload,
        caller.owner,
        length,
        name,
        metadata,
        seconds,
        idempotency_key,
        caller.quotas,
    )
    if row.sha256 is None:  # a repeated request may refer to an upload that is already complete
        await context.threads.run(caller.owner, context.blobs.start_upload, row.id)
    response_headers = {
        **_HEADERS,
        "Location": address(f"/v1/uploads/{row.id}"),
        "Upload-Expires": _http_date(row.expires_at),
    }
    return Response(upload_view(row).model_dump_json(), 201, response_headers, "application/json")


@router.get("/{upload_id}", response_model=UploadView)
def get_upload(upload_id: UploadId, context: ContextDep, caller: CallerDep) -> UploadView:
    """Get the state of an upload as JSON."""
    return upload_view(_find_upload(context, caller.owner, upload_id))


@router.head(
    "/{upload_id}",
    dependencies=_REQUIRES_TUS,
    responses={
        200: {
            "description": "The answer is in the headers.",
            "headers": headers(
                "Upload-Offset",
                "Upload-Length",
                "Upload-Expires",
                "Tus-Resumable",
                "Cache-Control",
                maybe=("Upload-Metadata",),
            ),
        }
    },
    response_class=Response,
)
def head_upload(upload_id: UploadId, context: ContextDep, caller: CallerDep) -> Response:
    """Get the state of an upload as headers. `Upload-Offset` is where to resume."""
    row = _find_upload(context, caller.owner, upload_id)
    response_headers = {
        **_HEADERS,
        "Upload-Offset": str(row.offset),
        "Upload-Length": str(row.length),
        "Upload-Expires": _http_date(row.expires_at),
    }
    if row.metadata_header:
        response_headers["Upload-Metadata"] = row.metadata_header
    return Response(headers=response_headers)


_PATCH_BODY = {
    "requestBody": {
        "required": True,
        "content": {
            _PART_TYPE: {
                "schema": {"type": "string", "format": "binary"},
                "example": "ply\nformat binary_little_endian 1.0\nelement vertex 616\n",
            }
        },
    }
}


@router.patch(
    "/{upload_id}",
    status_code=204,
    dependencies=_REQUIRES_TUS,
    responses={
        204: {
            "description": "The part is stored; `Upload-Offset` is where the next part starts.",
            "headers": headers("Upload-Offset", "Upload-Expires", "Tus-Resumable", "Cache-Control"),
        }
    },
    openapi_extra=_PATCH_BODY,
    response_class=Response,
)
async def append_upload(
    request: Request,
    upload_id: UploadId,
    context: ContextDep,
    caller: CallerDep,
    offset: OffsetHeader,
    checksum: Annotated[
        str | None,
        Header(
            alias="Upload-Checksum",
            description="Algorithm and base64 of this part's digest.",
            examples=["sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0="],
        ),
    ] = None,
) -> Response:
    """Send the next part. If the connection breaks, received bytes are stored unless a checksum was announced."""
    check_media_type(request, _PART_TYPE)
    expected = _parse_checksum(checksum) if checksum else None
    row = await asyncio.to_thread(_find_upload, context, caller.owner, upload_id)
    if row.sha256 is not None and offset != row.length:
        raise problems.CONFLICT(f"The upload is complete with {row.length} bytes.", offset=row.length)
    check_offset(row, offset)
    expires = row.expires_at
    if row.sha256 is None and row.offset == row.length:  # the service died before it recorded the upload as complete
        finish, seconds = context.blobs.finish_upload, context.settings.upload_hours * 3600
        await context.threads.run(caller.owner, finish, row, seconds, size=row.length)
    elif row.sha256 is None:
        expires = await _append_body(request, context, row, expected)
    else:
        async for _ in body_blocks(request, context.settings):
            raise _longer_than_declared(row.length)
    row = await asyncio.to_thread(_find_upload, context, caller.owner, upload_id)
    return Response(
        status_code=204, headers={**_HEADERS, "Upload-Offset": str(row.offset), "Upload-Expires": _http_date(expires)}
    )


@router.delete(
    "/{upload_id}",
    status_code=204,
    dependencies=_REQUIRES_TUS,
    responses={204: {"description": "The upload is deleted.", "headers": headers("Tus-Resumable", "Cache-Control")}},
)
async def delete_upload(upload_id: UploadId, context: ContextDep, caller: CallerDep) -> Response:
    """Cancel an upload, or delete a finished one. Jobs that use it keep their file."""
    await asyncio.to_thread(_find_upload, context, caller.owner, upload_id)
    unused = await asyncio.to_thread(context.store.inputs.delete_upload, upload_id, caller.owner)
    await context.receipts.remove(caller.owner, partial(_remove_files, context, upload_id, unused))
    return Response(status_code=204, headers=_HEADERS)


async def _append_body(request: Request, context: Context, row: UploadRow, checksum: tuple[str, bytes] | None) -> float:
    """Append the request's body to the upload, and return the upload's new expiry time.

    Args:
        checksum: Algorithm and expected digest of the body; None for no check.
    """
    run = partial(context.threads.run, row.owner)
    writer = await run(_Writer, context, row, checksum)
    try:
        try:
            async for block in body_blocks(request, context.settings):
                await run(writer.write, block, size=_SAVE_BYTES)
        except StoreError:
            raise
        except ServiceError:
            if checksum is None:
                await run(writer.save, size=_SAVE_BYTES)  # no checksum can contradict them
            raise
        return await run(writer.finish, size=row.length if writer.complete else _SAVE_BYTES)
    finally:
        await context.threads.clean_up(run(writer.close))


class _Writer:
    """Writer that checks received bytes and saves them at intervals.

    A thread that hangs and was given up blocks the others, so that no file is closed while it is written to.
    """

    def __init__(self, context: Context, row: UploadRow, checksum: tuple[str, bytes] | None) -> None:
        self._context, self._row, self._checksum = context, row, checksum
        self._lock = threading.RLock()
        self._seconds = context.settings.upload_hours * 3600
        self._part = context.blobs.append(row, self._seconds)
        self._digest = hashlib.new(checksum[0]) if checksum else None

    def write(self, block: bytes) -> None:
        if self._part.offset + len(block) > self._row.length:
            raise _longer_than_declared(self._row.length)
        with self._lock:
            self._context.blobs.ensure_space(len(block))
            self._part.write(block)
            if self._digest is not None:
                self._digest.update(block)
            elif self._part.offset - self._part.saved >= _SAVE_BYTES:
                self.save()

    @property
    def complete(self) -> bool:
        """Whether all bytes of the upload have been written."""
        return self._part.offset == self._row.length

    def save(self) -> float:
        """Make the received bytes durable, then update the database. Return the upload's new expiry time."""
        with self._lock:
            return self._part.save()

    def finish(self) -> float:
        """Verify and save the bytes of the request. Store the file as a blob if the upload is complete."""
        if self._digest is not None and self._checksum is not None and self._digest.digest() != self._checksum[1]:
            self._part.discard()
            raise problems.CHECKSUM_MISMATCH()
        expires = self.save()
        self.close()
        if self.complete:
            self._context.blobs.finish_upload(self._row, self._seconds)
        return expires

    def close(self) -> None:
        with self._lock:
            self._part.close()


def _longer_than_declared(length: int) -> ServiceError:
    """Return the error for a part with more bytes than the upload lacks."""
    return problems.TOO_LARGE(f"The parts have more bytes than the {length:,} of Upload-Length.", limit=length)


def _parse_checksum(header: str) -> tuple[str, bytes]:
    """Return the algorithm and the digest of an `Upload-Checksum` header.

    Raises:
        MALFORMED_BODY: If the header is malformed.
    """
    name, _, value = header.partition(" ")
    if name not in _ALGORITHMS:
        raise problems.MALFORMED_BODY(f"Upload-Checksum: {name[:20]!r} is none of {', '.join(_ALGORITHMS)}.")
    try:
        return name, base64.b64decode(value, validate=True)
    except ValueError as error:  # raised for non-ASCII characters too
        raise problems.MALFORMED_BODY("Upload-Checksum: the digest is not base64.") from error


def _remove_files(context: Context, upload_id: str, unused: Sequence[str]) -> None:
    context.blobs.discard_upload(upload_id)
    context.blobs.remove(unused)


def _find_upload(context: Context, owner: str, upload_id: str) -> UploadRow:
    if not is_id(upload_id):
        raise problems.NO_UPLOAD(upload_id=upload_id[:60])
    return context.store.inputs.upload(upload_id, owner)


def _http_date(seconds: float) -> str:
    return format_datetime(datetime.fromtimestamp(seconds, UTC), usegmt=True)


def uploaded_name(metadata: str) -> str:
    """Return the `filename` in an `Upload-Metadata` header, which has the format `key base64, key base64`.

    Raises:
        MALFORMED_BODY: If it is not base64 of UTF-8.
    """
    for pair in metadata.split(","):
        key, _, value = pair.strip().partition(" ")
        if key in ("filename", "name"):
            try:
                return base64.b64decode(value, validate=True).decode()
            except ValueError as error:  # raised for non-ASCII characters too
                raise problems.MALFORMED_BODY(f"Upload-Metadata: {key!r} is not base64 of UTF-8.") from error
    return ""
