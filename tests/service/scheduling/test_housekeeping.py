"""Tests of deleting stray files of jobs."""

from __future__ import annotations

from pathlib import Path

import pytest

from service.files.objects import Artifacts
from service.scheduling import housekeeping
from service.settings import ServiceSettings
from service.states import Published
from service.store import open_store
from tests.service.scheduling.conftest import new_lease
from tests.service.store.helpers import SHA


def test_stray_files_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = ServiceSettings(data=tmp_path / "data")
    store, artifacts = open_store(settings), Artifacts(settings.artifacts_url)
    store.inputs.add_blob(SHA, "aa/blob", 3)
    source = tmp_path / "file"
    source.write_bytes(b"x")

    def put(job_id: str, epoch: int) -> Published:
        return artifacts.put(job_id, epoch, "plan.json", source)

    done, running = new_lease(store), new_lease(store)
    referenced = put(done.job_id, 1)
    store.leases.succeed(done, [referenced], {})
    late, unknown = put(done.job_id, 1), put("job_0123456789", 1)
    store.leases.release(running)
    again = store.leases.take("two")
    assert again is not None
    assert again.epoch == 2
    before, own = put(running.job_id, 1), put(running.job_id, 2)
    everything = {file.location for file in (referenced, late, unknown, before, own)}
    assert set(artifacts.objects.below("")) == everything
    assert housekeeping.remove_strays(store, artifacts) == 0, "rows may still be on their way"
    monkeypatch.setattr(housekeeping, "REMOTE_ORPHAN_SECONDS", -60.0)
    assert housekeeping.remove_strays(store, artifacts) == 3
    assert set(artifacts.objects.below("")) == {referenced.location, own.location}
    store.close()
