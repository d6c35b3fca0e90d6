"""Preparation of an attempt's folder: its input files, its checkpoint, and `task.json`."""

from __future__ import annotations

import logging
from pathlib import Path

from service.errors import DamagedFileError, LostFileError
from service.files.artifacts import Artifacts
from service.files.blobs import BLOBS, Blobs
from service.files.staging import CHECKPOINT, PLAN, RESULT, stage
from service.inspection.inspector import stored_plan
from service.parameters import stored_parameters
from service.scheduling.attempt_process import Task
from service.scheduling.packing import Grant
from service.scheduling.rank_folder import store_weights
from service.scheduling.store_workplace import StoredFile, StoreWorkplace
from service.settings import ServiceSettings
from service.store import Store
from service.store.leases import Lease
from service.store.tables import ArtifactRow, BlobRow
from worker.job import JobSpec

_log = logging.getLogger(__name__)


class Stager:
    """Preparer of the folders of a dispatcher's attempts.

    Args:
        cluster: Whether attempts run on a Ray cluster. If the file store is remote, ranks stage the files themselves.
    """

    def __init__(
        self, settings: ServiceSettings, store: Store, blobs: Blobs, artifacts: Artifacts, *, cluster: bool
    ) -> None:
        self._settings, self._store, self._blobs, self._artifacts = settings, store, blobs, artifacts
        self.cluster = cluster

    def prepare(self, folder: Path, lease: Lease, grant: Grant, spec: JobSpec) -> None:
        """Create the folder of an attempt at a job.

        Raises:
            LostFileError, DamagedFileError: If an input cannot be used.
            StoreError: If the file store does not respond.
        """
        (folder / "out").mkdir(parents=True)
        job = lease.job
        checkpoint = self._store.jobs.artifact(job.id, CHECKPOINT)
        workplace = self._workplace(lease, checkpoint) if self.cluster and not self._artifacts.local else None
        if workplace is None:
            self._stage(folder, lease, checkpoint)
        settings = spec.settings
        if grant.memory is not None:
            settings = settings.model_copy(update={"memory_limit": grant.memory})
        task = Task(
            spec=spec.model_copy(update={"settings": settings, "resume": checkpoint is not None}),
            workers=grant.ranks,
            cluster=self.cluster,
            checkpoint_seconds=self._settings.checkpoint_seconds,
            preview_seconds=self._settings.preview_seconds,
            workplace=workplace,
        )
        (folder / "task.json").write_text(task.model_dump_json())

    def _stage(self, folder: Path, lease: Lease, checkpoint: ArtifactRow | None) -> None:
        """Stage the job's files in the attempt's folder."""
        if checkpoint is not None:
            target = folder / "out" / f"{Path(RESULT).stem}.checkpoint.safetensors"
            try:
                self._artifacts.fetch(checkpoint.location, target, checkpoint.sha256)
            except (LostFileError, DamagedFileError) as error:
                _log.warning("checkpoint not usable, job restarts: %s", error, extra=lease.log_fields)
        job = lease.job
        stage(folder, job.inputs, self._blobs.fetch(self._input_rows(lease), folder))
        (folder / PLAN).symlink_to(
            stored_plan(self._settings, job.owner, job.inputs, stored_parameters(job.parameters)).absolute()
        )

    def _input_rows(self, lease: Lease) -> dict[str, BlobRow]:
        return self._store.inputs.blobs(sorted({entry["sha256"] for entry in lease.job.inputs}))

    def _workplace(self, lease: Lease, checkpoint: ArtifactRow | None) -> StoreWorkplace:
        """Return the description that ranks on other machines need to stage the job's files."""
        files = [
            StoredFile(f"{BLOBS}/{row.location}", row.sha256, row.size) for row in self._input_rows(lease).values()
        ]
        saved = StoredFile(checkpoint.location, checkpoint.sha256, checkpoint.size) if checkpoint is not None else None
        objects, weights = self._artifacts.objects, store_weights(self._artifacts.objects)
        return StoreWorkplace(
            objects.url, lease.job_id, lease.epoch, tuple(lease.job.inputs), tuple(files), saved, weights
        )
