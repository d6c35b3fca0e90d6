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

import httpx2
import pytest

from service import problems
from service.files.blobs import BlobFolder
from service.problems import StoreError
from service.settings import ServiceSettings
from service.store import open_store
from service.store.files import InputRows
from tests.api.service import Service
from tests.raised import raises_problem
from tests.small_scenes import wall, write_files

TUS = {"Tus-Resumable": "1.0.0"}
#: User id without rights.
_NOBODY = 65534


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Run the API process; tests that kill it start it again."""
    with Service(tmp_path_factory.mktemp("service") / "data", alone=True) as running:
        yield running


def append(service: Service, where: str, offset: int, content: bytes, checksum: str = "") -> httpx2.Response:
    headers = {**TUS, "Upload-Offset": str(offset), "Content-Type": "application/offset+octet-stream"}
    headers |= {"Upload-Checksum": checksum} if checksum else {}
    return httpx2.patch(f"{service.url}{where}", content=content, headers=headers, timeout=60)


def begin(service: Service, content: bytes) -> str:
    """Create an upload with all bytes except the last one, and return its URL path."""
    headers = {**TUS, "Upload-Length": str(len(content))}
    where = str(httpx2.post(f"{service.url}/v1/uploads", headers=headers, timeout=60).headers["location"])
    assert append(service, where, 0, content[:-1]).status_code == 204
    return where


def write_the_end(service: Service, content: bytes, where: str, *, linked: bool) -> None:
    """Reproduce the state after the last byte was written; if `linked`, after the blob was created too."""
    settings = ServiceSettings(data=service.data, min_free_bytes=0)
    store = open_store(settings)
    blobs = BlobFolder(settings.folder, store.inputs, 0)
    upload_id = where.rsplit("/", 1)[1]
    part = blobs.upload_path(upload_id)
    part.write_bytes(content)
    store.inputs.advance_upload(upload_id, len(content) - 1, 1, 3600)
    if linked:
        blobs.add(part, link=True)
    store.close()


@pytest.mark.slow
def test_last_part_can_be_sent_again(service: Service) -> None:
    contents = {linked: os.urandom(10_000) for linked in (False, True)}
    places = {linked: begin(service, content) for linked, content in contents.items()}
    service.stop(signal.SIGKILL)
    for linked, content in contents.items():
        write_the_end(service, content, places[linked], linked=linked)
    service.start()
    for linked, content in contents.items():
        where, sha256 = places[linked], hashlib.sha256(content).hexdigest()
        assert httpx2.head(f"{service.url}{where}", headers=TUS).headers["upload-offset"] == str(len(content))
        assert append(service, where, len(content), b"").status_code == 204
        shown = httpx2.get(f"{service.url}{where}").json()
        assert (shown["complete"], shown["sha256"]) == (True, sha256)
    blobs = [path.read_bytes() for path in (service.data / "blobs").glob("*/*") if path.is_file()]
    assert [blobs.count(content) for content in contents.values()] == [1, 1]
    assert not any((service.data / "uploads").iterdir())


@pytest.mark.slow
def test_job_can_use_the_finished_upload_at_once(service: Service, tmp_path: Path) -> None:
    scene, _, style = write_files(tmp_path, wall())
    where = begin(service, scene.read_bytes())
    service.stop(signal.SIGKILL)
    write_the_end(service, scene.read_bytes(), where, linked=True)
    service.start()
    body = {"style": ("style.png", style.read_bytes())}
    data = {"scene": where.rsplit("/", 1)[1], "parameters": '{"orbit": 2}'}
    answer = httpx2.post(f"{service.url}/v1/jobs", files=body, data=data, timeout=60)
    assert answer.status_code == 202, answer.text
    assert httpx2.get(f"{service.url}{where}").json()["complete"]


def test_missing_bytes_are_not_read_as_zeros(service: Service) -> None:
    where = begin(service, os.urandom(10_000))
    part = service.data / "uploads" / f"{where.rsplit('/', 1)[1]}.part"
    part.unlink()
    answer = append(service, where, 9_999, b"x")
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
def blob_folder(tmp_path: Path) -> Iterator[tuple[InputRows, BlobFolder]]:
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
        with unprivileged(), raises_problem(problems.UPLOAD_LOCKED):
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
def test_digest_of_an_upload_in_parts_equals_that_of_its_file(service: Service, killed: bool) -> None:
    content = os.urandom(30_000)
    middle = len(content) // 2
    headers = {**TUS, "Upload-Length": str(len(content))}
    where = str(httpx2.post(f"{service.url}/v1/uploads", headers=headers, timeout=60).headers["location"])
    assert append(service, where, 0, content[:middle]).status_code == 204
    wrong = base64.b64encode(hashlib.sha256(b"another").digest()).decode()
    assert append(service, where, middle, bytes(100), f"sha256 {wrong}").status_code == 460
    if killed:  # the digest so far is lost
        service.stop(signal.SIGKILL)
        service.start()
    assert append(service, where, middle, content[middle:-1]).status_code == 204
    assert append(service, where, len(content) - 1, content[-1:]).status_code == 204
    shown = httpx2.get(f"{service.url}{where}").json()
    assert (shown["complete"], shown["sha256"]) == (True, hashlib.sha256(content).hexdigest())
