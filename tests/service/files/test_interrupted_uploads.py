"""Tests of uploads whose API process was killed after writing the last byte, but before updating the database."""

from __future__ import annotations

import base64
import hashlib
import os
import signal
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from service.errors import LockedError, StoreError
from service.files.blobs import BlobFolder
from service.settings import ServiceSettings
from service.store import open_store
from service.store.inputs import Inputs
from tests.api.service import Service
from tests.small_scenes import wall, write_files

TUS = {"Tus-Resumable": "1.0.0"}
#: User id without rights.
_NOBODY = 65534


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    ply, cameras, style = write_files(tmp_path_factory.mktemp("inputs"), wall())
    return {"scene": ply, "cameras": cameras, "style": style}


def append(service: Service, where: str, offset: int, content: bytes, checksum: str = "") -> httpx.Response:
    headers = {**TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}
    headers |= {"Upload-Checksum": checksum} if checksum else {}
    return httpx.patch(f"{service.url}{where}", content=content, headers=headers, timeout=60)


def begin(service: Service, path: Path) -> str:
    """Create an upload with all bytes except the last one, and return its URL path."""
    content = path.read_bytes()
    headers = {**TUS, "Upload-Length": str(len(content))}
    where = str(httpx.post(f"{service.url}/v1/uploads", headers=headers, timeout=60).headers["location"])
    assert append(service, where, 0, content[:-1]).status_code == 204
    return where


def die_at_the_end(service: Service, path: Path, where: str, *, linked: bool) -> None:
    """Reproduce the state after the last byte was written; if `linked`, after the blob was created too."""
    service.stop(signal.SIGKILL)
    settings = ServiceSettings(data=service.data, min_free_bytes=0)
    store = open_store(settings)
    blobs = BlobFolder(settings.folder, store.inputs, 0)
    upload_id, content = where.rsplit("/", 1)[1], path.read_bytes()
    part = blobs.upload_path(upload_id)
    part.write_bytes(content)
    store.inputs.advance_upload(upload_id, len(content) - 1, 1, 3600)
    if linked:
        blobs.add(part, link=True)
    store.close()


@pytest.mark.parametrize("linked", [False, True])
def test_last_part_can_be_sent_again(files: dict[str, Path], tmp_path: Path, linked: bool) -> None:
    content = files["scene"].read_bytes()
    with Service(tmp_path / "data", alone=True) as service:
        where = begin(service, files["scene"])
        die_at_the_end(service, files["scene"], where, linked=linked)
        service.start()
        assert httpx.head(f"{service.url}{where}", headers=TUS).headers["upload-offset"] == str(len(content))
        assert append(service, where, len(content), b"").status_code == 204
        shown = httpx.get(f"{service.url}{where}").json()
        assert (shown["complete"], shown["sha256"]) == (True, hashlib.sha256(content).hexdigest())
        blobs = [path for path in (service.data / "blobs").glob("*/*") if path.is_file()]
        assert [path.read_bytes() for path in blobs] == [content]
        assert not any((service.data / "uploads").iterdir())


@pytest.mark.slow
def test_job_can_use_the_finished_upload_at_once(files: dict[str, Path], tmp_path: Path) -> None:
    with Service(tmp_path / "data", alone=True) as service:
        where = begin(service, files["scene"])
        die_at_the_end(service, files["scene"], where, linked=True)
        service.start()
        body = {"style": ("style.png", files["style"].read_bytes())}
        data = {"scene": where.rsplit("/", 1)[1], "parameters": '{"orbit": 2}'}
        answer = httpx.post(f"{service.url}/v1/jobs", files=body, data=data, timeout=60)
        assert answer.status_code == 202, answer.text
        assert httpx.get(f"{service.url}{where}").json()["complete"]


def test_missing_bytes_are_not_read_as_zeros(files: dict[str, Path], tmp_path: Path) -> None:
    with Service(tmp_path / "data", alone=True) as service:
        where = begin(service, files["scene"])
        part = service.data / "uploads" / f"{where.rsplit('/', 1)[1]}.part"
        part.unlink()
        answer = append(service, where, files["scene"].stat().st_size - 1, b"x")
        assert (answer.status_code, answer.json()["code"]) == (404, "not-found")


@contextmanager
def unprivileged() -> Iterator[None]:
    """Run the block without the rights of root, which may write to read-only files."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(_NOBODY)
    try:
        yield
    finally:
        os.seteuid(user)


@contextmanager
def blob_folder(tmp_path: Path) -> Iterator[tuple[Inputs, BlobFolder]]:
    """Yield a database and a store of inputs, in which another user may read."""
    store = open_store(ServiceSettings(data=tmp_path))
    with tempfile.TemporaryDirectory() as folder:  # other users may not enter `tmp_path`
        Path(folder).chmod(0o755)
        yield store.inputs, BlobFolder(Path(folder), store.inputs, 0)
    store.close()


def test_upload_that_becomes_a_blob_is_locked(tmp_path: Path) -> None:
    with blob_folder(tmp_path) as (inputs, blobs):
        row = inputs.create_upload("me", 5, "scene.ply", "", 3600)
        blobs.start_upload(row.id)
        blobs.upload_path(row.id).chmod(0o400)
        inputs.advance_upload(row.id, 0, 5, 3600)
        with unprivileged(), pytest.raises(LockedError):
            blobs.append(row, 3600)


def test_missing_write_permission_is_a_failure_of_the_store(tmp_path: Path) -> None:
    with blob_folder(tmp_path) as (inputs, blobs):
        row = inputs.create_upload("me", 5, "scene.ply", "", 3600)
        blobs.start_upload(row.id)
        received = blobs.receive(10)
        received.close()
        with unprivileged():
            for write in (
                lambda: blobs.append(row, 3600),
                lambda: blobs.start_upload("upl_1"),
                lambda: blobs.receive(10),
                lambda: blobs.add(received.path),
            ):
                with pytest.raises(StoreError, match="cannot write the file: "):
                    write()


@pytest.mark.parametrize("killed", [False, True])
def test_digest_of_an_upload_in_parts_equals_that_of_its_file(
    files: dict[str, Path], tmp_path: Path, killed: bool
) -> None:
    content = files["scene"].read_bytes()
    middle = len(content) // 2
    with Service(tmp_path / "data", alone=True) as service:
        headers = {**TUS, "Upload-Length": str(len(content))}
        where = str(httpx.post(f"{service.url}/v1/uploads", headers=headers, timeout=60).headers["location"])
        assert append(service, where, 0, content[:middle]).status_code == 204
        wrong = base64.b64encode(hashlib.sha256(b"another").digest()).decode()
        assert append(service, where, middle, bytes(100), f"sha256 {wrong}").status_code == 460
        if killed:  # the digest so far is lost
            service.stop(signal.SIGKILL)
            service.start()
        assert append(service, where, middle, content[middle:-1]).status_code == 204
        assert append(service, where, len(content) - 1, content[-1:]).status_code == 204
        shown = httpx.get(f"{service.url}{where}").json()
        assert (shown["complete"], shown["sha256"]) == (True, hashlib.sha256(content).hexdigest())
