"""One rank: the process that Ray starts, its job in a thread of its own, and what it tells the driver meanwhile.

PyTorch is imported in that thread, after the process knows its threads and its GPU.
"""

from __future__ import annotations

import os
import pickle
import socket
import sys
import threading
import time
import traceback
from dataclasses import dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from sgsst_core.errors import InfrastructureError
from worker.processes import ProcessId, die_with_parent, listen

if TYPE_CHECKING:
    from sgsst_core.parallel.collectives import Collectives
    from sgsst_core.planning.progress import PlanningProgress
    from sgsst_core.stylizing.loop import Progress
    from worker.description import Prepared
    from worker.execute import Result
    from worker.request import Resume, StylizeRequest
    from worker.workplace import OpenWorkplace, Workplace

#: Seconds by which an exchange waits longer than the driver: so the driver, which knows which rank gives no answer, is
#: the first to notice.
_PATIENCE = 15.0


@dataclass(frozen=True)
class RankPlace:
    """Where a rank's process is.

    Attributes:
        node: Ray's name of the node.
        address: of the node, as others reach it.
        host: the machine's name.
        process: to end it.
        gpus: that it was given, as CUDA_VISIBLE_DEVICES names them.
    """

    node: str
    address: str
    host: str
    process: ProcessId
    gpus: tuple[str, ...] = ()


@dataclass(frozen=True)
class RankTask:
    """What a rank has to do.

    Attributes:
        request: the job.
        rank, size: in the group.
        address: "host:port" at which rank 0 listens.
        threads: for computing.
        timeout: seconds after which a rank that gives no answer counts as lost.
        folder: from which relative paths are meant, on every machine; without a workplace.
        workplace: where the files are on machines that share no folder; None where they do.
        resume: whether to go on from a checkpoint.
        run_id: identifies the run of the program.
        checkpoint_seconds: between checkpoints.
        preview_folder, preview_seconds: see `attempts.WorkerOptions`.
        workers: for the report: what has happened so far.
        seconds_lost, seconds_since_loss: of the last attempt (see `attempts.LostAttempt`), until this task was made.
    """

    request: StylizeRequest
    rank: int
    size: int
    address: str
    threads: int
    timeout: float
    folder: Path
    resume: Resume
    run_id: str
    checkpoint_seconds: float
    preview_folder: Path | None
    preview_seconds: float
    workers: dict[str, Any]
    seconds_lost: float
    seconds_since_loss: float
    workplace: Workplace | None = None


@dataclass(frozen=True)
class Outcome:
    """How a rank ended.

    Attributes:
        kind: "done", "left-out" (the plan does without this rank) or "failed".
        result: where it is done.
        error: where it failed.
        trace: the traceback's text.
        echo: the error came out of an exchange, as it does when another rank is lost.
    """

    kind: Literal["done", "left-out", "failed"]
    result: Result | None = None
    error: Exception | None = None
    trace: str = ""
    echo: bool = False


@dataclass(frozen=True)
class RankStatus:
    """What a rank answers when it is asked.

    Attributes:
        planning: how far the survey of the views has come; None where there was none.
        prepared: once the inputs have been read; rank 0 alone.
        progress: of the last step; rank 0 alone.
        saved: step of the last checkpoint that this rank has written, or stored where others find it.
        warnings: all so far.
        previews: paths of all pictures so far.
        stored: what a workplace told of all files that it has stored so far.
        outcome: once it has ended.
    """

    planning: PlanningProgress | None = None
    prepared: Prepared | None = None
    progress: Progress | None = None
    saved: int | None = None
    warnings: tuple[str, ...] = ()
    previews: tuple[Path, ...] = ()
    stored: tuple[Any, ...] = ()
    outcome: Outcome | None = None


