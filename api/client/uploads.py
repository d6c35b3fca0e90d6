"""Sending files: large ones in parts that go on after a lost connection, a job's small ones in its own request."""

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

#: Files from this size on are uploaded in parts.
PART_BYTES = 16 << 20
#: The version of the protocol of uploads, which every request states.
_TUS = {"Tus-Resumable": "1.0.0"}


def upload(path: Path, name: str, progress: Progress) -> Steps[str]:
    """Send a file in parts; returns the upload's id."""
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
    """A part of a file, and the headers to send it with."""
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
    """Send a job; returns what the service answers.

    Args:
        files: scene, the style's pictures, cameras and photos.
        parameters: of the job; None leaves one out.
        webhook: URL that is told when the job has ended.
        progress: called with the bytes that are up and those of all large files.
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
    """Plan a job instead of queueing it; arguments are those of `create_job`.

    Args:
        planning: called with the views that have been looked at, and all of them.
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
    if not told:  # the service was stopped, or something between it and here cut the answer off
        raise ApiError("The connection ended before the plan had come. Try again.", 502)
    return told


def _send_files(files: Files, parameters: Mapping[str, Any], progress: Progress) -> Steps[list[tuple[str, Any]]]:
    """Upload what is large; returns the fields of the request, which carries the rest."""
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
    """Tell of one file as a part of all of them."""
    progress(before + done, total)
