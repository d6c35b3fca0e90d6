"""Tests that trials of rasterizers, which compile kernels, run in only one process of a machine at a time."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from pathlib import Path

import pytest

from sgsst_core.rasterizer.trial import build_folder, drawing_problem, one_at_a_time

SPAWN = multiprocessing.get_context("spawn")


def build(folder: Path) -> None:
    """Simulate a compiler that fails if another process builds in the same folder at the same time."""
    mark = folder / "building"
    mark.touch(exist_ok=False)
    time.sleep(0.05)
    mark.unlink()


def build_often(folder: Path, own: Path, other: Path) -> None:
    own.touch()
    while not other.exists():
        time.sleep(0.001)
    for _ in range(5):
        with one_at_a_time(folder):
            build(folder)


def test_concurrent_processes_compile_one_after_the_other(tmp_path: Path) -> None:
    here, there = tmp_path / "here", tmp_path / "there"
    process = SPAWN.Process(target=build_often, args=(tmp_path / "builds", there, here))
    process.start()
    while not there.exists():
        assert process.is_alive()
        time.sleep(0.01)
    build_often(tmp_path / "builds", here, there)
    process.join(300)
    assert process.exitcode == 0


def hold(folder: Path, held: Path) -> None:
    with one_at_a_time(folder):
        held.touch()
        time.sleep(300)


def test_lock_of_a_dead_process_is_released(tmp_path: Path) -> None:
    process = SPAWN.Process(target=hold, args=(tmp_path, tmp_path / "held"))
    process.start()
    while not (tmp_path / "held").exists():
        assert process.is_alive()
        time.sleep(0.01)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    with one_at_a_time(tmp_path):
        build(tmp_path)
    process.join()


def test_unwritable_folder_is_not_locked(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with one_at_a_time(tmp_path / "file" / "builds"), one_at_a_time(tmp_path / "file" / "builds"):
        pass


def try_to_draw(trying: Path, tried: Path) -> None:
    trying.touch()
    drawing_problem("none")  # type: ignore[arg-type]
    tried.touch()


def test_only_one_process_tries_a_rasterizer_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_EXTENSIONS_DIR", str(tmp_path))
    process = SPAWN.Process(target=try_to_draw, args=(tmp_path / "trying", tmp_path / "tried"))
    with one_at_a_time(build_folder()):
        process.start()
        while not (tmp_path / "trying").exists():
            assert process.is_alive()
            time.sleep(0.01)
        process.join(0.5)
        assert not (tmp_path / "tried").exists()
    process.join(300)
    assert (tmp_path / "tried").exists()
