"""Tests of files in a local folder and in an S3-compatible bucket, and of the cache of stored files."""

import errno
import hashlib
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import httpx2
import pytest

from service.files.objects import Artifacts, FileCache, ObjectStore
from service.problems import DamagedFileError, NoSpaceError, StoreError
from tests.api.service import Service, submit, undisturbed
from tests.service.files.s3 import environment_of
from tests.small_scenes import input_files


@pytest.fixture(params=["file", "memory"])
def artifacts(request: pytest.FixtureRequest, tmp_path: Path) -> Artifacts:
    return Artifacts(f"file://{tmp_path / 'results'}" if request.param == "file" else f"memory://{tmp_path}")


def test_artifact_is_read_completely_and_in_ranges(artifacts: Artifacts, tmp_path: Path) -> None:
    source = tmp_path / "stylized.ply"
    source.write_bytes(bytes(range(256)) * 9000)
    put = artifacts.put("job_1", 1, "previews/x.jpg", source)
    assert put.size == source.stat().st_size
    assert b"".join(artifacts.objects.read(put.location, 0, put.size)) == source.read_bytes()
    assert b"".join(artifacts.objects.read(put.location, 255, 258)) == b"\xff\x00\x01"
    artifacts.fetch(put.location, tmp_path / "back", put.sha256)
    assert (tmp_path / "back").read_bytes() == source.read_bytes()
    with pytest.raises(FileNotFoundError, match="shorter"):
        list(artifacts.objects.read(put.location, 0, put.size + 1))


def test_final_file_is_linked_and_others_are_copied(artifacts: Artifacts, tmp_path: Path) -> None:
    source = tmp_path / "checkpoint"
    source.write_bytes(b"first")
    put = artifacts.put("job_1", 1, ".checkpoint", source, final=True)
    assert source.stat().st_nlink == (2 if artifacts.objects.local else 1)
    later = tmp_path / "later"
    later.write_bytes(b"second")
    later.replace(source)
    assert b"".join(artifacts.objects.read(put.location, 0, put.size)) == b"first"
    assert put.sha256 == hashlib.sha256(b"first").hexdigest()


def test_final_file_is_copied_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(source: object, target: object) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    monkeypatch.setattr("service.files.objects.os.link", refuse)
    source = tmp_path / "stylized.ply"
    source.write_bytes(bytes(3_000_000))
    put = Artifacts(f"file://{tmp_path / 'results'}").put("job_1", 1, "stylized.ply", source, final=True)
    assert (tmp_path / "results" / put.location).read_bytes() == source.read_bytes()
    with pytest.raises(FileNotFoundError):
        Artifacts(f"file://{tmp_path / 'results'}").put("job_1", 1, "stylized.ply", tmp_path / "none", final=True)


def test_objects_are_removed_by_name_and_by_folder(artifacts: Artifacts, tmp_path: Path) -> None:
    source = tmp_path / "plan.json"
    source.write_bytes(b"{}")
    old, new = (artifacts.put("job_1", epoch, "plan.json", source) for epoch in (1, 2))
    other = artifacts.put("job_2", 1, "plan.json", source)
    artifacts.objects.remove(old.location)
    assert b"".join(artifacts.objects.read(new.location, 0, 2)) == b"{}"
    with pytest.raises(FileNotFoundError):
        list(artifacts.objects.read(old.location, 0, 2))
    artifacts.objects.remove_below("job_1")
    artifacts.objects.remove_below("job_1")
    artifacts.objects.remove(new.location)
    assert b"".join(artifacts.objects.read(other.location, 0, 2)) == b"{}"


def content(number: int, size: int = 1000) -> tuple[bytes, str]:
    data = bytes([number]) * size
    return data, hashlib.sha256(data).hexdigest()


class Source:
    """Source of a file, with a counter of fetches."""

    def __init__(self, data: bytes) -> None:
        self.data, self.fetched = data, 0

    def __call__(self, target: Path) -> None:
        self.fetched += 1
        target.write_bytes(self.data)


def files(folder: Path) -> set[str]:
    return {path.name for path in (folder / "cache" / "files").glob("*/*")}


@pytest.fixture
def cache(tmp_path: Path) -> FileCache:
    return FileCache(tmp_path / "cache", 2500)


