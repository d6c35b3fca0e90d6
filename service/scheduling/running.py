"""Supervision of one attempt by the dispatcher: its folder, its process, its messages, and its ending."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from service.errors import DamagedFileError, LeaseLostError, LostFileError, ServiceError
from service.files.artifacts import Artifacts
from service.files.blobs import BLOBS, Blobs
from service.files.names import CHECKPOINT, RESULT
from service.files.staging import Staged, layout, stage
from service.parameters import JobParameters, stored_parameters
from service.scheduling.attempt_process import Task
from service.scheduling.endings import OUTAGE, Ending, Message, Wish, attempt_ending, is_outage
from service.scheduling.job_size import estimated_seconds
from service.scheduling.packing import Grant
from service.scheduling.publishing import Publisher
from service.scheduling.scheduler import Holding
from service.scheduling.store_workplace import StoredFile, StoreWorkplace, store_weights
from service.settings import ServiceSettings
from service.store import Store
from service.store.leases import Lease, Published
from service.store.states import AttemptOutcome
from service.store.tables import ArtifactRow, BlobRow
from sgsst_core.errors import SettingsError

#: Seconds between writes of progress: in the first minute, and for long-running jobs. More frequent writes would go
#: unnoticed, and on a large fleet they are most of the database's load.
_PROGRESS_SECONDS = (1.0, 5.0)
#: Time that a canceled job has to finish its step, in seconds.
_CANCEL_SECONDS = 8.0
#: Variables that set a process' number of threads; values set by the operator take precedence.
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

_log = logging.getLogger(__name__)


class RunningAttempt:
    """Attempt that runs in its own thread; the dispatcher's loop queries and controls it."""

    def __init__(
        self,
        lease: Lease,
        grant: Grant,
        folder: Path,
        store: Store,
        blobs: Blobs,
        artifacts: Artifacts,
        settings: ServiceSettings,
        cluster: bool,
    ) -> None:
        self.lease = lease
        #: Capacity of the attempt; it is reduced if the plan needs less.
        self.grant = grant
        self._cluster = cluster
        self._folder = folder
        self._store, self._blobs, self._artifacts, self._settings = store, blobs, artifacts, settings
        self._messages: queue.Queue[Message | None] = queue.Queue()
        self._process: subprocess.Popen[bytes] | None = None
        self._wish: Wish | None = None
        self._deadline: float | None = None
        self._stopped = False
        self._publisher = Publisher(lease, folder, store, artifacts, settings.preview_seconds)
        self._begun_at, self._progress_at = time.monotonic(), 0.0
        self._pending: dict[str, Any] | None = None
        self._ends_at: float | None = None
        self._thread = threading.Thread(target=self._run, name=lease.job_id, daemon=True)

    @property
    def alive(self) -> bool:
        """Whether the attempt's thread is running."""
        return self._thread.is_alive()

    @property
    def abandoned(self) -> bool:
        """Whether the attempt was abandoned or has ended."""
        return self._wish == Wish.ABANDON or not self.alive

    @property
    def holding(self) -> Holding:
        """Capacity of the attempt, and its expected end according to the last progress message."""
        ends_at, grant, job = self._ends_at, self.grant, self.lease.job
        if ends_at is None:
            return Holding(grant)
        until = self._store.database.clock() + ends_at - time.monotonic()
        if job.attempt > 1:  # it may have resumed from a checkpoint, so its pace is unknown
            return Holding(grant, until)
        pace = (ends_at - self._begun_at) / estimated_seconds(job.parameters, job.inputs, grant.ranks)
        return Holding(grant, until, pace)

    def start(self) -> None:
        """Start the attempt."""
        self._thread.start()

    def cancel(self) -> None:
        """Cancel the job on behalf of its user."""
        self._wish = self._wish or Wish.CANCEL

    def release(self) -> None:
        """Save the job's state and return it to the queue, because the dispatcher is shutting down."""
        self._wish = self._wish or Wish.RELEASE

    def abandon(self) -> None:
        """End everything at once and write nothing more: another dispatcher has the job or may get it soon."""
        self._wish = Wish.ABANDON
        self._kill()  # the attempt's own thread may be waiting for a database that does not respond

    # --- in the attempt's thread ----------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._attempt()
        except LeaseLostError:
            _log.warning("the lease was lost: another dispatcher has the job", extra=self._log_fields)
        except Exception as error:
            _log.exception("the attempt failed unexpectedly", extra=self._log_fields)
            told = (
                {"code": error.code, "message": str(error)}
                if isinstance(error, ServiceError)
                else {"code": "internal", "message": f"{type(error).__name__}: {error}"}
            )
            with contextlib.suppress(Exception):
                self._fail(OUTAGE if is_outage(error) else told, permanent=False)
        finally:
            self._kill()
            shutil.rmtree(self._folder, ignore_errors=True)

    def _attempt(self) -> None:
        try:
            parameters = stored_parameters(self.lease.job.parameters)
        except SettingsError as error:
            self._fail({"code": error.code, "message": str(error)}, permanent=True)
            return
        self._count_gpus()
        self._stage(parameters)
        self._launch()
        last = self._watch()
        process = self._process
        assert process is not None
        if self._wish == Wish.ABANDON:
            return
        self._publisher.publish_unfinished(whole_log=True)
        found = attempt_ending(
            self._wish,
            last,
            process.returncode,
            self._publisher.log_tail(),
            has_result=self._publisher.has_result(),
            cluster=self._cluster,
        )
        self._conclude(found, {} if last is None else last.get("result", {}))

    def _conclude(self, ending: Ending, result: dict[str, Any]) -> None:
        """Record the end of an attempt in the store."""
        if ending.outcome == AttemptOutcome.SUCCEEDED:
            self._publisher.succeed(result, lambda: self._wish == Wish.ABANDON)
            self._publisher.sweep()
        elif ending.outcome == AttemptOutcome.CANCELED:
            self._store.leases.stop(self.lease)
            self._publisher.sweep()
        elif ending.outcome == AttemptOutcome.RELEASED:
            self._store.leases.release(self.lease)
        else:
            if ending.detail:
                _log.error(
                    "a machine, a network or the store of files has failed:\n%s", ending.detail, extra=self._log_fields
                )
            self._fail(ending.error or {}, permanent=ending.permanent)
            return
        _log.info(ending.outcome, extra=self._log_fields)

    def _stage(self, parameters: JobParameters) -> None:
        job = self.lease.job
        (self._folder / "out").mkdir(parents=True)
        checkpoint = self._store.jobs.artifact(job.id, CHECKPOINT)
        workplace = self._workplace(checkpoint) if self._cluster and not self._artifacts.local else None
        staged = layout(job.inputs)[0] if workplace else self._stage_here(checkpoint)
        if self.grant.memory is not None:
            parameters = parameters.model_copy(update={"memory_limit": self.grant.memory})
        seconds = self._settings.checkpoint_seconds, self._settings.preview_seconds
        ranks, resume = self.grant.ranks, checkpoint is not None
        Task(staged, parameters, ranks, self._cluster, resume, *seconds, workplace).save(self._folder)

    def _stage_here(self, checkpoint: ArtifactRow | None) -> Staged:
        """Stage the job's files in the attempt's folder."""
        if checkpoint is not None:
            target = self._folder / "out" / f"{Path(RESULT).stem}.checkpoint.safetensors"
            try:
                self._artifacts.fetch(checkpoint.location, target, checkpoint.sha256)
            except (LostFileError, DamagedFileError) as error:
                _log.warning("the checkpoint cannot be used: %s The job starts again.", error, extra=self._log_fields)
        return stage(self._folder, self.lease.job.inputs, self._blobs.bring(self._input_rows(), self._folder))

    def _input_rows(self) -> dict[str, BlobRow]:
        return self._store.inputs.blobs(sorted({entry["sha256"] for entry in self.lease.job.inputs}))

    def _workplace(self, checkpoint: ArtifactRow | None) -> StoreWorkplace:
        """Return the description that ranks on other machines need to stage the job's files."""
        job = self.lease.job
        files = [StoredFile(f"{BLOBS}/{row.location}", row.sha256, row.size) for row in self._input_rows().values()]
        saved = StoredFile(checkpoint.location, checkpoint.sha256, checkpoint.size) if checkpoint is not None else None
        weights = store_weights(self._artifacts.objects)
        return StoreWorkplace(
            self._artifacts.objects.url, job.id, self.lease.epoch, tuple(job.inputs), tuple(files), saved, weights
        )

    def _launch(self) -> None:
        # a process without assigned GPUs must not see any
        environment = {**os.environ, "CUDA_VISIBLE_DEVICES": "" if self._cluster else ",".join(self.grant.gpus)}
        if self.grant.threads is not None:
            environment = dict.fromkeys(_THREADS, str(self.grant.threads)) | environment
        with (self._folder / "log.txt").open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "service.scheduling.attempt_process", str(self._folder)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        threading.Thread(target=self._listen, name=f"{self.lease.job_id}-out", daemon=True).start()
        _log.info("started", extra=self._log_fields)

    def _listen(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                self._messages.put(json.loads(line))
        self._messages.put(None)

    def _watch(self) -> Message | None:
        """Handle messages until the process ends; return the final message, or None if there is none."""
        last: Message | None = None
        ended = False
        while not ended:
            with contextlib.suppress(queue.Empty):
                message = self._messages.get(timeout=0.2)
                while message is not None:
                    if message["kind"] in ("done", "failed", "interrupted"):
                        last = message
                    else:
                        self._take_in(message)
                    message = self._messages.get_nowait()
                ended = True
            if self._wish == Wish.ABANDON:
                self._kill()
                return None
            self._write_progress()
            self._publisher.publish_unfinished()
            self._stop_as_asked()
        assert self._process is not None
        self._process.wait()
        self._write_progress(now=True)
        return last

    def _take_in(self, message: Message) -> None:
        """Handle a message other than the final one."""
        if message["kind"] == "left-out":
            self._give_back(message["gpus"])
        if message["kind"] == "stored":
            self._publisher.publish([Published(**message["file"])])
        if message["kind"] == "prepared":
            self._store.leases.begin(self.lease)
        if message["kind"] == "progress" and (left := message.get("seconds_left")) is not None:
            self._ends_at = time.monotonic() + left
        if message["kind"] in ("stage", "prepared", "progress"):
            self._pending = progress_record(message, self.lease.job.attempt)

    def _count_gpus(self) -> None:
        """Record the attempt's GPUs, which are charged to the job's owner."""
        if self.grant.gpus:
            self._store.leases.hold_gpus(self.lease, len(self.grant.gpus))

    def _give_back(self, gpus: list[str]) -> None:
        """Release GPUs that the plan does not use; on a cluster only their number matters."""
        left = len(self.grant.gpus) - len(gpus)
        kept = self.grant.gpus[:left] if self._cluster else tuple(x for x in self.grant.gpus if x not in gpus)
        self.grant = replace(self.grant, ranks=len(kept), gpus=kept)
        self._count_gpus()
        _log.info("needs %d GPUs; releasing %d", len(kept), len(gpus), extra=self._log_fields)

    def _write_progress(self, *, now: bool = False) -> None:
        moment = time.monotonic()
        if self._pending is not None and (
            now or moment - self._progress_at >= progress_seconds(moment - self._begun_at)
        ):
            self._store.leases.report_progress(self.lease, self._pending)
            self._pending, self._progress_at = None, moment

    def _stop_as_asked(self) -> None:
        """Ask the process once to stop, and kill it if that takes too long."""
        process = self._process
        assert process is not None
        if self._wish is None:
            return
        if self._deadline is None:
            patience = _CANCEL_SECONDS if self._wish == Wish.CANCEL else self._settings.stop_seconds
            self._deadline = time.monotonic() + patience
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
        elif time.monotonic() > self._deadline and not self._stopped:
            self._stopped = True
            self._kill()

    def _kill(self) -> None:
        """Kill the process and all processes that it has started."""
        process = self._process
        if process is None:
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def _fail(self, error: dict[str, Any], *, permanent: bool) -> None:
        again = self._store.leases.fail(self.lease, error, permanent=permanent)
        _log.warning("%s: %s", "will be retried" if again else "failed", error["message"], extra=self._log_fields)
        if not again:
            self._publisher.sweep()

    @property
    def _log_fields(self) -> dict[str, Any]:
        return {"job": self.lease.job_id, "attempt": self.lease.job.attempt}


def progress_seconds(elapsed: float) -> float:
    """Return the interval between writes of progress, in seconds, for an attempt that has run this long."""
    least, most = _PROGRESS_SECONDS
    return min(max(elapsed / 60, least), most)


def progress_record(message: Message, attempt: int) -> dict[str, Any]:
    """Convert a message to the progress entry of a job's record; in the stage `planning`, a step is a view."""
    step, total = message.get("step", 0), message.get("total", 0)
    return {
        "stage": message.get("stage", "coarse" if message["kind"] == "progress" else "starting"),
        "step": step,
        "total": total,
        "fraction": step / total if total else 0.0,
        "eta_s": message.get("seconds_left"),
        "loss": message.get("loss"),
        "scales": message.get("scales"),
        "seconds": message.get("seconds"),
        "attempt": attempt,
    }
