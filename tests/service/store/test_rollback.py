"""Tests of an SQLite database that has lost its write-ahead log: files that it no longer refers to are kept."""

from __future__ import annotations

import logging
import subprocess
import sys
from pathlib import Path

import pytest

from api.cli.main import main
from service import fsck
from service.files import blobs
from service.files.artifacts import Artifacts
from service.files.blobs import BlobFolder
from service.scheduling import housekeeping
from service.settings import ServiceSettings
from service.store import open_store
from tests.api.service import ROOT

#: Program that accepts a job, creates a file, and dies.
_WORK = """
import os, sys
from pathlib import Path
from service.files.artifacts import Artifacts
from service.files.blobs import BlobFolder
from service.settings import ServiceSettings
from service.store import open_store
from service.store.jobs import NewJob

settings = ServiceSettings()
store = open_store(settings)
source = settings.folder / "incoming.part"
source.write_bytes(b"scene")
sha256 = BlobFolder(settings.folder, store.inputs, 0).add(source)
entry = {"role": "scene", "name": "scene.ply", "sha256": sha256, "size": 5}
store.jobs.create(NewJob("me", "", 0, {}, [entry]), limit=10)
lease = store.leases.take("one")
source.write_bytes(b"plan")
put = Artifacts(settings.artifacts_url).put(lease.job_id, lease.epoch, "plan.json", source)
store.leases.publish(lease, [put])
os._exit(0)
"""


@pytest.fixture
def settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ServiceSettings:
    monkeypatch.setenv("SGSST_DATA", str(tmp_path / "data"))
    open_store(ServiceSettings()).close()
    subprocess.run([sys.executable, "-c", _WORK], check=True, cwd=ROOT)
    for module, name in ((blobs, "_ORPHAN_SECONDS"), (housekeeping, "_STRAY_SECONDS"), (fsck, "_ORPHAN_SECONDS")):
        monkeypatch.setattr(module, name, -3600.0)
    return ServiceSettings()


def files_of(settings: ServiceSettings) -> set[bytes]:
    folders = ("blobs", "artifacts")
    return {path.read_bytes() for name in folders for path in (settings.folder / name).rglob("*") if path.is_file()}


def collect(settings: ServiceSettings) -> bool:
    """Open the database, delete unreferenced files, and return whether a rollback was detected."""
    store = open_store(settings)
    BlobFolder(settings.folder, store.inputs, 0).collect()
    housekeeping.remove_strays(store, Artifacts(settings.artifacts_url))
    rolled_back = store.database.rolled_back
    store.close()
    return rolled_back


def test_crash_is_not_a_rollback(settings: ServiceSettings) -> None:
    assert not collect(settings)
    assert files_of(settings) == {b"scene", b"plan"}
    assert not collect(settings)


def test_rollback_is_reported_and_no_file_is_deleted(
    settings: ServiceSettings, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    (settings.folder / "sgsst.db-wal").unlink()
    with caplog.at_level(logging.ERROR):
        assert collect(settings)
    assert "database was rolled back" in caplog.text
    assert files_of(settings) == {b"scene", b"plan"}
    assert collect(settings), "until the operator has decided"
    assert main(["fsck", "--mend"]) == 16 + 32
    assert capsys.readouterr().out.count("orphaned") == 2
    assert files_of(settings) == {b"scene", b"plan"}
    (settings.folder / "sgsst.db.rolled-back").unlink()
    assert not collect(settings)
    assert files_of(settings) == set()
