"""Tests of input files: shared by hosts in a failing S3-compatible store, and uploads whose API process was killed."""

import base64
import hashlib
import os
import signal
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import httpx2
import pytest

from service import problems
from service.files.blobs import BlobFolder, Receiver, StoredBlobs, write_all
from service.files.objects import Artifacts, ObjectStore
from service.problems import ConflictError, DamagedFileError, LostFileError, NoSpaceError, NotFoundError, StoreError
from service.scheduling.housekeeping import clean_up, remove_orphans
from service.settings import ServiceSettings
from service.store import Store, open_store
from service.store.files import InputRows
from service.store.tables import BlobRow, UploadRow
from tests.api.http.sending import TUS, begin, refused, send
from tests.api.service import Service
from tests.raised import raises_problem
from tests.service.files.s3 import Fault, FaultyS3, environment_of
from tests.stores import new_store

MB = 1 << 20
HOUR = 3600.0


@contextmanager
def local_files(host: StoredBlobs, rows: Mapping[str, BlobRow]) -> Iterator[dict[str, Path]]:
    """Provide blobs as local files within the block."""
    with tempfile.TemporaryDirectory(dir=host.incoming) as folder:
        yield host.fetch(rows, Path(folder))


@dataclass
class Fleet:
    """Several hosts that share a database and a file store with injected faults."""

    folder: Path
    store: Store
    url: str
    s3: FaultyS3
    objects: ObjectStore

    def host(self, name: str) -> StoredBlobs:
        settings = ServiceSettings(data=self.folder / name, min_free_bytes=0, artifacts=self.url)
        return StoredBlobs(settings, self.store.inputs, self.objects)

    def names(self) -> list[str]:
        """Return the names of all objects in the file store."""
        return sorted(self.objects.below(""))

    def take(self, host: StoredBlobs, data: bytes) -> str:
        """Store a file through a host."""
        receiver = Receiver(host.incoming / os.urandom(4).hex(), len(data), lambda size: None)
        receiver.write(data)
        receiver.close()
        return host.add(receiver.path)

    def read(self, host: StoredBlobs, sha256: str) -> bytes:
        with local_files(host, self.store.inputs.blobs([sha256])) as paths:
            return paths[sha256].read_bytes()

    def upload(self, length: int) -> UploadRow:
        return self.store.inputs.create_upload("me", length, "scene.ply", "", HOUR)

    def again(self, upload: UploadRow) -> UploadRow:
        """Return the current database row of an upload."""
        return self.store.inputs.upload(upload.id, "me")

    def append(self, host: StoredBlobs, upload: UploadRow, *blocks: bytes) -> None:
        writer = host.append(self.again(upload), HOUR)
        for block in blocks:
            writer.write(block)
        writer.save()
        writer.close()


@pytest.fixture
def fleet(s3_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Fleet]:
    url = f"s3://inputs/{os.urandom(4).hex()}"
    assert httpx2.put(f"{s3_url}/inputs").status_code == 200
    with FaultyS3(s3_url) as s3, closing(new_store(ServiceSettings(data=tmp_path / "database"))) as store:
        for name, value in environment_of(s3.origin).items():
            monkeypatch.setenv(name, value)
        yield Fleet(tmp_path, store, url, s3, Artifacts(url).objects)
        s3.heal()


def test_blob_of_one_host_is_read_on_another(fleet: Fleet) -> None:
    one, two = fleet.host("one"), fleet.host("two")
    data = os.urandom(3 * MB + 1)
    sha256 = fleet.take(one, data)
    assert list(one.incoming.iterdir()) == []
    assert fleet.take(two, data) == sha256
    assert len(fleet.names()) == 1, "the same content is there once"
    third = fleet.host("three")
    asked = len(fleet.s3.asked)
    assert fleet.read(one, sha256) == fleet.read(two, sha256) == data
    assert len(fleet.s3.asked) == asked, "who has taken it in does not fetch it"
    assert fleet.read(third, sha256) == data
    asked = len(fleet.s3.asked)
    assert fleet.read(third, sha256) == data
    assert len(fleet.s3.asked) == asked