def test_file_is_fetched_once(cache: FileCache, tmp_path: Path) -> None:
    data, sha256 = content(1)
    source = Source(data)
    for name in ("a", "b"):
        cache.link(sha256, len(data), tmp_path / name, source)
        assert (tmp_path / name).read_bytes() == data
        assert not os.access(tmp_path / name, os.W_OK) or os.geteuid() == 0
    assert source.fetched == 1
    assert (tmp_path / "a").stat().st_mtime == int(sha256[:8], 16), "its time tells of its content alone"


def test_least_recently_used_files_are_evicted_unless_in_use(cache: FileCache, tmp_path: Path) -> None:
    paths = [content(number) for number in range(5)]
    for number in (0, 1):
        cache.link(paths[number][1], 1000, tmp_path / str(number), Source(paths[number][0]))
    (tmp_path / "0").unlink()
    (tmp_path / "1").unlink()
    again = Source(paths[0][0])
    cache.link(paths[0][1], 1000, tmp_path / "0", again)  # used again and released, so the other one is now older
    (tmp_path / "0").unlink()
    assert again.fetched == 0
    cache.link(paths[2][1], 1000, tmp_path / "2", Source(paths[2][0]))
    assert files(tmp_path) == {paths[0][1], paths[2][1]}
    cache.link(paths[3][1], 1000, tmp_path / "3", Source(paths[3][0]))
    cache.link(paths[4][1], 1000, tmp_path / "4", Source(paths[4][0]))
    assert files(tmp_path) == {paths[number][1] for number in (2, 3, 4)}, "all of them are in use"
    (tmp_path / "2").unlink()
    cache.evict()
    assert files(tmp_path) == {paths[3][1], paths[4][1]}


def test_damaged_object_is_not_cached(cache: FileCache, tmp_path: Path) -> None:
    _, sha256 = content(1)
    with pytest.raises(DamagedFileError):
        cache.link(sha256, 1000, tmp_path / "a", Source(b"another"))
    assert not (tmp_path / "a").exists()
    assert files(tmp_path) == set()
    assert list((tmp_path / "cache" / "half").iterdir()) == []


def test_damaged_cache_entry_is_fetched_again(cache: FileCache, tmp_path: Path) -> None:
    data, sha256 = content(1)
    source = Source(data)
    cache.link(sha256, len(data), tmp_path / "a", source)
    (tmp_path / "a").chmod(0o600)
    (tmp_path / "a").write_bytes(data[:-1] + b"x")
    cache.link(sha256, len(data), tmp_path / "b", source)
    assert ((tmp_path / "b").read_bytes(), source.fetched) == (data, 2)


