"""Runner of a job, for the command line, the service and every rank: `stylize` runs a whole job, `run_rank` one rank.

One of several ranks is a Ray actor (`RankProcess`) that runs the job in a thread and reports its status to the driver.

Neither PyTorch nor Ray is imported before a job runs: the driver of several ranks computes nothing itself, and a rank
first sets the environment variables for thread counts and GPUs.
"""

from __future__ import annotations

import gc
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
from sgsst_core.progress import Progress
from worker.job import JobSpec, Result, Resume
from worker.options import RunOptions
from worker.processes import ProcessId, die_with_parent, listen

if TYPE_CHECKING:
    from sgsst_core.parallel import Collectives
    from worker.execute import Prepared

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
class Listener:
    """Callbacks of a job. Those of a job on several ranks are called on the thread of `stylize`.

    Attributes:
        prepared: Called once, after the job has been prepared.
        progress: Called with the latest progress; the steps start with the stage "starting". A further attempt on ranks
            repeats the stages before the steps if no earlier attempt has saved its plan.
        warn: Called with warnings, such as about a checkpoint that cannot be written while the job runs.
        stop: Called after each step, or a few times per second; returns True to interrupt the job.
        finish: Called like `stop`; returns True to end the job after a step, with its present colors as the result.
        saved: Called with the step of each checkpoint; not used for ranks.
        happened: Called with a sentence about each lost or resumed attempt on ranks.
        stored: Called with the workplace's description of each stored file, in order.
    """

    prepared: Callable[[Prepared], None] = lambda prepared: None
    progress: Callable[[Progress], None] = lambda progress: None
    warn: Callable[[str], None] = lambda line: None
    stop: Callable[[], bool] = lambda: False
    finish: Callable[[], bool] = lambda: False
    saved: Callable[[int], None] = lambda step: None
    happened: Callable[[str], None] = lambda line: None
    stored: Callable[[Any], None] = lambda file: None


@dataclass
class LostAttempt:
    """Lost attempt on ranks, as listed in the report.

    Attributes:
        first_step: Step at which the attempt started; None if it was lost before its first step.
        saved_step: Step of the checkpoint that the next attempt resumes from.
        seconds_lost: Seconds from the last checkpoint (or the start of the job) to the first step of the next attempt.
        seconds_to_resume: Seconds from the loss to the first step of the next attempt.
    """

    ranks: int
    first_step: int | None
    last_step: int
    saved_step: int
    reason: str
    seconds_lost: float = 0.0
    seconds_to_resume: float = 0.0


@dataclass(frozen=True)
class Ended:
    """End of a job.

    Attributes:
        result: Result of the job; None if it was interrupted and did not finish its step in time.
        step, total: Last completed step and number of all steps; both are 0 if the job was never prepared.
        saved: Step of the last checkpoint; None if there is none.
        attempts: Attempts that were lost.
    """

    result: Result | None
    step: int
    total: int
    saved: int | None
    attempts: Sequence[LostAttempt] = ()

    @property
    def interrupted(self) -> bool:
        """Return whether the job is unfinished."""
        return self.result is None or self.result.stopped == "interrupted"


def stylize(request: JobSpec, workers: int | None, listener: Listener, options: WorkerOptions) -> Ended:
    """Run a job in this process, or on up to `workers` ranks, each in a process of its own.

    Args:
        workers: Maximum number of ranks; None for this process. Painted views need no more.
        options: Options of running and watching ranks.

    Raises:
        SgsstError: If the job fails.
        RanksFailedError: If ranks are lost too often, or fail for a reason that is not an error of the job.
    """
    if request.paintings:
        from worker.painting import run_painting

        result = run_painting(request, listener, options)
        return Ended(result, result.steps, result.total, None)
    if workers is not None:
        from worker.ranks.driver import stylize_on_ranks

        return stylize_on_ranks(request, workers, listener, options=options)
    result = run_rank(request, listener, options, Resume(request.resume, options.resume_required))
    return Ended(result, result.steps, result.total, result.steps)


