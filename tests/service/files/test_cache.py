"""Tests of a host's cache of stored files: they are fetched once, verified, limited in total size and shared."""

from __future__ import annotations

import errno
import hashlib
import multiprocessing
import os
import time
from pathlib import Path

import pytest

from service.files import objects as cache_module
from service.files.objects import FileCache
from service.problems import DamagedFileError, LostFileError, NoSpaceError


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


def test_transfer_error_is_fetched_again(cache: FileCache, tmp_path: Path) -> None:
    data, sha256 = content(1)
    source = Source(b"damaged")

    def fetch(target: Path) -> None:
        source(target)
        source.data = data

    cache.link(sha256, 1000, tmp_path / "a", fetch)
    assert ((tmp_path / "a").read_bytes(), source.fetched) == (data, 2)


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


def test_lost_object_raises_lost_file_error(cache: FileCache, tmp_path: Path) -> None:
    def fetch(target: Path) -> None:
        raise FileNotFoundError(target)

    with pytest.raises(LostFileError):
        cache.link(content(1)[1], 1000, tmp_path / "a", fetch)


@pytest.mark.parametrize("helps", [True, False])
def test_full_disk_evicts_unused_files(cache: FileCache, tmp_path: Path, helps: bool) -> None:
    old, old_sha256 = content(1)
    cache.link(old_sha256, 1000, tmp_path / "old", Source(old))
    (tmp_path / "old").unlink()
    data, sha256 = content(2)

    def fetch(target: Path) -> None:
        target.write_bytes(b"half")
        if files(tmp_path) or not helps:
            raise OSError(errno.ENOSPC, "No space left on device")
        target.write_bytes(data)

    if helps:
        cache.link(sha256, 1000, tmp_path / "new", fetch)
        assert (tmp_path / "new").read_bytes() == data
    else:
        with pytest.raises(NoSpaceError, match="full"):
            cache.link(sha256, 1000, tmp_path / "new", fetch)
        assert list((tmp_path / "cache" / "half").iterdir()) == []
    assert old_sha256 not in files(tmp_path)


def test_adopted_file_is_not_copied(cache: FileCache, tmp_path: Path) -> None:
    data, sha256 = content(1)
    for name in ("first", "second"):
        (tmp_path / name).write_bytes(data)
        inode = (tmp_path / name).stat().st_ino
        cache.adopt(tmp_path / name, sha256)
        assert not (tmp_path / name).exists()
        if name == "first":
            first = inode
    source = Source(data)
    cache.link(sha256, 1000, tmp_path / "a", source)
    assert ((tmp_path / "a").stat().st_ino, source.fetched) == (first, 0)


def test_old_partial_files_are_removed(cache: FileCache, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A complete file gets its synthetic time just before it is moved into the cache, and may then seem decades old."""
    half = tmp_path / "cache" / "half" / "0123456789abcdef"
    half.write_bytes(b"whole")
    os.utime(half, (0, 0))
    cache.evict(reserve=2501)
    assert half.exists()
    monkeypatch.setattr(cache_module, "_PARTIAL_SECONDS", -1.0)
    cache.evict(reserve=2501)
    assert not half.exists()


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
