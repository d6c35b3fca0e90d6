"""Tests of `sgsst fsck`: missing, damaged and orphaned files are found, and repaired where possible."""

from __future__ import annotations

import json
import os
import random
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import httpx2
import pytest

from api.cli.main import main
from service.files.blobs import open_blobs
from service.files.objects import Artifacts, ObjectStore
from service.inputs import CHECKPOINT
from service.settings import ServiceSettings
from service.store import Store
from service.store.jobs import NewJob
from service.store.queue import Lease
from tests.service.files.s3 import environment_of, s3_server
from tests.service.store import helpers
from tests.stores import new_store

HOUR = 3600.0
MISSING, DAMAGED, ORPHANED = 4, 8, 16


@pytest.fixture(autouse=True)
def umask() -> Iterator[None]:
    """Restore the umask, which the command changes in this process."""
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with s3_server() as url:
        assert httpx2.put(f"{url}/fsck").status_code == 200
        yield url


@pytest.fixture(params=["local", pytest.param("s3", marks=pytest.mark.slow)])
def service(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Files]:
    monkeypatch.setenv("SGSST_DATA", str(tmp_path / "data"))
    monkeypatch.setenv("SGSST_MIN_FREE_BYTES", "0")
    if request.param == "s3":
        for name, value in environment_of(request.getfixturevalue("server")).items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("SGSST_ARTIFACTS", f"s3://fsck/{os.urandom(4).hex()}")
    files = Files(tmp_path)
    yield files
    files.store.close()


@dataclass
class Files:
    """Stored files of a service, with methods that delete and damage them."""

    folder: Path
    settings: ServiceSettings = field(init=False)
    store: Store = field(init=False)

    def __post_init__(self) -> None:
        self.settings = ServiceSettings()
        self.store = new_store(self.settings)
        self.artifacts = Artifacts(self.settings.artifacts_url)
        self.blobs = open_blobs(self.settings, self.store.inputs, self.artifacts)

    def file(self, content: bytes) -> Path:
        path = self.folder / os.urandom(6).hex()
        path.write_bytes(content)
        return path

    def input(self, content: bytes) -> str:
        """Store an input, and return its name."""
        sha256 = self.blobs.add(self.file(content))
        return f"blobs/{self.store.inputs.blobs([sha256])[sha256].location}"

    def job(self, scene: str) -> Lease:
        sha256 = scene.split("/")[2].partition("-")[0]
        entry = {"role": "scene", "name": "scene.ply", "sha256": sha256, "size": 1}
        self.store.jobs.create(NewJob("me", "", 0, {}, [entry]), limit=10_000)
        return helpers.lease(self.store)

    def results(self, lease: Lease, contents: dict[str, bytes]) -> list[str]:
        put = [self.artifacts.put(lease.job_id, lease.epoch, name, self.file(data)) for name, data in contents.items()]
        self.store.leases.publish(lease, put)
        return [each.location for each in put]

    def upload(self, content: bytes, length: int) -> str:
        row = self.store.inputs.create_upload("me", length, "scene.ply", "", HOUR)
        writer = self.blobs.append(row, HOUR)
        writer.write(content)
        writer.save()
        writer.close()
        if self.blobs.objects.local:
            return f"uploads/{row.id}.part"
        return self.store.inputs.parts(row.id)[0].location

    def orphan(self, name: str) -> None:
        """Create a file that no database row refers to."""
        objects = self.place(name)
        if objects.local:
            Path(objects.root, name).parent.mkdir(parents=True, exist_ok=True)
        objects.put(self.file(b"x"), name)

    def place(self, name: str) -> ObjectStore:
        return self.artifacts.objects if name.startswith("job_") else self.blobs.objects

    def lose(self, name: str) -> None:
        self.place(name).remove(name)

    def flip(self, name: str, order: random.Random) -> None:
        """Flip one bit of a file."""
        objects = self.place(name)
        content = bytearray(b"".join(objects.read(name, 0, objects.size(name))))
        content[order.randrange(len(content))] ^= 1 << order.randrange(8)
        objects.remove(name)
        objects.put(self.file(bytes(content)), name)