def test_full_disk_evicts_unused_files(cache: FileCache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    old, old_sha256 = content(1)
    cache.link(old_sha256, 1000, tmp_path / "old", Source(old))
    (tmp_path / "old").unlink()
    data, sha256 = content(2)

    def usage(_: Path) -> SimpleNamespace:
        return SimpleNamespace(free=1000 - 1000 * len(files(tmp_path)))

    monkeypatch.setattr("service.files.objects.shutil.disk_usage", usage)
    cache.link(sha256, 1000, tmp_path / "new", Source(data))
    assert (tmp_path / "new").read_bytes() == data
    assert files(tmp_path) == {sha256}


def test_full_disk_is_not_a_fault_of_the_store(remote: Artifacts, tmp_path: Path) -> None:
    put = remote.put("job_1", 1, "plan.json", write(tmp_path, 10))
    with pytest.raises(NoSpaceError):
        remote.objects.get(put.location, Path("/dev/full"))


def test_adopted_file_is_not_copied(cache: FileCache, tmp_path: Path) -> None:
    data, sha256 = content(1)
    for name in ("first", "second"):
        (tmp_path / name).write_bytes(data)
        adopted = (tmp_path / name).stat().st_ino
        cache.adopt(tmp_path / name, sha256)
        assert not (tmp_path / name).exists()
    source = Source(data)
    cache.link(sha256, 1000, tmp_path / "a", source)
    assert ((tmp_path / "a").stat().st_ino, source.fetched) == (adopted, 0)


def _use(folder: str, number: int) -> None:
    """Repeatedly link, read and release five files in a cache that has space for two."""
    cache = FileCache(Path(folder) / "cache", 2500)
    for turn in range(40):
        data, sha256 = content((number + turn) % 5)
        target = Path(folder) / f"{number}-{turn}"

        def fetch(half: Path, data: bytes = data) -> None:
            with half.open("wb") as file:
                file.write(data[:500])
                file.flush()
                time.sleep(0.001)
                file.write(data[500:])

        cache.link(sha256, 1000, target, fetch)
        assert target.read_bytes() == data
        target.unlink()


@pytest.mark.slow
def test_processes_share_the_cache(cache: FileCache, tmp_path: Path) -> None:
    spawned = multiprocessing.get_context("spawn")
    processes = [spawned.Process(target=_use, args=(str(tmp_path), number)) for number in range(3)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    assert [process.exitcode for process in processes] == [0, 0, 0]
    cache.evict()
    assert len(files(tmp_path)) <= 2
    assert list((tmp_path / "cache" / "half").iterdir()) == []


#: More bytes than one part of a multipart upload, and not a round number.
SIZE = 6 * (1 << 20) + 17


@pytest.fixture(scope="module")
def environment(s3_url: str) -> Iterator[dict[str, str]]:
    """Create a bucket named `results`, and set and yield the environment variables of S3 clients."""
    values = environment_of(s3_url)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in values.items():
            patch.setenv(name, value)
        assert httpx2.put(f"{s3_url}/results").status_code == 200
        yield values


@pytest.fixture
def prefix() -> str:
    return os.urandom(4).hex()


@pytest.fixture
def remote(environment: dict[str, str], prefix: str) -> Artifacts:
    return Artifacts(f"s3://results/{prefix}")


def write(folder: Path, size: int = SIZE) -> Path:
    path = folder / "file"
    path.write_bytes(os.urandom(size))
    return path


def test_object_names_are_never_reused(remote: Artifacts, tmp_path: Path) -> None:
    first = remote.put("job_1", 1, "plan.json", write(tmp_path, 10))
    second = remote.put("job_1", 1, "plan.json", write(tmp_path, 11))
    assert first.location != second.location
    assert len(b"".join(remote.objects.read(first.location, 0, 10))) == 10


def test_later_objects_are_visible_to_other_processes(
    remote: Artifacts, environment: dict[str, str], prefix: str, tmp_path: Path
) -> None:
    """fsspec caches folder listings, but files that other processes have just added must be found."""
    source = write(tmp_path, 10)
    first = remote.put("job_1", 1, "plan.json", source)
    assert list(remote.objects.below("job_1")) == [first.location]
    late = f"{environment['AWS_ENDPOINT_URL']}/results/{prefix}/job_1/2/x/late"
    assert httpx2.put(late, content=b"0123456789").status_code == 200
    assert b"".join(remote.objects.read("job_1/2/x/late", 0, 10)) == b"0123456789"
    assert set(remote.objects.below("job_1")) == {first.location, "job_1/2/x/late"}


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
    files = input_files(tmp_path)
    parameters = {"preset": "standard", "steps_sos": 4, "backbone": "vgg16", "early_stop": False, "seed": 1}
    expected = undisturbed(files, parameters, tmp_path).read_bytes()
    shared = {"SGSST_ARTIFACTS": "s3://results/service", "SGSST_DATABASE": f"sqlite:///{tmp_path / 'shared.db'}"}
    with (
        Service(tmp_path / "api", alone=True, **shared) as service,
        dispatcher(tmp_path / "dispatcher", service.environment),
        service.client() as client,
    ):
        where = f"/v1/jobs/{submit(client, files, **parameters)}"
        service.succeeded(where.rpartition("/")[2])
        result = client.get(f"{where}/artifacts/stylized.ply")
        assert result.content == expected
        tail = client.get(f"{where}/artifacts/stylized.ply", headers={"Range": "bytes=-100"})
        assert (tail.status_code, tail.content) == (206, expected[-100:])
        for folder in (service.data, tmp_path / "dispatcher"):
            assert not (folder / "remote").exists()
            assert not (folder / "blobs").exists(), "inputs are in the bucket, too"
            assert len(list((folder / "cache" / "files").glob("*/*"))) == 3
        assert client.delete(where).status_code == 204
        assert client.get(f"{where}/artifacts/stylized.ply").status_code == 404
    listing = httpx2.get(f"{environment['AWS_ENDPOINT_URL']}/results", params={"prefix": "service/job_"})
    assert "<Key>" not in listing.text
