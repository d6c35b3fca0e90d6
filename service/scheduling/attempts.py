"""Supervision of one attempt by the dispatcher: its folder, its process, its reports, and its ending."""

import contextlib
import logging
import math
import os
import queue
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from service import problems
from service.deadlines import LEAST_RATE
from service.files.blobs import Blobs
from service.files.objects import Artifacts, ObjectStore
from service.inputs import CHECKPOINT, PLAN, job_spec, layout, stage, stored_parameters
from service.inspection.inspector import stored_plan
from service.problems import LeaseLostError
from service.scheduling import messages
from service.scheduling.attempt_files import PATIENCE_SECONDS, Publisher, fetch_checkpoint, store_weights
from service.scheduling.capacity import Grant
from service.settings import ServiceSettings
from service.states import AttemptOutcome, JobStatus, Published
from service.store import Store
from service.store.files import BLOBS
from service.store.queue import Lease, cause_of
from service.store.tables import ArtifactRow, BlobRow
from sgsst_core.progress import Progress
from worker.job import JobSpec

_log = logging.getLogger(__name__)

#: Variables that set a process' number of threads; values set by the operator take precedence.
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


class ChildProcess:
    """Running `service.scheduling.attempt_process`; it is started by the constructor.

    Args:
        cluster: Whether the attempt runs on a Ray cluster, which assigns GPUs itself.

    Attributes:
        reports: Reports of the process, then None once it has closed its output.
    """

    def __init__(self, folder: Path, grant: Grant, *, cluster: bool) -> None:
        # a process without assigned GPUs must not see any
        environment = {**os.environ, "CUDA_VISIBLE_DEVICES": "" if cluster else ",".join(grant.gpus)}
        if grant.threads is not None:
            environment = dict.fromkeys(_THREADS, str(grant.threads)) | environment
        with (folder / "log.txt").open("ab") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "service.scheduling.attempt_process", str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment,
                start_new_session=True,
            )
        self.reports: queue.Queue[messages.Report | None] = queue.Queue()
        self._deadline: float | None = None
        self._finishing = False
        threading.Thread(target=self._listen, name=f"{folder.name}-out", daemon=True).start()

    def _listen(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                self.reports.put(messages.Report.model_validate_json(line))
        self.reports.put(None)

    def finish(self) -> None:
        """Ask the process to end its job after the current step, with the present colors as the result.

        Call this only after the report `prepared`: earlier, the process may not handle the signal yet.
        """
        if not self._finishing:
            self._finishing = True
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGUSR1)

    def stop(self, patience: float) -> None:
        """Ask the process to stop; calls after `patience` seconds kill it."""
        if self._deadline is None:
            self._deadline = time.monotonic() + patience
            with contextlib.suppress(ProcessLookupError):
                self._process.send_signal(signal.SIGTERM)
        elif time.monotonic() > self._deadline:
            self._deadline = math.inf
            self.kill()

    def kill(self) -> None:
        """Kill the process and all processes that it has started."""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def wait(self) -> int:
        """Wait for the process to exit, and return its exit code; negative for the signal that killed it."""
        return self._process.wait()


def prepare(
    settings: ServiceSettings,
    store: Store,
    blobs: Blobs,
    artifacts: Artifacts,
    cluster: bool,
    folder: Path,
    lease: Lease,
    grant: Grant,
    spec: JobSpec,
) -> None:
    """Create the folder of an attempt at a job.

    Args:
        cluster: Whether attempts run on a Ray cluster. If the file store is remote, ranks stage the files themselves.

    Raises:
        LostFileError, DamagedFileError: If an input cannot be used.
        StoreError: If the file store does not respond.
    """
    out, job, workplace = folder / "out", lease.job, None
    out.mkdir(parents=True)
    checkpoint = store.jobs.artifact(job.id, CHECKPOINT)
    rows = store.inputs.blobs(sorted({entry["sha256"] for entry in job.inputs}))
    if cluster and not artifacts.objects.local and not spec.paintings:
        workplace = _workplace(artifacts.objects, lease, rows, checkpoint)
    else:
        if checkpoint is not None:
            fetch_checkpoint(artifacts, checkpoint, out)
        stage(folder, job.inputs, blobs.fetch(rows, folder))
        (folder / PLAN).symlink_to(
            stored_plan(settings, job.owner, job.inputs, stored_parameters(job.parameters)).absolute()
        )
    of_job = spec.settings
    if grant.memory is not None:
        of_job = of_job.model_copy(update={"memory_limit": grant.memory})
    task = messages.Task(
        spec=spec.model_copy(update={"settings": of_job, "resume": checkpoint is not None}),
        workers=grant.ranks,
        cluster=cluster,
        checkpoint_seconds=settings.checkpoint_seconds,
        preview_seconds=settings.preview_seconds,
        workplace=workplace,
    )
    (folder / "task.json").write_text(task.model_dump_json())