@pytest.mark.parametrize(("lost", "size"), [(True, 6 * MB), (False, 100)])
def test_uploading_again_repairs_a_damaged_blob(fleet: Fleet, lost: bool, size: int) -> None:
    data = os.urandom(size)
    one, two = fleet.host("one"), fleet.host("two")
    sha256 = fleet.take(one, data)
    (name,) = fleet.names()
    if lost:
        fleet.objects.remove(name)
    else:
        fleet.objects.put(_file(fleet.folder, bytes(size)), name)
    with pytest.raises(LostFileError if lost else DamagedFileError):
        fleet.read(two, sha256)
    upload = fleet.upload(size)
    fleet.append(two, upload, data)
    assert two.finish_upload(fleet.again(upload), HOUR) == sha256
    assert fleet.names() == [name]
    assert fleet.read(fleet.host("three"), sha256) == data


@pytest.mark.parametrize("local", [True, False])
def test_work_for_a_file_does_not_tell_whether_another_key_has_it(
    fleet: Fleet, local: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = BlobFolder(fleet.folder / "data", fleet.store.inputs, 0) if local else fleet.host("one")
    read: list[str] = []
    digest = ObjectStore.digest

    def noted(self: ObjectStore, name: str) -> str:
        read.append(name)
        return digest(self, name)

    monkeypatch.setattr(ObjectStore, "digest", noted)
    work = []
    for name in ("first", "second"):
        path = host.incoming / name
        path.write_bytes(b"x" * MB)
        before = len(fleet.s3.asked)
        host.add(path)
        sent = [method for method, _ in fleet.s3.asked[before:] if method not in ("DELETE", "HEAD")]
        work.append((len(read), sent))
        read.clear()
    assert work[0] == work[1]
    assert work[0][0] == 1


def test_unused_blobs_are_collected(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    host = fleet.host("one")
    sha256 = fleet.take(host, b"wanted by nobody")
    fleet.objects.put(_file(fleet.folder, b"x"), "blobs/aa/orphan")
    fleet.objects.put(_file(fleet.folder, b"x"), "uploads/upl_1/orphan")
    for work in (clean_up, remove_orphans):
        work(fleet.store, Artifacts(fleet.url), host)
    assert len(fleet.names()) == 3, "the rows may still be on their way"
    monkeypatch.setattr("service.files.objects.REMOTE_ORPHAN_SECONDS", -HOUR)
    fleet.store.inputs.database.clock = lambda: 10**11
    for work in (clean_up, remove_orphans):
        work(fleet.store, Artifacts(fleet.url), fleet.host("two"))
    assert fleet.names() == []
    with pytest.raises(NotFoundError):
        fleet.store.inputs.hold([sha256])


def _file(folder: Path, data: bytes) -> Path:
    path = folder / os.urandom(4).hex()
    path.write_bytes(data)
    return path


def test_upload_continues_on_another_host(fleet: Fleet) -> None:
    data, first = os.urandom(8 * MB), 6 * MB
    upload = fleet.upload(len(data))
    fleet.append(fleet.host("one"), upload, data[:1000], data[1000:first])
    two = fleet.host("two")
    fleet.append(two, upload, data[first:])
    assert fleet.again(upload).offset == len(data)
    assert len(fleet.names()) == 2
    sha256 = two.finish_upload(fleet.again(upload), HOUR)
    assert sha256 == hashlib.sha256(data).hexdigest()
    assert [name.split("/")[0] for name in fleet.names()] == ["blobs"]
    assert fleet.read(fleet.host("three"), sha256) == data
    assert two.finish_upload(fleet.again(upload), HOUR) == sha256, "another request has finished it already"


def test_upload_with_a_truncated_part_has_to_be_started_again(fleet: Fleet) -> None:
    host, upload = fleet.host("one"), fleet.upload(9)
    fleet.append(host, upload, b"the scene")
    (name,) = fleet.names()
    fleet.objects.put(_file(fleet.folder, b"the"), name)
    with raises_problem(problems.LOST_UPLOAD, "gone"):
        host.finish_upload(fleet.again(upload), HOUR)
    assert list(host.incoming.iterdir()) == []


def test_one_of_two_concurrent_writers_gets_a_conflict(fleet: Fleet) -> None:
    upload = fleet.upload(30)
    slow, fast = fleet.host("one").append(upload, HOUR), fleet.host("two").append(upload, HOUR)
    slow.write(b"slow" * 5)
    fast.write(b"fast" * 4)
    fast.save()
    with pytest.raises(ConflictError, match="the next byte is 16"):
        slow.save()
    slow.close()
    fast.write(b"fast" * 3)
    fast.discard()
    fast.write(b"and the end.")
    with pytest.raises(NotFoundError, match="gone"):
        fleet.host("three").finish_upload(fleet.again(upload), HOUR)  # not complete yet
    fast.write(b"!!")
    fast.save()
    fast.close()
    sha256 = fleet.host("three").finish_upload(fleet.again(upload), HOUR)
    assert fleet.read(fleet.host("one"), sha256) == b"fast" * 4 + b"and the end.!!"
    assert len(fleet.names()) == 1


def test_cache_is_evicted_for_incoming_files(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    host = fleet.host("one")
    used, newest = (fleet.take(host, os.urandom(size)) for size in (3000, 5000))
    folder = fleet.folder / "one" / "cache" / "files"

    def free(_: Path) -> SimpleNamespace:
        return SimpleNamespace(free=10_000 - sum(path.stat().st_size for path in folder.glob("*/*")))

    monkeypatch.setattr("service.files.blobs.shutil.disk_usage", free)
    with local_files(host, fleet.store.inputs.blobs([used])):
        host.ensure_space(2000)
        assert (folder / newest[:2] / newest).exists()
        host.ensure_space(7000)
        assert {path.name for path in folder.glob("*/*")} == {used}, "it is in use"
        with pytest.raises(NoSpaceError):
            host.ensure_space(7001)
    host.ensure_space(10_000)


def test_disk_without_a_free_byte_is_full(tmp_path: Path, fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    blobs = BlobFolder(tmp_path / "data", fleet.store.inputs, 0)
    for free, full in ((0, True), (1, False)):
        monkeypatch.setattr("service.files.blobs.shutil.disk_usage", lambda _, free=free: SimpleNamespace(free=free))
        with pytest.raises(NoSpaceError) if full else nullcontext():
            blobs.ensure_space(0)
    with pytest.raises(NoSpaceError):
        blobs.ensure_space(2)


def test_disk_without_inodes_rejects_files(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    host = fleet.host("one")
    disk = os.statvfs(host.incoming)

    def inodes(files: int, left: int) -> None:
        statistics = SimpleNamespace(f_files=files, f_favail=left, f_bavail=disk.f_bavail, f_frsize=disk.f_frsize)
        statistics.f_blocks, statistics.f_bfree = disk.f_blocks, disk.f_bfree
        monkeypatch.setattr("service.files.blobs.os.statvfs", lambda _: statistics)

    host.ensure_space(0)
    inodes(10_000, 999)
    with pytest.raises(NoSpaceError, match="more files"):
        host.ensure_space(0)
    with pytest.raises(NoSpaceError):
        host.receive(10)
    inodes(0, 0)  # a file system without a limit of inodes
    host.ensure_space(0)


@pytest.mark.parametrize("fault", ["slow-down", "reset", "cut-off"])
def test_short_store_failure_is_retried(fleet: Fleet, fault: Fault) -> None:
    data = os.urandom(100_000)
    if fault != "cut-off":
        fleet.s3.fail(fault, 2, lambda method, path: method == "PUT")
    sha256 = fleet.take(fleet.host("one"), data)
    fleet.s3.fail(fault, 1, lambda method, path: method == "GET" and "list-type" not in path)
    assert fleet.read(fleet.host("two"), sha256) == data


@pytest.mark.slow
def test_store_outage_is_reported_as_unavailable(fleet: Fleet, monkeypatch: pytest.MonkeyPatch) -> None:
    data = b"the scene"
    sha256 = fleet.take(fleet.host("one"), data)
    fleet.s3.fail("reset", 10**6)
    two = fleet.host("two")
    with pytest.raises(StoreError, match="does not answer") as raised:
        fleet.read(two, sha256)
    assert raised.value.__cause__ is not None
    upload = fleet.upload(9)
    with pytest.raises(StoreError):
        fleet.append(two, upload, data)
    fleet.s3.heal()
    assert fleet.again(upload).offset == 0
    fleet.append(two, upload, data)
    assert two.finish_upload(fleet.again(upload), HOUR) == sha256
    assert fleet.read(two, sha256) == data


@pytest.mark.parametrize(
    ("path", "flags", "error"), [("/dev/full", "wb", NoSpaceError), ("/proc/self/mem", "r+b", StoreError)]
)
def test_only_a_full_disk_counts_as_no_space(path: str, flags: str, error: type[Exception]) -> None:
    with open(path, flags, buffering=0) as file, pytest.raises(error):
        write_all(file, b"bytes")


#: User id without rights.
_NOBODY = 65534


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Run the API process; tests that kill it start it again."""
    with Service(tmp_path_factory.mktemp("service") / "data", alone=True) as running:
        yield running


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[httpx2.Client]:
    with service.client() as opened:
        yield opened


def almost(client: httpx2.Client, content: bytes) -> str:
    """Create an upload with all bytes except the last one, and return its URL path."""
    where = begin(client, len(content))
    assert send(client, where, 0, content[:-1]).status_code == 204
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
def test_last_part_can_be_sent_again(service: Service, client: httpx2.Client) -> None:
    contents = {linked: os.urandom(10_000) for linked in (False, True)}
    places = {linked: almost(client, content) for linked, content in contents.items()}
    service.stop(signal.SIGKILL)
    for linked, content in contents.items():
        write_the_end(service, content, places[linked], linked=linked)
    service.start()
    for linked, content in contents.items():
        where, sha256 = places[linked], hashlib.sha256(content).hexdigest()
        assert client.head(where, headers=TUS).headers["upload-offset"] == str(len(content))
        assert send(client, where, len(content), b"").status_code == 204
        shown = client.get(where).json()
        assert (shown["complete"], shown["sha256"]) == (True, sha256)
    blobs = [path.read_bytes() for path in (service.data / "blobs").glob("*/*") if path.is_file()]
    assert [blobs.count(content) for content in contents.values()] == [1, 1]
    assert not any((service.data / "uploads").iterdir())


def test_missing_bytes_are_not_read_as_zeros(service: Service, client: httpx2.Client) -> None:
    where = almost(client, os.urandom(10_000))
    part = service.data / "uploads" / f"{where.rsplit('/', 1)[1]}.part"
    part.unlink()
    refused(send(client, where, 9_999, b"x"), 404, "not-found")


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
        blobs.upload_path(row.id).touch(0o400)
        inputs.advance_upload(row.id, 0, 5, 3600)
        with unprivileged(), raises_problem(problems.UPLOAD_LOCKED):
            blobs.append(row, 3600)


def test_missing_write_permission_is_a_failure_of_the_store(tmp_path: Path) -> None:
    with blob_folder(tmp_path) as (inputs, blobs):
        row = inputs.create_upload("me", 5, "scene.ply", "", 3600)
        received = blobs.receive(10)
        received.close()
        settings = ServiceSettings(data=blobs.incoming.parent, min_free_bytes=0)
        stored = StoredBlobs(settings, inputs, ObjectStore("memory://inputs"))
        with unprivileged():
            for write in (
                lambda: blobs.append(row, 3600),
                lambda: stored.append(row, 3600),
                lambda: blobs.receive(10),
                lambda: blobs.add(received.path),
            ):
                with pytest.raises(StoreError, match="cannot write the file: "):
                    write()


@pytest.mark.parametrize("killed", [False, True])
def test_digest_of_an_upload_in_parts_equals_that_of_its_file(
    service: Service, client: httpx2.Client, killed: bool
) -> None:
    content = os.urandom(30_000)
    middle, where = len(content) // 2, begin(client, len(content))
    assert send(client, where, 0, content[:middle]).status_code == 204
    wrong = base64.b64encode(hashlib.sha256(b"another").digest()).decode()
    refused(send(client, where, middle, bytes(100), **{"Upload-Checksum": f"sha256 {wrong}"}), 460, "checksum-mismatch")
    if killed:  # the digest so far is lost
        service.stop(signal.SIGKILL)
        service.start()
    assert send(client, where, middle, content[middle:-1]).status_code == 204
    assert send(client, where, len(content) - 1, content[-1:]).status_code == 204
    shown = client.get(where).json()
    assert (shown["complete"], shown["sha256"]) == (True, hashlib.sha256(content).hexdigest())
