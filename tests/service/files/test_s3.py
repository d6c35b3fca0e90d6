"""Tests of results in an S3-compatible bucket, with moto's server over HTTP."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx2
import pytest

from service.files.objects import Artifacts, ObjectStore
from service.problems import StoreError
from tests.api.service import Service, undisturbed, wait_for
from tests.service.files.s3 import environment_of, s3_server
from tests.small_scenes import wall, write_files

#: More bytes than one part of a multipart upload, and not a round number.
SIZE = 6 * (1 << 20) + 17


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    with s3_server() as url:
        yield url


@pytest.fixture(scope="module")
def environment(endpoint: str) -> Iterator[dict[str, str]]:
    """Create a bucket named `results`, and set and yield the environment variables of S3 clients."""
    values = environment_of(endpoint)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            patch.setenv(name, value)
        assert httpx2.put(f"{endpoint}/results").status_code == 200
        yield values


@pytest.fixture
def prefix() -> str:
    return os.urandom(4).hex()


@pytest.fixture
def artifacts(environment: dict[str, str], prefix: str) -> Artifacts:
    return Artifacts(f"s3://results/{prefix}")


def write(folder: Path, size: int = SIZE) -> Path:
    path = folder / "file"
    path.write_bytes(os.urandom(size))
    return path


def test_stored_object_is_read_and_fetched(artifacts: Artifacts, tmp_path: Path) -> None:
    source = write(tmp_path)
    content = source.read_bytes()
    put = artifacts.put("job_1", 3, "previews/step_1.jpg", source)
    assert (put.name, put.size, put.sha256) == ("previews/step_1.jpg", SIZE, hashlib.sha256(content).hexdigest())
    assert not artifacts.local
    assert b"".join(artifacts.objects.read(put.location, 0, SIZE)) == content
    assert b"".join(artifacts.objects.read(put.location, SIZE - 5, SIZE)) == content[-5:]
    assert b"".join(artifacts.objects.read(put.location, 5_000_000, 5_300_000)) == content[5_000_000:5_300_000]
    artifacts.fetch(put.location, tmp_path / "fetched", put.sha256)
    assert (tmp_path / "fetched").read_bytes() == content
    with pytest.raises(OSError, match="shorter"):
        list(artifacts.objects.read(put.location, 0, SIZE + 1))


def test_object_names_are_never_reused(artifacts: Artifacts, tmp_path: Path) -> None:
    first = artifacts.put("job_1", 1, "plan.json", write(tmp_path, 10))
    second = artifacts.put("job_1", 1, "plan.json", write(tmp_path, 11))
    assert first.location != second.location
    assert len(b"".join(artifacts.objects.read(first.location, 0, 10))) == 10


def test_objects_without_rows_are_swept(artifacts: Artifacts, tmp_path: Path) -> None:
    source = write(tmp_path, 10)
    referenced, lost = (artifacts.put("job_1", epoch, "stylized.ply", source) for epoch in (2, 1))
    other = artifacts.put("job_10", 1, "stylized.ply", source)
    artifacts.sweep("job_1", 9, {referenced.location})
    assert b"".join(artifacts.objects.read(referenced.location, 0, 10)) == source.read_bytes()
    with pytest.raises(FileNotFoundError):
        list(artifacts.objects.read(lost.location, 0, 10))
    artifacts.objects.remove_below("job_1")
    with pytest.raises(FileNotFoundError):
        list(artifacts.objects.read(referenced.location, 0, 10))
    assert b"".join(artifacts.objects.read(other.location, 0, 10)) == source.read_bytes()
    artifacts.objects.remove(referenced.location)
    artifacts.objects.remove_below("job_1")


def test_later_objects_are_visible_to_other_processes(
    artifacts: Artifacts, environment: dict[str, str], prefix: str, tmp_path: Path
) -> None:
    """fsspec caches folder listings, but files that other processes have just added must be found."""
    source = write(tmp_path, 10)
    first = artifacts.put("job_1", 1, "plan.json", source)
    artifacts.sweep("job_1", 9, {first.location})
    late = f"{environment['AWS_ENDPOINT_URL']}/results/{prefix}/job_1/2/x/late"
    assert httpx2.put(late, content=b"0123456789").status_code == 200
    assert b"".join(artifacts.objects.read("job_1/2/x/late", 0, 10)) == b"0123456789"
    artifacts.sweep("job_1", 9, {first.location})
    assert httpx2.head(late).status_code == 404


def test_missing_bucket_is_an_outage_and_no_lost_file(environment: dict[str, str]) -> None:
    objects = ObjectStore("s3://nowhere/x")
    for use in (objects.ping, lambda: objects.size("a")):
        with pytest.raises(StoreError):
            use()


@contextmanager
def dispatcher(data: Path, environment: dict[str, str]) -> Iterator[None]:
    """Run a dispatcher with a separate data folder."""
    command = [sys.executable, "-m", "service.scheduling.dispatcher"]
    with data.with_suffix(".log").open("ab") as log:
        process = subprocess.Popen(command, env={**environment, "SGSST_DATA": str(data)}, stdout=log, stderr=log)
    try:
        yield
    finally:
        process.terminate()
        process.wait(120)


@pytest.mark.slow
def test_api_and_dispatcher_share_a_bucket_and_no_folder(
    environment: dict[str, str], tmp_path: Path, tiny_installed: Path
) -> None:
    ply, cameras, style = write_files(tmp_path, wall())
    files = {"scene": ply, "cameras": cameras, "style": style}
    parameters = {"preset": "standard", "steps_sos": 4, "backbone": "vgg16", "early_stop": False, "seed": 1}
    expected = undisturbed(files, parameters, tmp_path).read_bytes()
    shared = {"SGSST_ARTIFACTS": "s3://results/service", "SGSST_DATABASE": f"sqlite:///{tmp_path / 'shared.db'}"}
    with (
        Service(tmp_path / "api", alone=True, **shared) as service,
        dispatcher(tmp_path / "dispatcher", service.environment),
        service.client() as client,
    ):
        body = {role: (path.name, path.read_bytes()) for role, path in files.items()}
        answer = client.post("/v1/jobs", files=body, data={"parameters": json.dumps(parameters)})
        assert answer.status_code == 202, answer.text
        where = f"/v1/jobs/{answer.json()['id']}"

        def ended() -> bool:
            return client.get(where).json()["status"] in ("succeeded", "failed")

        wait_for(ended, "the job's end", service.said)
        job = client.get(where).json()
        assert job["status"] == "succeeded", job["error"]
        result = client.get(f"{where}/artifacts/stylized.ply")
        assert result.content == expected
        tail = client.get(f"{where}/artifacts/stylized.ply", headers={"Range": "bytes=-100"})
        assert (tail.status_code, tail.content) == (206, expected[-100:])
        for folder in (service.data, tmp_path / "dispatcher"):
            assert not (folder / "artifacts").exists()
            assert not (folder / "blobs").exists(), "inputs are in the bucket, too"
            assert len(list((folder / "cache" / "files").glob("*/*"))) == 3
        assert client.delete(where).status_code == 204
        assert client.get(f"{where}/artifacts/stylized.ply").status_code == 404
    listing = httpx2.get(f"{environment['AWS_ENDPOINT_URL']}/results", params={"prefix": "service/job_"})
    assert "<Key>" not in listing.text


@pytest.mark.slow
def test_parts_of_an_upload_go_to_any_api_process(environment: dict[str, str], tmp_path: Path) -> None:
    shared = {"SGSST_ARTIFACTS": "s3://results/uploads", "SGSST_DATABASE": f"sqlite:///{tmp_path / 'shared.db'}"}
    content = os.urandom(SIZE + 1000)
    tus = {"Tus-Resumable": "1.0.0", "Content-Type": "application/offset+octet-stream"}
    with (
        Service(tmp_path / "one", alone=True, **shared) as one,
        Service(tmp_path / "two", alone=True, **shared) as two,
        one.client() as first,
        two.client() as second,
    ):
        where = first.post("/v1/uploads", headers={**tus, "Upload-Length": str(len(content))}).headers["location"]

        def send(client: httpx2.Client, start: int, stop: int) -> httpx2.Response:
            return client.patch(where, content=content[start:stop], headers={**tus, "Upload-Offset": str(start)})

        assert send(first, 0, SIZE).status_code == 204
        assert second.head(where, headers=tus).headers["upload-offset"] == str(SIZE)
        assert send(first, 0, 10).status_code == 409
        assert send(second, SIZE, SIZE + 100).status_code == 204
        assert send(first, SIZE + 100, len(content)).status_code == 204
        for client in (first, second):
            shown = client.get(where).json()
            assert (shown["complete"], shown["sha256"]) == (True, hashlib.sha256(content).hexdigest())
        listing = httpx2.get(f"{environment['AWS_ENDPOINT_URL']}/results", params={"prefix": "uploads/"}).text
        assert listing.count("<Key>") == 1
        assert "<Key>uploads/blobs/" in listing
        given_up = first.post("/v1/uploads", headers={**tus, "Upload-Length": "100"}).headers["location"]
        headers = {**tus, "Upload-Offset": "0"}
        assert first.patch(given_up, content=bytes(60), headers=headers).status_code == 204
        assert second.delete(given_up, headers=tus).status_code == 204
        assert first.get(given_up).status_code == 404
        listing = httpx2.get(f"{environment['AWS_ENDPOINT_URL']}/results", params={"prefix": "uploads/"}).text
        assert listing.count("<Key>") == 1