def run_rank(
    request: JobSpec,
    listener: Listener,
    options: WorkerOptions,
    resume: Resume,
    *,
    collectives: Collectives | None = None,
    run_id: str | None = None,
    about_ranks: dict[str, Any] | None = None,
) -> Result:
    """Prepare a job on this rank, and execute it. Every rank must call this function.

    Args:
        collectives: Collectives of all ranks; None for one rank.
        run_id: Identifier of this run, stored in checkpoints. None generates one.
        about_ranks: Requested ranks and lost attempts, as JSON for the report.

    Raises:
        SgsstError: If the job fails.
    """
    gc.disable()  # imports leave no garbage, and the search for it takes a fifth of their time
    import torch

    from sgsst_core import container
    from sgsst_core.devices import seconds_left
    from sgsst_core.parallel import ALONE
    from worker.execute import Previews, describe, execute, prepare

    gc.enable()

    # what preceded a job of several ranks belongs to its command, on another clock perhaps
    start = max(time.time() - options.started, 0.0) if collectives is None else 0.0
    if collectives is None:  # PyTorch knows the cores of the machine only
        torch.set_num_threads(min(torch.get_num_threads(), container.cores()))
    collectives, folder = collectives or ALONE, options.preview_folder
    left = seconds_left(request.settings.within, options.started)
    preview = Previews(folder, options.preview_seconds, listener.warn) if folder else None
    job = prepare(
        request,
        collectives=collectives,
        resume=resume,
        warn=listener.warn,
        show_planning=listener.progress,
        preview=preview,
        plan_file=options.plan_file,
        left=left,
        start=start,
    )
    job.workers |= about_ranks or {}
    if collectives.rank == 0:
        listener.prepared(describe(job))
    return execute(
        job, listener, preview=preview, checkpoint_seconds=options.checkpoint_seconds, run_id=run_id, left=left
    )


# --- one of several ranks ---------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RankPlace:
    """Location of a rank's process.

    Attributes:
        node: Ray node ID.
        address: Address under which other nodes reach the node.
    """

    node: str
    address: str
    host: str
    process: ProcessId


@dataclass(frozen=True)
class RankTask:
    """Task of a rank.

    Attributes:
        rank, size: Number of this rank, and number of ranks.
        address: Address "host:port" at which rank 0 listens.
        folder: Base folder of relative paths on every machine; unused with a workplace.
        workers: Requested ranks and lost attempts, for the report.
        seconds_lost, seconds_since_loss: Costs of the last lost attempt until this task was created; see
            `LostAttempt`.
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
    """

    prepared: Prepared | None = None
    progress: Progress | None = None
    saved: int | None = None
    warnings: tuple[str, ...] = ()
    stored: tuple[Any, ...] = ()
    outcome: Outcome | None = None


class RankProcess:
    """Ray actor of a rank. All methods return immediately."""

    def __init__(self) -> None:
        self._status = RankStatus()
        self._stop, self._finish = threading.Event(), threading.Event()
        self._lock = threading.Lock()
        self._listener: socket.socket | None = None
        die_with_parent()  # a suspended process would not notice the end of its parent, Ray's daemon

    def place(self) -> RankPlace:
        """Return the node, host and process ID of this rank."""
        import ray

        node = ray.get_runtime_context().get_node_id()
        return RankPlace(node, ray.util.get_node_ip_address(), socket.gethostname(), ProcessId.of_this())

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
        return self._status

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
            if task.options.workplace is not None:
                place = task.options.workplace.open(task.rank, self._add_stored)
            elif not task.folder.is_dir():
                raise InfrastructureError(
                    f"The folder {task.folder} is not on {socket.gethostname()}. Machines that take part in a job need "
                    "it under this name, or a service whose files are in an object store."
                )
            os.chdir(place.folder if place else task.folder)
            self._work(task, place)
        except BaseException as error:
            if self._status.outcome is None:  # an error after the job is done does not matter
                self._update(outcome=_failure(error))
        finally:
            if place is not None:
                place.close()

    def _work(self, task: RankTask, place: OpenWorkplace | None) -> None:
        import torch

        from worker.ranks.process_group import process_group

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
                    place.close()  # already here, because the driver ends this process once it has the outcome
                self._update(outcome=Outcome(result))
            except BaseException as error:
                self._update(outcome=_failure(error))

    def _job(self, task: RankTask, collectives: Collectives) -> Result:
        started, attempts = time.monotonic(), task.workers["attempts"]

        def progress(current: Progress) -> None:
            if attempts and current.is_step and not (self._status.progress and self._status.progress.is_step):
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
    modules = [frame.f_globals.get("__name__") for frame, _ in traceback.walk_tb(error.__traceback__)]
    # An exchange between ranks raises inside torch.distributed, including its store.
    echo = any(str(name).startswith("torch.distributed") for name in (type(error).__module__, *modules))
    return Outcome(error=sent, trace=trace, echo=echo)
