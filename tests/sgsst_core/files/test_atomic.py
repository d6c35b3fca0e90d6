"""Tests of atomic files and of JSON files."""

import errno
import json
import os
import stat
from pathlib import Path

import pytest

from sgsst_core.errors import OutputError
from sgsst_core.files import atomic
from sgsst_core.files.atomic import HeldOpenError, atomic_path, ensure_writable_folder, remove_leftovers, write_json


def test_target_appears_only_when_complete(tmp_path: Path) -> None:
    target = tmp_path / "scene.ply"
    with atomic_path(target) as temporary:
        temporary.write_bytes(b"new")
        assert not target.exists()
        assert (temporary.parent, temporary.suffix) == (tmp_path, ".ply")
    assert target.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["scene.ply"]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit, OSError])
def test_interrupted_write_preserves_the_old_file(tmp_path: Path, error: type[BaseException]) -> None:
    target = tmp_path / "report.json"
    target.write_bytes(b"old")

    def fail() -> None:
        with atomic_path(target) as temporary:
            temporary.write_bytes(b"half")
            raise error

    with pytest.raises(error):
        fail()
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["report.json"]


def test_full_disk_is_an_output_error(tmp_path: Path) -> None:
    def fail() -> None:
        with atomic_path(tmp_path / "a.ply"):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with pytest.raises(OutputError, match=r"a\.ply.*No space left on device. Free some space"):
        fail()
    assert os.listdir(tmp_path) == []


def test_new_file_gets_default_permissions_and_old_file_keeps_its_own(tmp_path: Path) -> None:
    plain, target = tmp_path / "plain", tmp_path / "target"
    plain.touch()
    with atomic_path(target) as temporary:
        temporary.write_text("1")
    assert stat.S_IMODE(target.stat().st_mode) == stat.S_IMODE(plain.stat().st_mode)
    target.chmod(0o640)
    with atomic_path(target) as temporary:
        temporary.write_text("2")
    assert (stat.S_IMODE(target.stat().st_mode), target.read_text()) == (0o640, "2")


def test_symbolic_link_is_preserved(tmp_path: Path) -> None:
    real, link = tmp_path / "real", tmp_path / "link"
    real.write_text("old")
    link.symlink_to(real)
    with atomic_path(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert real.read_text() == "new"


def test_unwritable_targets_are_output_errors(tmp_path: Path) -> None:
    def write(target: Path) -> None:
        with atomic_path(target):
            pytest.fail("the block must not run")

    with pytest.raises(OutputError, match="does not exist"):
        write(tmp_path / "missing" / "a.ply")
    with pytest.raises(OutputError, match="is a folder"):
        write(tmp_path)


def test_ensure_writable_folder_creates_and_leaves_no_trace(tmp_path: Path) -> None:
    folder = tmp_path / "a" / "b"
    ensure_writable_folder(folder)
    ensure_writable_folder(folder)
    assert os.listdir(folder) == []


def test_only_leftovers_of_the_target_are_removed(tmp_path: Path) -> None:
    target, other = tmp_path / "a.ply", tmp_path / "b.ply"
    paths = []
    for path in (target, other):
        writer = atomic_path(path)
        paths.append(writer.__enter__())
    remove_leftovers(target)
    assert [path.exists() for path in paths] == [False, True]


def test_file_that_cannot_replace_its_target_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows refuses while another program has the target open; tests/api/windows does so on Windows' Python."""
    target, replace = tmp_path / "scene.ply", Path.replace
    target.write_text("old")

    def refuse(path: Path, final: Path) -> Path:
        if final == target:
            raise PermissionError(errno.EACCES, "Access is denied")
        return replace(path, final)

    monkeypatch.setattr(Path, "replace", refuse)
    monkeypatch.setattr(atomic, "HELD_SECONDS", 0.2)
    problem = r"scene\.ply: cannot be replaced: Access is denied.*scene-\w+\.new\.ply"
    with pytest.raises(HeldOpenError, match=problem), atomic_path(target) as temporary:
        temporary.write_text("new")
    assert target.read_text() == "old"
    remove_leftovers(target)
    assert [path.read_text() for path in tmp_path.iterdir() if path != target] == ["new"]


def test_non_unicode_names_are_written_as_json(tmp_path: Path) -> None:
    write_json(tmp_path / "r.json", {"path": "caf\udce9.ply"})
    assert json.loads((tmp_path / "r.json").read_text(encoding="utf-8")) == {"path": "caf\udce9.ply"}
