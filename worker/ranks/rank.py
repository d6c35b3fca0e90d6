"""Process of one rank: a Ray actor that runs the job in a thread and reports its status to the driver.

PyTorch is imported in that thread, after the environment variables for thread counts and GPUs are set.
"""

from __future__ import annotations

import os
import pickle
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from sgsst_core.errors import InfrastructureError
from worker.options import RunOptions
from worker.processes import ProcessId, die_with_parent, listen

if TYPE_CHECKING:
    from sgsst_core.parallel import Collectives
    from sgsst_core.progress import Progress
    from worker.job import JobSpec, Result, Resume
    from worker.prepare import Prepared
    from worker.ranks.process_group import Waiting

#: Seconds by which the timeout of an exchange between ranks exceeds the driver's. The driver should time out first,
#: because it knows which rank does not respond.
_PATIENCE = 15.0


#: Callback for each file that was stored outside this machine. It receives a description of the file, whose type the
#: implementation chooses, and the step if the file is a checkpoint (else None).
Stored = Callable[[Any, int | None], None]


class OpenWorkplace(Protocol):
    """Open folder on this machine that holds the files of a job; see `Workplace`."""

    folder: Path

    def finish(self, *, done: bool) -> None:
        """Store the files that have not been stored yet. Only rank 0 stores files.

        Args:
            done: Whether the job has written its results.

        Raises:
            InfrastructureError: If they cannot be stored.
        """

    def close(self) -> None:
        """Delete the folder."""


class Workplace(Protocol):
    """Factory of folders with the files of a job whose ranks run on machines without a shared folder.

    It is pickled and sent to every rank. The program that starts the job implements it: only it knows where the files
    come from and where results are stored.
    """

    @property
    def scene_bytes(self) -> int:
        """Return the bytes that the job's scene needs in memory, estimated from its file."""

    def open(self, rank: int, stored: Stored) -> OpenWorkplace:
        """Create the folder with the job's files. On rank 0, also start to store new output files.

        Raises:
            InfrastructureError: If the files cannot be fetched, or the disk is full.
        """

    def after(self, stored: Sequence[Any]) -> Workplace:
        """Return the workplace of the next attempt, which resumes from the stored files."""

    def tidy(self) -> None:
        """Delete folders that killed ranks have left on this machine."""


@dataclass(frozen=True)
class WorkerOptions:
    """Options of running and watching ranks.

    Attributes:
        rank_timeout: Seconds without a response to a poll after which a rank counts as lost.
        preview_folder: Folder of preview images on rank 0's machine; None writes no previews.
        preview_seconds: Minimum seconds between two previews.
        actor: Class of the Ray actor that runs a rank; None for `RankProcess`.
        resume_required: Whether resuming a job fails if no checkpoint can be used.
        workplace: Workplace for ranks on machines without a shared folder; None for this process's working folder.
        plan_file: Plan of a dry run, to use if it was made for the same job; None for none.
        started: Start of the job and of its time budget, in seconds since the epoch; the default is now.
    """

    rank_timeout: float = RunOptions().rank_timeout
    checkpoint_seconds: float = RunOptions().checkpoint_seconds
    preview_folder: Path | None = None
    preview_seconds: float = 20.0
    actor: type[RankProcess] | None = None
    resume_required: bool = True
    workplace: Workplace | None = None
    plan_file: Path | None = None
    started: float = field(default_factory=time.time)


@dataclass(frozen=True)
class RankPlace:
    """Location of a rank's process.

    Attributes:
        node: Ray node ID.
        address: Address under which other nodes reach the node.
        gpus: Assigned GPUs, as CUDA_VISIBLE_DEVICES names them.
    """

    node: str
    address: str
    host: str
    process: ProcessId
    gpus: tuple[str, ...] = ()