class RankProcess:
    """The Ray actor of a rank. Every method returns at once."""

    def __init__(self) -> None:
        self._status = RankStatus()
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._listener: socket.socket | None = None
        die_with_parent()  # of Ray's daemon: a stopped process would not notice that it is gone

    def place(self) -> RankPlace:
        """Where this is."""
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
        """Begin."""
        threading.Thread(target=self._run, args=(task,), daemon=True, name="job").start()

    def poll(self) -> RankStatus:
        """The present state: the answer itself is the sign of life."""
        with self._lock:
            return self._status

    def stop(self) -> None:
        """Ask the job to end after the step in hand; on rank 0."""
        self._stop.set()

    def _update(self, **changes: Any) -> None:
        with self._lock:
            self._status = replace(self._status, **changes)

    def _run(self, task: RankTask) -> None:
        place: OpenWorkplace | None = None
        try:
            _set_environment(task)
            if task.workplace is None:
                _enter_folder(task)
            else:
                place = task.workplace.open(task.rank, self._add_stored)
                os.chdir(place.folder)
            self._work(task, place)
        except BaseException as error:
            if self._status.outcome is None:  # who is done may leave the others as it likes
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

        from sgsst_core.parallel.collectives import RankLeftOut
        from worker.ranks.process_group import process_group

        torch.set_num_threads(task.threads)
        device = torch.device("cuda", torch.cuda.current_device()) if torch.cuda.is_available() else "cpu"
        timeout = timedelta(seconds=task.timeout + _PATIENCE)
        with process_group(
            task.rank, task.size, task.address, device=device, timeout=timeout, listener=self._listener
        ) as collectives:
            # The outcome is told inside the block: leaving the group may have to wait for ranks that are lost.
            try:
                result = self._job(task, collectives)
                if place is not None:
                    place.finish(done=result.stopped != "interrupted")
                    self._leave(place)
                self._update(outcome=Outcome("done", result))
            except RankLeftOut:
                self._update(outcome=Outcome("left-out"))
            except BaseException as error:
                self._update(outcome=_failure(error))

    def _job(self, task: RankTask, collectives: Collectives) -> Result:
        from worker.description import describe
        from worker.execute import execute
        from worker.prepare import prepare
        from worker.previews import Previews

        started = time.monotonic()
        job = prepare(
            task.request,
            collectives=collectives,
            resume=task.resume,
            warn=self._add_warning,
            show_planning=lambda planning: self._update(planning=planning),
        )
        job.workers |= task.workers
        if task.rank == 0:
            self._update(prepared=describe(job))

        def progress(current: Progress) -> None:
            if self._status.progress is None and job.workers["attempts"]:
                since = time.monotonic() - started
                lost = job.workers["attempts"][-1]
                lost["seconds_lost"] = round(task.seconds_lost + since, 3)
                lost["seconds_to_resume"] = round(task.seconds_since_loss + since, 3)
            self._update(progress=current)

        return execute(
            job,
            progress=progress,
            stop=self._stop.is_set,
            warn=self._add_warning,
            preview=Previews(task.preview_folder, task.preview_seconds, self._add_preview, self._add_warning)
            if task.preview_folder
            else None,
            saved=lambda step: self._update(saved=step) if task.workplace is None else None,
            checkpoint_seconds=task.checkpoint_seconds,
            run_id=task.run_id,
        )

    def _add_preview(self, path: Path) -> None:
        self._update(previews=(*self._status.previews, path))

    def _add_stored(self, file: Any, step: int | None) -> None:
        with self._lock:
            saved = self._status.saved if step is None else step
            self._status = replace(self._status, stored=(*self._status.stored, file), saved=saved)

    def _add_warning(self, line: str) -> None:
        self._update(warnings=(*self._status.warnings, line))


def _set_environment(task: RankTask) -> None:
    """Set threads and GPU before anything is imported that reads them."""
    set_thread_variables(task.threads)
    import ray

    # A process that was given no GPU would see all of them.
    os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(str(number) for number in ray.get_gpu_ids())


def _enter_folder(task: RankTask) -> None:
    """Make the folder from which relative paths are meant the working folder.

    Raises:
        InfrastructureError: it is not on this machine, and the job has relative paths.
    """
    if task.folder.is_dir():
        os.chdir(task.folder)
    elif not all(path.is_absolute() for path in _paths(task.request)):
        raise InfrastructureError(
            f"The folder {task.folder} is not on {socket.gethostname()}. Machines that take part in a job need it "
            "under this name, or a service whose files are in an object store."
        )


def _paths(request: StylizeRequest) -> list[Path]:
    """All paths of a job that are given."""
    styles = [*request.styles, *(style for region in request.regions for style in region.styles)]
    masks = [region.selection.path for region in request.regions if region.selection]
    found = [request.source.scene, request.source.cameras, *(style.path for style in styles), *masks]
    return [path for path in [*found, request.images, request.out] if path is not None]


def set_thread_variables(threads: int) -> None:
    """Tell libraries that have not been imported yet how many threads to use.

    Numba reads its variable again whenever it compiles, and refuses another value than that of its import: where it has
    been imported, `compiled.kernel_threads` alone says how many of its threads run.
    """
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = str(threads)
    if "numba" not in sys.modules:
        os.environ["NUMBA_NUM_THREADS"] = str(threads)


def _failure(error: BaseException) -> Outcome:
    trace = "".join(traceback.format_exception(error))
    told = error if isinstance(error, Exception) else RuntimeError(repr(error))
    try:
        pickle.loads(pickle.dumps(told))
    except Exception:  # whatever it holds, its text can travel
        told = RuntimeError(f"{type(error).__name__}: {error}")
    return Outcome("failed", error=told, trace=trace, echo=_raised_in_exchange(error))


def _raised_in_exchange(error: BaseException) -> bool:
    """Whether an error was raised inside torch.distributed, or by its store of ranks."""
    if type(error).__module__.startswith("torch.distributed"):
        return True
    step = error.__traceback__
    while step is not None:
        if str(step.tb_frame.f_globals.get("__name__", "")).startswith("torch.distributed"):
            return True
        step = step.tb_next
    return False