def _workplace(
    objects: ObjectStore, lease: Lease, rows: Mapping[str, BlobRow], checkpoint: ArtifactRow | None
) -> messages.StoreWorkplace:
    """Return the description that ranks on other machines need to stage the job's files."""
    files = [Published(sha256, f"{BLOBS}/{row.location}", row.size, sha256) for sha256, row in rows.items()]
    saved = None
    if checkpoint is not None:
        saved = Published(CHECKPOINT, checkpoint.location, checkpoint.size, checkpoint.sha256)
    weights = store_weights(objects)
    return messages.StoreWorkplace(
        objects.url, lease.job_id, lease.epoch, tuple(lease.job.inputs), tuple(files), saved, weights
    )


#: Time that a canceled job has to finish its step, in seconds.
_CANCEL_SECONDS = 8.0
#: Time to wait for a report before other tasks are done, in seconds.
_REPORT_SECONDS = 0.2
#: Time limit of each piece of work on files at the start and the end of an attempt, in seconds; the time for the bytes
#: of large files comes on top. It is longer than the S3 client's own.
_FILE_SECONDS = 60.0

#: Seconds between writes of progress: in the first minute, and for long-running jobs. More frequent writes would go
#: unnoticed, and on a large fleet they are most of the database's load.
_PROGRESS_SECONDS = (1.0, 5.0)
#: Minimum seconds between messages about progress to a job's webhook.
_NOTIFIED_SECONDS = 5.0

T = TypeVar("T")


