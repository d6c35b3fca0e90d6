"""One attempt as the dispatcher sees it: a folder, a process, what it tells, and what becomes of its results."""

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

from safetensors import SafetensorError, safe_open

from service.errors import LeaseLostError
from service.files.artifacts import Artifacts
from service.files.blobs import BlobFolder
from service.files.names import CHECKPOINT, RESULT
from service.files.staging import stage
from service.parameters import JobParameters, stored_parameters
from service.scheduling.attempt_process import Message, Task
from service.scheduling.packing import Grant
from service.settings import ServiceSettings
from service.store import Store
from service.store.jobs import DAY, Jobs, Lease, Published
from sgsst_core.errors import SettingsError

#: Progress is written this often at most: more would be writes that nobody sees.
_PROGRESS_SECONDS = 1.0
#: A job that is canceled has so long to end its step.
_CANCEL_SECONDS = 8.0
#: Variables that say how many threads a process computes with; what the operator sets goes first.
_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: The end of a crashed process' log that its error carries.
_LOG_TAIL = 2000

_log = logging.getLogger(__name__)


class RunningAttempt:
    """An attempt that runs in a thread of its own from `start` on; the dispatcher's loop only asks and tells."""

    def __init__(
        self,
        lease: Lease,
        grant: Grant,
        folder: Path,
        store: Store,
        blobs: BlobFolder,
        artifacts: Artifacts,
        settings: ServiceSettings,
        cluster: bool,
    ) -> None:
        self.lease = lease
        #: What the attempt has of the machine; it becomes less when the plan does not need everything.
        self.grant = grant
        self._cluster = cluster
        self._folder = folder
        self._store, self._blobs, self._artifacts, self._settings = store, blobs, artifacts, settings
        self._messages: queue.Queue[Message | None] = queue.Queue()
        self._process: subprocess.Popen[bytes] | None = None
        self._wish: str | None = None
        self._deadline: float | None = None
        self._stopped = False
        self._published: dict[str, tuple[int, int]] = {}
        self._progress_at = self._log_at = 0.0
        self._pending: dict[str, Any] | None = None
        self._thread = threading.Thread(target=self._run, name=lease.job_id, daemon=True)

    @property
    def alive(self) -> bool:
        """Whether there is still something to do."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def cancel(self) -> None:
        """End the job at its user's wish."""
        self._wish = self._wish or "cancel"

    def release(self) -> None:
        """Save the job's state and give it back: the dispatcher is to end."""
        self._wish = self._wish or "release"

    def abandon(self) -> None:
        """Another dispatcher has the job: end everything, and write nothing more."""
        self._wish = "abandon"

    def join(self, timeout: float | None = None) -> None:
        """Wait for the end."""
        self._thread.join(timeout)

    # --- in its thread ---------------------------------------------------------------------------------------------

    def _run(self) -> None:
        extra = {"job": self.lease.job_id, "attempt": self.lease.job.attempt}
        try:
            self._attempt()
        except LeaseLostError:
            _log.warning("the lease was lost: another dispatcher has the job", extra=extra)
        except Exception as error:
            _log.exception("the attempt broke", extra=extra)
            with contextlib.suppress(Exception):
                self._fail({"code": "internal", "message": f"{type(error).__name__}: {error}"}, permanent=False)
        finally:
            self._kill()
            shutil.rmtree(self._folder, ignore_errors=True)

    def _attempt(self) -> None:
        try:
            parameters = stored_parameters(self.lease.job.parameters)
        except SettingsError as error:
            self._fail({"code": error.code, "message": str(error)}, permanent=True)
            return
        self._stage(parameters)
        self._launch()
        last = self._watch()
        process = self._process
        assert process is not None
        if self._wish == "abandon":
            return
        self._publish(self._unfinished_files() | self._grown_log(now=True))
        if last is not None and last["kind"] == "done":
            self._succeed(last["result"])
        elif self._wish == "cancel":
            self._store.jobs.canceled(self.lease, self._retention)
            self._sweep()
            _log.info("canceled", extra=self._extra)
        elif self._wish == "release":
            self._store.jobs.release(self.lease)
            _log.info("put back into the queue", extra=self._extra)
        elif last is not None and last["kind"] == "failed":
            self._fail(last["error"], permanent=last["permanent"])
        else:
            self._fail(self._crash(process.returncode), permanent=False)

    def _stage(self, parameters: JobParameters) -> None:
        job = self.lease.job
        self._folder.mkdir(parents=True)
        digests = sorted({entry["sha256"] for entry in job.inputs})
        rows = self._store.inputs.blobs(digests)
        staged = stage(
            self._folder, job.inputs, {sha256: self._blobs.path(row.location) for sha256, row in rows.items()}
        )
        out = self._folder / "out"
        out.mkdir()
        checkpoint = self._store.jobs.artifact(job.id, CHECKPOINT)
        if checkpoint is not None:
            self._artifacts.fetch(checkpoint.location, out / f"{Path(RESULT).stem}.checkpoint.safetensors")
        if self.grant.memory is not None:
            parameters = parameters.model_copy(update={"memory_limit": self.grant.memory})
        seconds = self._settings.checkpoint_seconds, self._settings.preview_seconds
        ranks = self.grant.ranks
        Task(staged, parameters, ranks, self._cluster, checkpoint is not None, *seconds).save(self._folder)

    def _launch(self) -> None:
        # a process without GPUs of its own must not see any
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
        _log.info("started", extra=self._extra)

    def _listen(self) -> None:
        assert self._process is not None
        assert self._process.stdout is not None
        for line in self._process.stdout:
            with contextlib.suppress(ValueError):
                self._messages.put(json.loads(line))
        self._messages.put(None)

    def _watch(self) -> Message | None:
        """Pass on what the process tells until it ends; returns its last word, or None where it had none."""
        last: Message | None = None
        ended = False
        while not ended:
            with contextlib.suppress(queue.Empty):
                message = self._messages.get(timeout=0.2)
                while message is not None:
                    if message["kind"] in ("done", "failed", "interrupted"):
                        last = message
                    else:
                        self._hear(message)
                    message = self._messages.get_nowait()
                ended = True
            if self._wish == "abandon":
                self._kill()
                return None
            self._write_progress()
            self._publish(self._unfinished_files() | self._grown_log())
            self._see_to_wish()
        assert self._process is not None
        self._process.wait()
        self._write_progress(now=True)
        return last

    def _hear(self, message: Message) -> None:
        if message["kind"] == "left-out":
            self._give_back(message["gpus"])
        if message["kind"] == "prepared":
            self._store.jobs.running(self.lease)
        if message["kind"] in ("stage", "prepared", "progress"):
            step, total = message.get("step", 0), message.get("total", 0)
            self._pending = {
                "stage": message.get("stage", "coarse" if message["kind"] == "progress" else "starting"),
                "step": step,
                "total": total,
                "fraction": step / total if total else 0.0,
                "eta_s": message.get("seconds_left"),
                "loss": message.get("loss"),
                "seconds": message.get("seconds"),
                "attempt": self.lease.job.attempt,
            }

    def _give_back(self, gpus: list[str]) -> None:
        """Leave GPUs that the plan does without to other jobs."""
        kept = tuple(gpu for gpu in self.grant.gpus if gpu not in gpus)
        self.grant = replace(self.grant, ranks=len(kept), gpus=kept)
        _log.info("needs %d GPUs and gives %d back", len(kept), len(gpus), extra=self._extra)

    def _write_progress(self, *, now: bool = False) -> None:
        moment = time.monotonic()
        if self._pending is not None and (now or moment - self._progress_at >= _PROGRESS_SECONDS):
            self._store.jobs.progress(self.lease, self._pending)
            self._pending, self._progress_at = None, moment

    def _see_to_wish(self) -> None:
        """Ask the process to stop, once, and end it where it takes too long."""
        process = self._process
        assert process is not None
        if self._wish is None:
            return
        if self._deadline is None:
            patience = _CANCEL_SECONDS if self._wish == "cancel" else self._settings.stop_seconds
            self._deadline = time.monotonic() + patience
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGTERM)
        elif time.monotonic() > self._deadline and not self._stopped:
            self._stopped = True
            self._kill()

    def _kill(self) -> None:
        """End the process and all that it has started."""
        process = self._process
        if process is None:
            return
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    # --- results ---------------------------------------------------------------------------------------------------

    def _unfinished_files(self) -> dict[str, Path]:
        """Files that may be looked at while the job runs."""
        out, stem = self._folder / "out", Path(RESULT).stem
        files = {"plan.json": out / f"{stem}.plan.json", CHECKPOINT: out / f"{stem}.checkpoint.safetensors"}
        previews = out / "previews"
        if previews.is_dir():
            files |= {f"previews/{path.name}": path for path in previews.glob("step_*.jpg")}
        return files

    def _grown_log(self, *, now: bool = False) -> dict[str, Path]:
        """A copy of the log as far as it is, once in a while: the process goes on writing to the log itself."""
        log, copy = self._folder / "log.txt", self._folder / "log-so-far.txt"
        moment = time.monotonic()
        if not now and moment - self._log_at < self._settings.preview_seconds:
            return {}
        self._log_at = moment
        if now or log.stat().st_size != (copy.stat().st_size if copy.exists() else 0):
            shutil.copyfile(log, copy)
        return {"log.txt": copy}

    def _publish(self, files: dict[str, Path]) -> None:
        """Publish those files that are new or have changed."""
        fresh = {}
        for name, path in files.items():
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                stamp = (status.st_size, status.st_mtime_ns)
                if self._published.get(name) != stamp:
                    fresh[name] = (path, stamp)
        put = [done for name, (path, _) in fresh.items() if (done := self._put(name, path)) is not None]
        if put:
            for location in self._store.jobs.publish(self.lease, put):
                self._artifacts.remove(location)
            self._published |= {name: stamp for name, (_, stamp) in fresh.items()}

    def _put(self, name: str, path: Path) -> Published | None:
        """Copy a file to the results; None where it has just been replaced or removed."""
        try:
            step = _saved_step(path) if name == CHECKPOINT else None
            return replace(self._artifacts.put(self.lease.job_id, self.lease.epoch, name, path), step=step)
        except FileNotFoundError:
            return None

    def _succeed(self, result: dict[str, Any]) -> None:
        out, stem = self._folder / "out", Path(RESULT).stem
        names = {
            RESULT: out / RESULT,
            "report.json": out / f"{stem}.report.json",
            "report.html": out / f"{stem}.report.html",
            "before_after.jpg": out / f"{stem}.before_after.jpg",
            "loss.png": out / f"{stem}.loss.png",
        }
        present = {name: path for name, path in names.items() if path.is_file()}
        if RESULT not in present:
            self._fail({"code": "internal", "message": "The job ended without a result."}, permanent=False)
            return
        put = [self._artifacts.put(self.lease.job_id, self.lease.epoch, name, path) for name, path in present.items()]
        self._store.jobs.succeed(self.lease, put, result, self._retention)
        self._sweep()
        _log.info("succeeded", extra=self._extra)

    def _fail(self, error: dict[str, Any], *, permanent: bool) -> None:
        again = self._store.jobs.fail(self.lease, error, permanent=permanent, retention=self._retention)
        _log.warning("%s: %s", "will be tried again" if again else "failed", error["message"], extra=self._extra)
        if not again:
            self._sweep()

    def _sweep(self) -> None:
        sweep(self._store.jobs, self._artifacts, self.lease.job_id, self.lease.epoch)

    def _crash(self, code: int) -> dict[str, Any]:
        """What to say of a process that ended without a word."""
        if code == -signal.SIGKILL:
            how = "The process that ran the job was killed; perhaps the machine had run out of memory."
        elif code < 0:
            how = f"The process that ran the job was ended by {signal.Signals(-code).name}."
        else:
            how = f"The process that ran the job ended with code {code}."
        with contextlib.suppress(OSError):
            text = (self._folder / "log.txt").read_bytes()[-_LOG_TAIL:].decode(errors="replace")
            return {"code": "crashed", "message": how, "log": text}
        return {"code": "crashed", "message": how}

    @property
    def _retention(self) -> float:
        return self._settings.retention_days * DAY

    @property
    def _extra(self) -> dict[str, Any]:
        return {"job": self.lease.job_id, "attempt": self.lease.job.attempt}


def sweep(jobs: Jobs, artifacts: Artifacts, job_id: str, epoch: int) -> None:
    """Remove what attempts at a job that has ended have left behind.

    Args:
        epoch: of the job's last lease.
    """
    artifacts.sweep(job_id, epoch, {row.location for row in jobs.artifacts(job_id)})
    jobs.swept(job_id, epoch)


def _saved_step(checkpoint: Path) -> int | None:
    """The step that a checkpoint was saved at; None for one that is damaged, which the next attempt will find out.

    Raises:
        FileNotFoundError: it has just been removed.
    """
    try:
        with safe_open(checkpoint, "np") as file:
            return int(file.metadata()["step"])
    except (SafetensorError, TypeError, KeyError):
        return None