@dataclass(frozen=True)
class RankTask:
    """Task of a rank.

    Attributes:
        rank, size: Number of this rank, and number of ranks.
        address: Address "host:port" at which rank 0 listens.
        folder: Base folder of relative paths on every machine; unused with a workplace.
        workers: Requested ranks and lost attempts, for the report.
        seconds_lost, seconds_since_loss: Costs of the last lost attempt until this task was created; see
            `run.LostAttempt`.
    """

    request: JobSpec
    rank: int
    size: int
    address: str
    threads: int
    options: WorkerOptions
    folder: Path
    resume: Resume
    run_id: str
    workers: dict[str, Any]
    seconds_lost: float
    seconds_since_loss: float


@dataclass(frozen=True)
class Outcome:
    """Outcome of a rank.

    Attributes:
        result: Result of the job; None if it failed.
        error: Error with which it failed; None for success.
        trace: Text of the error's traceback.
        echo: Whether the error occurred in an exchange between ranks. The root cause may then be the loss of another
            rank.
    """

    result: Result | None = None
    error: Exception | None = None
    trace: str = ""
    echo: bool = False


@dataclass(frozen=True)
class RankStatus:
    """Status of a rank, which it returns when it is polled.

    Attributes:
        prepared: Summary of the prepared job; set on rank 0 only.
        progress: Latest progress; None before the first stage. Steps are reported on rank 0 only.
        saved: Step of the last checkpoint. With a workplace, a checkpoint counts once it is stored.
        stored: Descriptions of all files that a workplace has stored so far.
        waiting: Seconds for which the rank has been waiting for others; 0 if it is not.
    """

    prepared: Prepared | None = None
    progress: Progress | None = None
    saved: int | None = None
    warnings: tuple[str, ...] = ()
    stored: tuple[Any, ...] = ()
    outcome: Outcome | None = None
    waiting: float = 0.0


class RankProcess:
    """Ray actor of a rank. All methods return immediately."""

    def __init__(self) -> None:
        self._status = RankStatus()
        self._waiting: Waiting | None = None  # set once PyTorch is imported
        self._stop, self._finish = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self._listener: socket.socket | None = None
        die_with_parent()  # a suspended process would not notice the end of its parent, Ray's daemon

    def place(self) -> RankPlace:
        """Return the node, host, process ID and GPUs of this rank."""
        import ray

        node = ray.get_runtime_context().get_node_id()
        gpus = tuple(str(name) for name in ray.get_gpu_ids())
        return RankPlace(node, ray.util.get_node_ip_address(), socket.gethostname(), ProcessId.of_this(), gpus)

    def listen(self, host: str) -> int:
        """Open the socket on which rank 0 accepts the other ranks, and return its port.

        Args:
            host: Address of this machine to bind it to.
        """
        self._listener = listen(host)
        return int(self._listener.getsockname()[1])

    def start(self, task: RankTask) -> None:
        """Start the job in a thread."""
        threading.Thread(target=self._run, args=(task,), daemon=True, name="job").start()

    def poll(self) -> RankStatus:
        """Return the current status. Any response shows the driver that this process is alive."""
        with self._lock:
            return replace(self._status, waiting=self._waiting.seconds if self._waiting else 0.0)

    def stop(self) -> None:
        """Interrupt the job after the current step. The driver calls this on rank 0 only."""
        self._stop.set()

    def finish(self) -> None:
        """End the job after a step, with its present colors as the result. The driver calls this on rank 0 only."""
        self._finish.set()

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._status = replace(self._status, **changes)

    def _run(self, task: RankTask) -> None:
        place: OpenWorkplace | None = None
        try:
            set_thread_variables(task.threads)
            import ray

            # If the variable is not set, a process without an assigned GPU sees all GPUs.
            os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(str(number) for number in ray.get_gpu_ids())
            if task.options.workplace is None:
                _enter_folder(task)
            else:
                place = task.options.workplace.open(task.rank, self._add_stored)
                os.chdir(place.folder)
            self._work(task, place)
        except BaseException as error:
            if self._status.outcome is None:  # an error after the job is done does not matter
                self._update(outcome=_failure(error))
        finally:
            if place is not None:
                self._leave(place)

    @staticmethod
    def _leave(place: OpenWorkplace) -> None:
        os.chdir("/")
        place.close()

    def _work(self, task: RankTask, place: OpenWorkplace | None) -> None:
        import torch

        from worker.ranks.process_group import WAITING, process_group

        self._waiting = WAITING
        torch.set_num_threads(task.threads)
        device = torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else "cpu"
        timeout = timedelta(seconds=task.options.rank_timeout + _PATIENCE)
        with process_group(
            task.rank, task.size, task.address, device=device, timeout=timeout, listener=self._listener
        ) as collectives:
            # The outcome is set before the process group is left, because leaving it may wait for lost ranks.
            try:
                result = self._job(task, collectives)
                if place is not None:
                    place.finish(done=result.stopped != "interrupted")
                    self._leave(place)
                self._update(outcome=Outcome(result))
            except BaseException as error:
                self._update(outcome=_failure(error))

    def _job(self, task: RankTask, collectives: Collectives) -> Result:
        from worker.run import Listener, run_rank

        started, attempts = time.monotonic(), task.workers["attempts"]

        def progress(current: Progress) -> None:
            latest = self._status.progress
            if current.is_step and not (latest and latest.is_step) and attempts:
                since = time.monotonic() - started
                attempts[-1]["seconds_lost"] = round(task.seconds_lost + since, 3)
                attempts[-1]["seconds_to_resume"] = round(task.seconds_since_loss + since, 3)
            self._update(progress=current)

        listener = Listener(
            prepared=lambda prepared: self._update(prepared=prepared),
            progress=progress,
            warn=lambda line: self._update(warnings=(*self._status.warnings, line)),
            stop=self._stop.is_set,
            finish=self._finish.is_set,
            saved=lambda step: self._update(saved=step) if task.options.workplace is None else None,
        )
        return run_rank(
            task.request,
            listener,
            task.options,
            task.resume,
            collectives=collectives,
            run_id=task.run_id,
            about_ranks=task.workers,
        )

    def _add_stored(self, file: Any, step: int | None) -> None:
        with self._lock:
            saved = self._status.saved if step is None else step
            self._status = replace(self._status, stored=(*self._status.stored, file), saved=saved)