def run(capsys: pytest.CaptureFixture[str], *options: str) -> tuple[int, dict[str, dict[str, str]]]:
    """Run `sgsst fsck`; return its exit code and its findings by file name."""
    capsys.readouterr()
    code = main(["fsck", "--json", *options])
    findings = {finding["name"]: finding for finding in json.loads(capsys.readouterr().out)}
    return code, findings


def kinds(findings: dict[str, dict[str, str]]) -> dict[str, str]:
    return {name: finding["kind"] for name, finding in findings.items()}


def test_mend_repairs_all_findings(
    service: Files, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    order = random.Random(1)
    scene, unused, good = (service.input(b"input %d" % number) for number in range(3))
    lease = service.job(scene)
    intact, damaged, checkpoint = service.results(
        lease, {"plan.json": b"plan", "stylized.ply": b"ply", CHECKPOINT: b"state"}
    )
    part, whole_part = service.upload(b"half", 8), service.upload(b"half", 8)
    assert run(capsys) == (0, {})

    service.flip(scene, order)
    service.lose(unused)
    service.flip(damaged, order)
    service.lose(checkpoint)
    service.lose(part)
    orphans = {"blobs/aa/orphan", "uploads/upl_0123456789", "job_0123456789/1/x/plan.json"}
    for name in orphans:
        service.orphan(name)
    expected = {scene: "damaged", unused: "missing", damaged: "damaged", checkpoint: "missing", part: "missing"}
    code, findings = run(capsys)
    assert (code, kinds(findings)) == (MISSING + DAMAGED, expected), "orphans may still get their rows"
    assert findings[scene]["holders"] == [f"job:{lease.job_id}"]
    monkeypatch.setattr("service.files.objects.ORPHAN_SECONDS", -HOUR)
    monkeypatch.setattr("service.files.objects.REMOTE_ORPHAN_SECONDS", -HOUR)
    expected |= dict.fromkeys(orphans, "orphaned")
    code, findings = run(capsys, "--mend")
    assert (code, kinds(findings)) == (MISSING + DAMAGED + ORPHANED, expected)
    assert findings[scene]["mended"].startswith("moved to quarantine/"), findings[scene]
    assert findings[scene]["mended"].endswith("it comes back when it is sent again")
    assert {row.name for row in service.store.jobs.artifacts(lease.job_id)} == {"plan.json"}
    assert service.blobs.objects.below("quarantine")

    code, findings = run(capsys)
    assert (code, kinds(findings)) == (MISSING, {scene: "missing"}), "a job needs it"
    assert service.input(b"input 0") == scene
    assert run(capsys) == (0, {})
    for name in (scene, good, intact, whole_part):
        assert service.place(name).size(name) > 0


def test_fsck_of_running_service_finds_nothing(service: Files, capsys: pytest.CaptureFixture[str]) -> None:
    """Files that are added, replaced or deleted during the check are not reported as missing or orphaned."""
    stop, store = threading.Event(), service.store

    def work() -> None:
        number = 0
        while not stop.is_set():
            number += 1
            scene = service.input(b"input %d" % number)
            lease = service.job(scene)
            for turn in range(3):
                put = service.artifacts.put(lease.job_id, lease.epoch, "log.txt", service.file(b"%d" % turn))
                for location in store.leases.publish(lease, [put]):
                    service.artifacts.objects.remove(location)
            upload_id = service.upload(b"upload %d" % number, 7 + len(str(number))).split("/")[1].removesuffix(".part")
            service.blobs.finish_upload(store.inputs.upload(upload_id, "me"), HOUR)
            store.leases.succeed(lease, [], {})
            if number % 2:
                store.jobs.delete(lease.job_id, None)
                service.artifacts.objects.remove_below(lease.job_id)

    with ThreadPoolExecutor(1) as pool:
        working = pool.submit(work)
        try:
            for _ in range(8):
                assert run(capsys, "--mend") == (0, {})
        finally:
            stop.set()
        working.result()


def test_folder_without_database_is_rejected_unchanged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("SGSST_DATABASE", raising=False)
    monkeypatch.setenv("SGSST_DATA", str(tmp_path / "other"))
    assert main(["fsck"]) == 2
    assert "no database of the service" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
