"""Tests of stored files that were lost or corrupted: they are neither sent nor used, and a new upload restores them."""

import stat
from collections.abc import Iterator
from pathlib import Path

import httpx2
import pytest

from service.store import Store
from tests.api.service import Service, check_documented, submit


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    data = tmp_path_factory.mktemp("damage") / "data"
    data.mkdir()
    data.chmod(0o755)  # as an earlier version created it
    with Service(data, alone=True) as running:
        yield running


def flip(path: Path) -> None:
    """Flip one bit of a file in place."""
    path.chmod(0o600)
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


def refused(answer: httpx2.Response, code: str) -> None:
    assert (answer.status_code, answer.json()["code"]) == (500, code), answer.text
    check_documented(answer)
    assert "etag" not in answer.headers


def blob_of(service: Service, store: Store, job_id: str, role: str) -> Path:
    (sha256,) = (entry["sha256"] for entry in store.jobs.inputs(job_id) if entry["role"] == role)
    return service.data / "blobs" / store.inputs.blobs([sha256])[sha256].location


def test_damaged_result_is_not_sent(
    service: Service, store: Store, client: httpx2.Client, paths: dict[str, Path]
) -> None:
    job_id = submit(client, paths)
    service.finish(job_id, {"plan.json": b'{"a": 1}' * 1000})
    path = service.data / "artifacts" / store.jobs.artifacts(job_id)[0].location
    where = f"/v1/jobs/{job_id}/artifacts/plan.json"
    sent = client.get(where)
    assert (sent.status_code, sent.content) == (200, b'{"a": 1}' * 1000)
    flip(path)
    logged = service.log.stat().st_size
    for headers in ({}, {"Range": "bytes=0-9"}, {"Range": "bytes=10-", "If-Range": sent.headers["etag"]}):
        refused(client.get(where, headers=headers), "file-damaged")
    assert f"/{path.name} sha256=" in service.log.read_text()[logged:]
    path.unlink()
    refused(client.get(where), "file-lost")


@pytest.mark.parametrize("lost", [True, False])
def test_uploading_again_restores_lost_file(
    service: Service, store: Store, client: httpx2.Client, paths: dict[str, Path], lost: bool
) -> None:
    job_id = submit(client, paths)
    path, where = blob_of(service, store, job_id, "scene"), f"/v1/jobs/{job_id}/inputs/scene"
    assert client.get(where).content == paths["scene"].read_bytes()
    if lost:
        path.unlink()
    else:
        flip(path)
    refused(client.get(where), "file-lost" if lost else "file-damaged")
    again = submit(client, paths)
    assert client.get(where).content == paths["scene"].read_bytes()
    assert blob_of(service, store, again, "scene") == path


def test_data_folder_is_private(service: Service, client: httpx2.Client, paths: dict[str, Path]) -> None:
    submit(client, paths)
    assert stat.S_IMODE(service.data.stat().st_mode) == 0o700
    # Folders below that of the results belong to the process of this test.
    own = {path: status for path, status in service.stored().items() if "artifacts" not in path.parts[:-1]}
    assert {"sgsst.db", "sgsst.db-wal", "artifacts"} <= {path.name for path in own}
    assert not [path for path, status in own.items() if status.st_mode & 0o077]
