"""Tests of a rank's working folder on a machine that shares only the file store with others."""

import multiprocessing
import os
import pickle
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from pydantic import TypeAdapter
from safetensors.numpy import save_file

from service.files.objects import Artifacts
from service.inputs import CHECKPOINT
from service.problems import LostFileError, StoreError
from service.scheduling import attempt_files
from service.scheduling.messages import StoreWorkplace
from service.states import Published
from sgsst_core.errors import InfrastructureError
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.files.atomic import file_digest
from tests.api.service import wait_for
from tests.service.files.s3 import FaultyS3, environment_of


@pytest.fixture
def s3(s3_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[FaultyS3]:
    def has_bucket() -> bool:
        try:
            return httpx2.put(f"{s3_url}/files").status_code == 200
        except httpx2.TransportError:  # a server that has just started may drop a connection
            return False

    wait_for(has_bucket, "the bucket")
    monkeypatch.setenv("SGSST_DATA", str(tmp_path / "node"))
    monkeypatch.setenv("SGSST_CACHE", os.environ.get("SGSST_CACHE", ""))
    monkeypatch.setattr(attempt_files, "_SCAN_SECONDS", 0.05)
    monkeypatch.setattr(attempt_files, "_RETRY_SECONDS", 0.1)
    with FaultyS3(s3_url) as faulty:
        for name, value in environment_of(faulty.origin).items():
            monkeypatch.setenv(name, value)
        yield faulty


@dataclass
class Recorder:
    """Recorded notifications of stored files."""

    files: list[Published] = field(default_factory=list)
    steps: list[int | None] = field(default_factory=list)

    def __call__(self, file: Any, step: int | None) -> None:
        self.files.append(file)
        self.steps.append(step)

    def names(self) -> set[str]:
        return {file.name for file in self.files}


def put(url: str, name: str, data: bytes, folder: Path) -> Published:
    path = folder / os.urandom(4).hex()
    path.write_bytes(data)
    Artifacts(url).objects.put(path, name)
    return Published(name, name, len(data), file_digest(path))


@pytest.fixture
def job(s3: FaultyS3, tmp_path: Path) -> StoreWorkplace:
    url = f"s3://files/{os.urandom(4).hex()}"
    contents = {"scene": b"scene", "style": b"style", "cameras": b"{}"}
    files = {role: put(url, f"blobs/{role}", data, tmp_path) for role, data in contents.items()}
    names = {"scene": "my.ply", "style": "style.png", "cameras": "cameras.json"}
    inputs = tuple({"role": role, "name": names[role], "sha256": file.sha256} for role, file in files.items())
    return StoreWorkplace(url, "job_1", 3, inputs, tuple(files.values()), None, ())


def checkpoint(folder: Path, step: int) -> None:
    path = folder / "out" / "stylized.checkpoint.safetensors"
    save_file({"x": np.zeros(3)}, path.with_suffix(".new"), {"step": str(step)})
    path.with_suffix(".new").replace(path)


def test_files_are_fetched_once_for_all_ranks_of_a_machine(s3: FaultyS3, job: StoreWorkplace, tmp_path: Path) -> None:
    as_json = TypeAdapter(StoreWorkplace)
    job = pickle.loads(pickle.dumps(as_json.validate_json(as_json.dump_json(job))))
    before = len(s3.asked)
    ranks = [job.open(number, Recorder()) for number in (1, 2)]
    fetched = [path for method, path in s3.asked[before:] if method == "GET"]
    assert sorted(path.rpartition("/")[2] for path in fetched) == ["cameras", "scene", "style"]
    for rank in ranks:
        assert (rank.folder / "scene" / "my.ply").read_bytes() == b"scene"
        assert (rank.folder / "cameras" / "cameras.json").read_bytes() == b"{}"
        rank.close()
        rank.close()
    assert not [path for path in (tmp_path / "node" / "ranks").iterdir() if path.is_dir()]


def test_machine_without_a_data_folder_is_refused(job: StoreWorkplace, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("SGSST_DATA")
    with pytest.raises(InfrastructureError, match="has no SGSST_DATA"):
        job.open(1, Recorder())
    job.tidy()


def test_first_rank_uploads_files_while_it_runs(job: StoreWorkplace) -> None:
    recorder = Recorder()
    rank = job.open(0, recorder)
    out = rank.folder / "out"
    (out / "stylized.plan.json").write_text("{}")
    checkpoint(rank.folder, 10)
    wait_for(lambda: recorder.names() == {"plan.json", CHECKPOINT}, "the files to be stored")
    checkpoint(rank.folder, 25)
    wait_for(lambda: recorder.steps[-1] == 25, "the checkpoint to be stored")
    assert all(file.location.startswith("job_1/3/") for file in recorder.files), "under the attempt's epoch"
    (out / "stylized.ply").write_bytes(b"ply")
    (out / "stylized.report.json").write_text("{}")
    rank.finish(done=True)
    assert recorder.names() == {"plan.json", CHECKPOINT, "stylized.ply", "report.json"}
    result = next(file for file in recorder.files if file.name == "stylized.ply")
    assert b"".join(Artifacts(job.url).objects.read(result.location, 0, result.size)) == b"ply"
    rank.close()
    assert not rank.folder.exists()
    following = job.after(recorder.files)
    assert following.checkpoint is not None
    again = following.open(0, Recorder())
    assert (again.folder / "out" / "stylized.checkpoint.safetensors").stat().st_size == following.checkpoint.size
    again.close()
    assert job.after([]) == job


def test_damaged_checkpoint_is_not_used(job: StoreWorkplace, tmp_path: Path) -> None:
    saved = put(job.url, "job_1/1/x/checkpoint", b"state", tmp_path)
    for sha256, used in ((saved.sha256, True), ("e" * 64, False)):
        rank = replace(job, checkpoint=replace(saved, sha256=sha256)).open(0, Recorder())
        assert (rank.folder / "out" / "stylized.checkpoint.safetensors").exists() == used
        rank.close()


def test_no_file_is_lost_during_a_store_outage(s3: FaultyS3, job: StoreWorkplace) -> None:
    recorder = Recorder()
    rank = job.open(0, recorder)
    s3.fail("reset", 10**6)
    checkpoint(rank.folder, 10)
    (rank.folder / "out" / "stylized.ply").write_bytes(b"ply")
    time.sleep(0.3)
    assert recorder.files == []
    healing = threading.Timer(1.0, s3.heal)
    healing.start()
    rank.finish(done=True)
    healing.join()
    assert recorder.names() == {CHECKPOINT, "stylized.ply"}
    rank.close()


def test_staging_failures_are_infrastructure_errors(
    s3: FaultyS3, job: StoreWorkplace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    missing = replace(job, files=(*job.files[:2], Published("none", "blobs/none", 3, "e" * 64)))
    with pytest.raises(LostFileError) as lost:
        missing.open(1, Recorder())
    assert pickle.loads(pickle.dumps(lost.value)).code == "file-lost", "it travels from rank to dispatcher"
    s3.fail("reset", 10**6)
    with pytest.raises(StoreError, match="does not answer") as raised:
        job.open(1, Recorder())
    assert pickle.loads(pickle.dumps(raised.value)).code == "store-unavailable", "it travels from rank to dispatcher"
    s3.heal()
    (tmp_path / "full").write_bytes(b"a file where the folder should be")
    monkeypatch.setenv("SGSST_DATA", str(tmp_path / "full" / "data"))
    with pytest.raises(InfrastructureError, match="cannot be staged"):
        job.open(1, Recorder())


def test_weights_are_fetched_by_digest(
    job: StoreWorkplace, tiny_cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SGSST_CACHE", str(tiny_cache))
    expected = load_network_weights("vgg16").sha256
    weights = attempt_files.store_weights(Artifacts(job.url).objects)
    assert "vgg16.safetensors" in [file.name for file in weights]
    assert attempt_files.store_weights(Artifacts(job.url).objects) == weights
    monkeypatch.setenv("SGSST_CACHE", str(tmp_path / "nothing is installed here"))
    rank = replace(job, weights=weights).open(1, Recorder())
    assert os.environ["SGSST_CACHE"] != str(tiny_cache)
    assert load_network_weights("auto").sha256 == expected
    rank.close()


def _open_and_wait(job: StoreWorkplace, ready: Any) -> None:
    rank = job.open(0, Recorder())
    ready.set()
    time.sleep(600)
    rank.close()


@pytest.mark.slow
def test_folder_of_a_killed_rank_is_removed(job: StoreWorkplace, tmp_path: Path) -> None:
    spawned = multiprocessing.get_context("spawn")
    ready = spawned.Event()
    process = spawned.Process(target=_open_and_wait, args=(job, ready))
    process.start()
    assert ready.wait(120)
    own = job.open(1, Recorder())

    def folders() -> int:
        return sum(path.is_dir() for path in (tmp_path / "node" / "ranks").iterdir())

    assert folders() == 2, "who lives is left alone"
    process.kill()
    process.join()
    assert folders() == 2
    job.tidy()
    assert folders() == 1
    assert (own.folder / "scene" / "my.ply").exists()
    own.close()