class RunningAttempt:
    """Attempt that runs in its own thread, started by the constructor; the dispatcher queries and controls it."""

    def __init__(
        self,
        lease: Lease,
        grant: Grant,
        folder: Path,
        settings: ServiceSettings,
        store: Store,
        artifacts: Artifacts,
        prepare: Callable[[Path, Lease, Grant, JobSpec], None],
        cluster: bool,
    ) -> None:
        self.lease = lease
        self.grant = grant
        self._folder, self._settings, self._store = folder, settings, store
        self._prepare, self._cluster = prepare, cluster
        self._process: ChildProcess | None = None
        self._stop_request: messages.StopRequest | None = None
        self._publisher = Publisher(lease, folder, store, artifacts, settings.preview_seconds)
        self._progress = ProgressWriter(lease, store)
        # Work on files has a thread of its own, because it may hang: the attempt then ends without it.
        self._files = ThreadPoolExecutor(1, f"{lease.job_id}-files")
        self._pending: deque[Future[None]] = deque()
        self._thread = threading.Thread(target=self._run, name=lease.job_id, daemon=True)
        self._thread.start()

    @property
    def alive(self) -> bool:
        """Whether the attempt's thread is running."""
        return self._thread.is_alive()

    @property
    def abandoned(self) -> bool:
        """Whether the attempt was abandoned or has ended."""
        return self._stop_request == messages.StopRequest.ABANDON or not self.alive

    def obey(self, status: JobStatus) -> None:
        """Do what the job's status asks for on behalf of its user: stop, or end with the present colors as result."""
        if status == JobStatus.CANCELING:
            self._stop_request = self._stop_request or messages.StopRequest.CANCEL
        elif status == JobStatus.FINISHING and self._process is not None:
            self._process.finish()

    def release(self) -> None:
        """Save the job's state and return it to the queue, because the dispatcher is shutting down."""
        self._stop_request = self._stop_request or messages.StopRequest.RELEASE

    def abandon(self) -> None:
        """End everything at once and write nothing more: another dispatcher has the job or may get it soon."""
        self._stop_request = messages.StopRequest.ABANDON
        self._kill()  # the attempt's own thread may be waiting for a database that does not respond

    # --- in the attempt's thread ----------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._attempt()
        except LeaseLostError:
            _log.warning("lease lost to another dispatcher", extra=self.lease.log_fields)
        except Exception as error:
            _log.exception("attempt failed", extra=self.lease.log_fields)
            ending = messages.failure(error)
            with contextlib.suppress(Exception):
                self._fail(ending.error or {}, permanent=ending.permanent)
        finally:
            self._kill()
            removed = self._files.submit(shutil.rmtree, self._folder, ignore_errors=True)
            wait([removed], _CANCEL_SECONDS)  # if the folder hangs, it is removed afterwards
            self._files.shutdown(wait=False)

    def _within(self, work: Callable[[], T], seconds: float | None = None, size: int = 0) -> T:
        """Return the result of work on files, after all earlier work.

        Raises:
            StoreError: If the file store or the folder hangs.
        """
        future = self._files.submit(work)
        try:
            return future.result((seconds or _FILE_SECONDS) + size / LEAST_RATE)
        except TimeoutError as error:
            if future.done():
                raise
            future.cancel()
            raise problems.STORE_UNAVAILABLE() from error

    def _check_published(self) -> None:
        """Raise the error of publishing that has failed."""
        while self._pending and self._pending[0].done():
            self._pending.popleft().result()

    def _attempt(self) -> None:
        spec = job_spec(layout(self.lease.job.inputs)[0], stored_parameters(self.lease.job.parameters))
        if self.grant.gpus:
            self._store.leases.hold_gpus(self.lease, len(self.grant.gpus))
        prepare = partial(self._prepare, self._folder, self.lease, self.grant, spec)
        self._within(prepare, size=sum(entry["size"] for entry in self.lease.job.inputs))
        self._process = ChildProcess(self._folder, self.grant, cluster=self._cluster)
        _log.info("attempt started", extra=self.lease.log_fields)
        reported = self._watch(self._process)
        if self._stop_request == messages.StopRequest.ABANDON:
            return
        exit_code = self._process.wait()
        self._progress.write(now=True)
        self._within(partial(self._publisher.publish_unfinished, whole_log=True), PATIENCE_SECONDS)
        self._check_published()
        ending = messages.attempt_ending(
            self._stop_request,
            reported,
            exit_code,
            self._within(self._publisher.log_tail),
            has_result=self._within(self._publisher.has_result),
            cluster=self._cluster,
        )
        self._conclude(ending)

    def _conclude(self, ending: messages.Ending) -> None:
        """Record the end of an attempt in the store."""
        if ending.outcome == AttemptOutcome.SUCCEEDED:
            result = {} if ending.result is None else ending.result.model_dump()
            succeed = partial(
                self._publisher.succeed, result, lambda: self._stop_request == messages.StopRequest.ABANDON
            )
            self._within(succeed, 2 * PATIENCE_SECONDS)
        elif ending.outcome == AttemptOutcome.CANCELED:
            self._store.leases.stop(self.lease)
        elif ending.outcome == AttemptOutcome.RELEASED:
            self._store.leases.release(self.lease)
        else:
            if ending.detail:
                _log.error("machine, network or file store failed:\n%s", ending.detail, extra=self.lease.log_fields)
            self._fail(ending.error or {}, permanent=ending.permanent)
            return
        _log.info("attempt ended: outcome=%s", ending.outcome, extra=self.lease.log_fields)

    def _watch(self, process: ChildProcess) -> messages.Ending | None:
        """Handle reports until the process ends or the attempt is abandoned; return the reported ending, or None."""
        ending: messages.Ending | None = None
        ended = False
        while not ended:
            with contextlib.suppress(queue.Empty):
                report = process.reports.get(timeout=_REPORT_SECONDS)
                while report is not None:
                    ending = report.ending or ending
                    self._handle(report)
                    report = process.reports.get_nowait()
                ended = True
            if self._stop_request == messages.StopRequest.ABANDON:
                process.kill()
                return None
            self._progress.write()
            self._check_published()
            if not self._pending:
                self._pending.append(self._files.submit(self._publisher.publish_unfinished))
            if self._stop_request is not None:
                process.stop(
                    _CANCEL_SECONDS
                    if self._stop_request == messages.StopRequest.CANCEL
                    else self._settings.stop_seconds
                )
        return ending

    def _handle(self, report: messages.Report) -> None:
        """Handle a report, except for its ending."""
        if report.stored is not None:
            self._pending.append(self._files.submit(self._publisher.publish, [report.stored]))
        if report.prepared:
            self._store.leases.start(self.lease)
        if report.progress is not None:
            self._progress.update(report.progress)

    def _kill(self) -> None:
        if self._process is not None:
            self._process.kill()

    def _fail(self, error: dict[str, Any], *, permanent: bool) -> None:
        retried = self._store.leases.fail(self.lease, error, permanent=permanent)
        outcome = "job will be retried" if retried else "job failed"
        _log.warning("%s: cause=%s: %s", outcome, cause_of(error), error["message"], extra=self.lease.log_fields)


class ProgressWriter:
    """Writer of an attempt's progress, which starts with the attempt."""

    def __init__(self, lease: Lease, store: Store) -> None:
        self._lease, self._store = lease, store
        self._started_at, self._written_at = time.monotonic(), 0.0
        #: Time of the last message to the job's webhook; infinite if it gets none.
        self._notified_at = 0.0 if "progress" in (lease.job.webhook_events or ()) else math.inf
        self._pending: Progress | None = None

    def update(self, progress: Progress) -> None:
        """Set the progress to be written next."""
        self._pending = progress

    def write(self, *, now: bool = False) -> None:
        """Write new progress to the store if a write is due; `now` writes it in any case."""
        time_now = time.monotonic()
        due = time_now - self._written_at >= progress_seconds(time_now - self._started_at)
        if self._pending is not None and (now or due):
            notify = time_now - self._notified_at >= _NOTIFIED_SECONDS
            self._store.leases.report_progress(self._lease, self._pending, notify=notify)
            if notify:
                self._notified_at = time_now
            self._pending, self._written_at = None, time_now


def progress_seconds(elapsed: float) -> float:
    """Return the interval between writes of progress, in seconds, for an attempt that has run this long."""
    least, most = _PROGRESS_SECONDS
    return min(max(elapsed / 60, least), most)
