"""Tests of storing results in a local folder, and in an object store like S3, which only writes whole objects."""

from __future__ import annotations

import errno
import hashlib
from pathlib import Path

import pytest

from service.files.objects import Artifacts


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
    with pytest.raises(OSError, match="shorter"):
        list(artifacts.objects.read(put.location, 0, put.size + 1))


def test_final_file_is_linked_and_others_are_copied(artifacts: Artifacts, tmp_path: Path) -> None:
    source = tmp_path / "checkpoint"
    source.write_bytes(b"first")
    put = artifacts.put("job_1", 1, ".checkpoint", source, final=True)
    assert source.stat().st_nlink == (2 if artifacts.local else 1)
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


def test_files_without_rows_are_swept(artifacts: Artifacts, tmp_path: Path) -> None:
    source = tmp_path / "plan.json"
    source.write_bytes(b"{}")
    old, new, later = (artifacts.put("job_1", epoch, "plan.json", source) for epoch in (1, 2, 10))
    other = artifacts.put("job_2", 1, "plan.json", source)
    artifacts.sweep("job_1", 2, {new.location})
    assert b"".join(artifacts.objects.read(later.location, 0, 2)) == b"{}", "of a lease whose rows are still to come"
    assert b"".join(artifacts.objects.read(new.location, 0, 2)) == b"{}"
    with pytest.raises(FileNotFoundError):
        list(artifacts.objects.read(old.location, 0, 2))
    artifacts.objects.remove_below("job_1")
    artifacts.objects.remove_below("job_1")
    artifacts.objects.remove(new.location)
    assert b"".join(artifacts.objects.read(other.location, 0, 2)) == b"{}"