def _enter_folder(task: RankTask) -> None:
    """Change to the base folder of relative paths.

    Raises:
        InfrastructureError: If the folder does not exist on this machine, and the job has relative paths.
    """
    if task.folder.is_dir():
        os.chdir(task.folder)
    elif not all(path.is_absolute() for path in _paths(task.request)):
        raise InfrastructureError(
            f"The folder {task.folder} is not on {socket.gethostname()}. Machines that take part in a job need it "
            "under this name, or a service whose files are in an object store."
        )


def _paths(request: JobSpec) -> list[Path]:
    """Return all paths of a request that are not None."""
    styles = [*request.styles, *(style for region in request.regions for style in region.styles)]
    masks = [region.selection.path for region in request.regions if region.selection]
    paths = [request.source.scene, request.source.cameras, *(style.path for style in styles), *masks]
    return [path for path in [*paths, request.images, request.out] if path is not None]


def set_thread_variables(threads: int) -> None:
    """Set the number of threads for libraries that have not been imported yet.

    Numba reads its variable again whenever it compiles, and raises an error if the value differs from that at its
    import. Once Numba is imported, only `compiled.kernel_threads` sets its number of threads.
    """
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    if "numba" not in sys.modules:
        os.environ["NUMBA_NUM_THREADS"] = str(threads)


def _failure(error: BaseException) -> Outcome:
    trace = "".join(traceback.format_exception(error))
    sent = error if isinstance(error, Exception) else RuntimeError(repr(error))
    try:
        pickle.loads(pickle.dumps(sent))
    except Exception:  # the error cannot be pickled, so only its text is sent
        sent = RuntimeError(f"{type(error).__name__}: {error}")
    return Outcome(error=sent, trace=trace, echo=_raised_in_exchange(error))


def _raised_in_exchange(error: BaseException) -> bool:
    """Return whether an error was raised inside torch.distributed, including its store."""
    if type(error).__module__.startswith("torch.distributed"):
        return True
    step = error.__traceback__
    while step is not None:
        if str(step.tb_frame.f_globals.get("__name__", "")).startswith("torch.distributed"):
            return True
        step = step.tb_next
    return False
