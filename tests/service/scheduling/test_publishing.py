"""Tests of publishing an attempt's files, with a real database and result folder, but without running a process."""

from __future__ import annotations

import resource
from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import save_file

from service.files.objects import Artifacts
from service.problems import NoSpaceError
from service.scheduling.publishing import Outbox, Publisher
from service.settings import ServiceSettings
from service.store import Store
from service.store.queue import Lease


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "attempt" / "out" / "previews").mkdir(parents=True)
    (tmp_path / "attempt" / "log.txt").write_text("first\n")
    return tmp_path / "attempt"


@pytest.fixture
def publisher(lease: Lease, folder: Path, store: Store, settings: ServiceSettings) -> Publisher:
    return Publisher(lease, folder, store, Artifacts(settings.artifacts_url), log_seconds=1e6)


def announced(store: Store, lease: Lease) -> list[str]:
    """Return the names of the files that were announced to watchers, in order."""
    return [event.data["name"] for event in store.jobs.events(lease.job_id, 0) if event.kind == "artifact"]


def test_full_disk_delays_publishing(folder: Path, settings: ServiceSettings) -> None:
    """The limit on the size of files stands for a disk without space."""
    outbox = Outbox("job_1", 1, folder / "out", Artifacts(settings.artifacts_url))
    (folder / "out" / "stylized.views.jpg").write_bytes(bytes(1 << 20))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, hard))
    try:
        put, refused = outbox.put(outbox.unfinished())
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (put, type(refused)) == ([], NoSpaceError)
    assert stored_names(settings) == []
    put, refused = outbox.put(outbox.unfinished())
    assert ([file.name for file in put], refused) == (["views.jpg"], None)


def content(store: Store, settings: ServiceSettings, lease: Lease, name: str) -> bytes:
    row = store.jobs.artifact(lease.job_id, name)
    assert row is not None
    return b"".join(Artifacts(settings.artifacts_url).objects.read(row.location, 0, row.size))


def stored_names(settings: ServiceSettings) -> list[str]:
    return sorted(path.name for path in (settings.folder / "artifacts").rglob("*") if path.is_file())


def test_new_and_changed_files_are_published(
    publisher: Publisher, folder: Path, store: Store, settings: ServiceSettings, lease: Lease
) -> None:
    publisher.publish_unfinished(whole_log=True)
    assert announced(store, lease) == ["log.txt"]
    (folder / "out" / "stylized.plan.json").write_text("{}")
    (folder / "out" / "previews" / "step_000010.jpg").write_bytes(b"jpg")
    (folder / "out" / "previews" / "half").write_bytes(b"no preview")
    publisher.publish_unfinished()
    publisher.publish_unfinished()
    assert sorted(announced(store, lease)) == ["log.txt", "plan.json", "previews/step_000010.jpg"]
    (folder / "out" / "stylized.plan.json").write_text('{"decisions": []}')
    publisher.publish_unfinished()
    assert announced(store, lease)[-1] == "plan.json"
    assert content(store, settings, lease, "plan.json") == b'{"decisions": []}'
    assert stored_names(settings) == ["log.txt", "plan.json", "step_000010.jpg"], "the older plan is still there"


def test_live_colors_are_published_until_the_job_has_succeeded(
    publisher: Publisher, folder: Path, store: Store, settings: ServiceSettings, lease: Lease
) -> None:
    live = folder / "out" / "live"
    live.mkdir()
    (live / "scene.ply").write_bytes(b"scene")
    for colors in (b"one", b"two"):
        (live / ".colors.part").write_bytes(colors)
        (live / ".colors.part").replace(live / "colors.f16")
        publisher.publish_unfinished()
        assert content(store, settings, lease, "live/colors.f16") == colors
    assert content(store, settings, lease, "live/scene.ply") == b"scene"
    assert stored_names(settings).count("colors.f16") == 1, "the older one is still there"
    (folder / "out" / "stylized.ply").write_bytes(b"ply")
    publisher.succeed({})
    publisher.sweep()
    assert stored_names(settings) == ["log.txt", "stylized.ply"]
    assert [row.name for row in store.jobs.artifacts(lease.job_id)] == ["log.txt", "stylized.ply"]


def test_log_is_copied_periodically_and_completely_at_the_end(
    publisher: Publisher, folder: Path, store: Store, settings: ServiceSettings, lease: Lease
) -> None:
    publisher.publish_unfinished(whole_log=True)
    (folder / "log.txt").write_text("first\nsecond\n")
    publisher.publish_unfinished()
    assert content(store, settings, lease, "log.txt") == b"first\n"
    publisher.publish_unfinished(whole_log=True)
    assert content(store, settings, lease, "log.txt") == b"first\nsecond\n"
    assert publisher.log_tail() == "first\nsecond\n"
    (folder / "log.txt").unlink()
    assert publisher.log_tail() is None


def test_published_checkpoint_records_its_step(publisher: Publisher, folder: Path, store: Store, lease: Lease) -> None:
    checkpoint = folder / "out" / "stylized.checkpoint.safetensors"
    for step, saved in ((10, 10), (25, 25), (None, 25)):
        if step is None:
            checkpoint.write_bytes(b"damaged")
        else:
            save_file({"x": np.zeros(step)}, checkpoint, metadata={"step": str(step)})
        publisher.publish_unfinished()
        assert store.jobs.get(lease.job_id, None).saved_step == saved
    assert announced(store, lease) == ["log.txt"], "checkpoints are not announced"


def test_success_publishes_results_and_sweeps_leftovers(
    publisher: Publisher, folder: Path, store: Store, settings: ServiceSettings, lease: Lease
) -> None:
    save_file({"x": np.zeros(1)}, folder / "out" / "stylized.checkpoint.safetensors", metadata={"step": "1"})
    publisher.publish_unfinished(whole_log=True)
    assert not publisher.has_result()
    for name in ("stylized.ply", "stylized.report.json", "stylized.loss.png", "stray.txt"):
        (folder / "out" / name).write_text(name)
    Artifacts(settings.artifacts_url).put(lease.job_id, lease.epoch, "cut_off.jpg", folder / "log.txt")
    assert publisher.has_result()
    publisher.succeed({"steps": 1})
    publisher.sweep()
    job = store.jobs.get(lease.job_id, None)
    assert (job.status, job.result) == ("succeeded", {"steps": 1})
    names = ["log.txt", "loss.png", "report.json", "stylized.ply"]
    assert [row.name for row in store.jobs.artifacts(lease.job_id)] == names
    assert stored_names(settings) == names
    assert store.retention.unswept(10) == []
