"""Upload of a job's files: large ones in resumable parts, small ones in the job's own request."""

from __future__ import annotations

import base64
import hashlib
import json
import secrets
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from httpx_sse import ServerSentEvent

from api.client.answers import ApiError, RequestError, refusal
from api.client.downloads import Progress
from api.client.inputs import InputFile, input_files
from api.client.transport import Call, FileWork, Hear, Steps

#: Maximum bytes of a part; larger files are uploaded in parts.
PART_BYTES = 16 << 20
#: Protocol version of uploads, which every request must state.
_TUS = {"Tus-Resumable": "1.0.0"}


def upload(path: Path, name: str, progress: Progress) -> Steps[str]:
    """Upload a file in parts, and return the upload's id."""
    size = path.stat().st_size
    created = (yield Call("POST", "/v1/uploads", {"headers": _creation_headers(name, size)})).json()
    where = f"/v1/uploads/{created['id']}"
    offset = int(created["offset"])
    while offset < size:
        part, headers = yield FileWork(partial(_read_part, path, offset))
        try:
            yield Call("PATCH", where, {"content": part, "headers": headers})
            offset += len(part)
        except ApiError as error:
            if error.status != 409:
                raise
            offset = int((yield Call("HEAD", where, {"headers": _TUS})).headers["Upload-Offset"])
        progress(offset, size)
    return str(created["id"])


def _creation_headers(name: str, size: int) -> dict[str, str]:
    return {
        **_TUS,
        "Upload-Length": str(size),
        "Upload-Metadata": f"filename {base64.b64encode(name.encode()).decode()}",
        "Idempotency-Key": secrets.token_hex(16),
    }


def _read_part(path: Path, offset: int) -> tuple[bytes, dict[str, str]]:
    """Return a part of a file, and the headers to send it with."""
    with path.open("rb") as file:
        file.seek(offset)
        part = file.read(PART_BYTES)
    if not part:
        raise RequestError(f"{path}: has become shorter while it was sent. Send it again.")
    digest = base64.b64encode(hashlib.sha256(part).digest()).decode()
    return part, {
        **_TUS,
        "Upload-Offset": str(offset),
        "Upload-Checksum": f"sha256 {digest}",
        "Content-Type": "application/offset+octet-stream",
    }


Files = tuple[Path, Sequence[Path], Path | None, Path | None]


def create_job(
    files: Files, parameters: Mapping[str, Any], *, webhook: str | None, progress: Progress
) -> Steps[dict[str, Any]]:
    """Submit a job, and return the service's response.

    Args:
        files: Scene, style images, cameras and photos.
        parameters: Parameters of the job; those that are None are not sent.
        webhook: URL that is called when the job has ended.
        progress: Callback that receives the uploaded bytes and the total bytes of all large files.
    """
    fields = yield from _send_files(files, parameters, progress)
    if webhook:
        fields.append(("webhook", (None, webhook)))
    options = {"files": fields, "headers": {"Idempotency-Key": secrets.token_hex(16)}}
    answer: dict[str, Any] = (yield Call("POST", "/v1/jobs", options)).json()
    return answer


def plan_job(
    files: Files, parameters: Mapping[str, Any], *, progress: Progress, planning: Progress
) -> Steps[dict[str, Any]]:
    """Plan a job without queueing it. The other arguments are the same as for `create_job`.

    Args:
        planning: Callback that receives the number of surveyed views and the number of all views.
    """
    fields = yield from _send_files(files, parameters, progress)
    told: dict[str, Any] = {}

    def take(sent: ServerSentEvent) -> None:
        if not sent.data:
            return
        data = json.loads(sent.data)
        if sent.event == "planning":
            planning(data["step"], data["total"])
        elif sent.event == "problem":
            raise refusal(data["detail"], data["status"], data)
        else:
            told.update(data)

    call = Call("POST", "/v1/jobs", {"params": {"dry_run": True}, "files": fields})
    answer = yield Hear(call, take)
    if answer is not None:
        whole: dict[str, Any] = answer.json()
        return whole
    if not told:  # the service was stopped, or a proxy cut the response off
        raise ApiError("The connection ended before the plan had come. Try again.", 502)
    return told


def _send_files(files: Files, parameters: Mapping[str, Any], progress: Progress) -> Steps[list[tuple[str, Any]]]:
    """Upload the large files, and return the form fields of the request, which contain the small files."""
    inputs: list[InputFile] = yield FileWork(partial(input_files, *files))
    total = sum(file.size for file in inputs if file.size > PART_BYTES)
    done = 0
    fields: list[tuple[str, Any]] = []
    for file in inputs:
        if file.size > PART_BYTES:
            upload_id = yield from upload(file.path, file.name, partial(_report_sum, progress, done, total))
            fields.append((file.role, (None, upload_id)))
            done += file.size
        else:
            content = yield FileWork(file.path.read_bytes)
            fields.append((file.role, (file.name, content, "application/octet-stream")))
    told = {name: value for name, value in parameters.items() if value is not None}
    fields.append(("parameters", (None, json.dumps(told))))
    return fields


def _report_sum(progress: Progress, before: int, total: int, done: int, _size: int) -> None:
    """Report the progress of one file as part of the progress of all files."""
    progress(before + done, total)
