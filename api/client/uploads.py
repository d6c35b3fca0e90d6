"""Upload of a job's files: large ones in resumable parts, small ones in the job's own request."""

from __future__ import annotations

import base64
import hashlib
import secrets
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from api.client.answers import ApiError, RequestError
from api.client.inputs import InputFile, JobFiles, input_files
from api.client.transport import Progress, Transport, in_thread, json_text
from sgsst_core.files.formats import scene_path
from sgsst_core.files.formats.sog import INDEX_NAME, pack

#: Maximum bytes of a part; larger files are uploaded in parts.
PART_BYTES = 16 << 20
#: Protocol version of uploads, which every request must state.
_TUS = {"Tus-Resumable": "1.0.0"}


async def upload(transport: Transport, path: Path, name: str, progress: Progress) -> str:
    """Upload a file in parts, and return the upload's id."""
    size = (await in_thread(path.stat)).st_size
    creation = {
        **_TUS,
        "Upload-Length": str(size),
        "Upload-Metadata": f"filename {base64.b64encode(name.encode()).decode()}",
        "Idempotency-Key": secrets.token_hex(16),
    }
    created = (await transport.call("POST", "/v1/uploads", headers=creation)).json()
    where = f"/v1/uploads/{created['id']}"
    offset = int(created["offset"])
    while offset < size:
        part, headers = await in_thread(_read_part, path, offset)
        try:
            await transport.call("PATCH", where, content=part, headers=headers)
            offset += len(part)
        except ApiError as error:
            if error.status != 409:
                raise
            offset = int((await transport.call("HEAD", where, headers=_TUS)).headers["Upload-Offset"])
        progress(offset, size)
    return str(created["id"])


def _read_part(path: Path, offset: int) -> tuple[bytes, dict[str, str]]:
    """Return a part of a file, and the headers to send it with."""
    with path.open("rb") as file:
        file.seek(offset)
        part = file.read(PART_BYTES)
    if not part:
        raise RequestError(f"{path}: was truncated during the upload. Send it again.")
    digest = base64.b64encode(hashlib.sha256(part).digest()).decode()
    return part, {
        **_TUS,
        "Upload-Offset": str(offset),
        "Upload-Checksum": f"sha256 {digest}",
        "Content-Type": "application/offset+octet-stream",
    }


async def create_job(
    transport: Transport, files: JobFiles, parameters: Mapping[str, Any], webhook: Mapping[str, str], progress: Progress
) -> dict[str, Any]:
    """Submit a job, and return the service's response; see `AsyncClient.submit`."""
    fields = await _send_files(transport, files, parameters, progress)
    fields += [(name, (None, value)) for name, value in webhook.items()]
    headers = {"Idempotency-Key": secrets.token_hex(16)}
    created: dict[str, Any] = (await transport.call("POST", "/v1/jobs", files=fields, headers=headers)).json()
    return created


async def plan_job(
    transport: Transport, files: JobFiles, parameters: Mapping[str, Any], *, progress: Progress, planning: Progress
) -> dict[str, Any]:
    """Plan a job without queueing it; see `AsyncClient.plan`."""
    fields = await _send_files(transport, files, parameters, progress)
    return await transport.work("/v1/jobs", "planning", planning, params={"dry_run": True}, files=fields)


async def _send_files(
    transport: Transport, files: JobFiles, parameters: Mapping[str, Any], progress: Progress
) -> list[tuple[str, Any]]:
    """Upload the large files, and return the form fields of the request, which contain the small files and the URLs."""
    given = json_text({name: value for name, value in parameters.items() if value is not None})
    with tempfile.TemporaryDirectory() as folder:
        inputs = await in_thread(input_files, replace(files, scene=await in_thread(_packed, files.scene, Path(folder))))
        fields = await _sent(transport, inputs, progress)
    return [*fields, ("parameters", (None, given))]


def _packed(scene: Path | str, folder: Path) -> Path | str:
    """Return the scene, in an archive in `folder` if it is an unpacked streamed SOG."""
    index = scene_path(scene) if isinstance(scene, Path) else None
    if index is None or index.name != INDEX_NAME or not index.is_file():
        return scene
    archive = folder / f"{index.absolute().parent.name or 'scene'}.zip"
    pack(index, archive)
    return archive


async def _sent(transport: Transport, inputs: Sequence[InputFile], progress: Progress) -> list[tuple[str, Any]]:
    """Upload the large files, and return the form fields of all."""
    total = sum(file.size for file in inputs if file.size > PART_BYTES)
    done = 0
    fields: list[tuple[str, Any]] = []
    for file in inputs:
        if isinstance(file.source, str):
            fields.append((file.role, (None, file.source)))
        elif file.size > PART_BYTES:
            upload_id = await upload(transport, file.source, file.name, partial(_report_sum, progress, done, total))
            fields.append((file.role, (None, upload_id)))
            done += file.size
        else:
            content = await in_thread(file.source.read_bytes)
            fields.append((file.role, (file.name, content, "application/octet-stream")))
    return fields


def _report_sum(progress: Progress, before: int, total: int, done: int, _size: int) -> None:
    """Report the progress of one file as part of the progress of all files."""
    progress(before + done, total)
