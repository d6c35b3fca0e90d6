"""One job on several ranks, whatever becomes of them: start them, watch them, and go on from the last checkpoint.

An attempt is one set of ranks. When one of them dies, hangs or is killed for memory, all the others are ended, and
the next attempt goes on with as many as there is room for. Errors that would come again are not tried again.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sgsst_core.errors import RanksDriftedError, RanksFailedError, SgsstError
from worker.processes import ProcessId, home, kill
from worker.ranks.cluster import Cluster
from worker.ranks.placement import NoRoomError, Reservation, reserve
from worker.ranks.rank import Outcome, Place, RankProcess, Status, Task

if TYPE_CHECKING:
    from sgsst_core.stylizing.loop import Progress
    from worker.job import Prepared, Result
    from worker.request import Resume, StylizeRequest

#: Seconds between two questions to a rank.
POLL_SECONDS = 0.25
#: Seconds that a process of a rank may take to start.
START_SECONDS = 60.0
#: Seconds that a stopping job has to finish its step and to save it.
STOP_SECONDS = 10.0
#: Attempts in a row that come no further than those before them.
MOST_ATTEMPTS = 3
#: Seconds for the reason to show, after a rank has lost its connection to another one.
_GRACE = 3.0
#: Seconds that the other ranks have to end, once the first one has.
_LAST_WORDS = 5.0


@dataclass(frozen=True)
class WorkerOptions:
    """How ranks are watched.

    Attributes:
        rank_timeout: seconds without an answer after which a rank counts as lost.
        checkpoint_seconds: between checkpoints.
        preview_folder: of pictures of the running job, as rank 0's machine sees it; None for none.
        preview_seconds: between two pictures, at least.
        actor: what runs a rank.
    """

    rank_timeout: float = 120.0
    checkpoint_seconds: float = 60.0
    preview_folder: Path | None = None
    preview_seconds: float = 20.0
    actor: type[RankProcess] = RankProcess


@dataclass(frozen=True)
class Listener:
    """Who is told what happens; everything is called on the thread of `stylize_on_ranks`.

    Attributes:
        prepared: once, when the inputs have been read and planned with.
        progress: after steps, the last of them, a few times a second.
        happened: what became of ranks and attempts, in a sentence.
        warn: what is worth knowing although the job goes on.
        stop: asked a few times a second; True ends the job as "interrupted".
        preview: path of each picture of the running job.
        left_out: GPUs of this machine that the job has let go of, because the plan does without them.
    """

    prepared: Callable[[Prepared], None] = lambda prepared: None
    progress: Callable[[Progress], None] = lambda progress: None
    happened: Callable[[str], None] = lambda line: None
    warn: Callable[[str], None] = lambda line: None
    stop: Callable[[], bool] = lambda: False
    preview: Callable[[Path], None] = lambda path: None
    left_out: Callable[[Sequence[str]], None] = lambda gpus: None


@dataclass
class Attempt:
    """A set of ranks that was lost.

    Attributes:
        ranks: how many there were.
        first_step: at which they began; None where they never did.
        last_step: that they made.
        saved_step: of the checkpoint that the next attempt goes on from.
        reason: why they were lost.
        seconds_lost: from the last checkpoint before the loss (or the attempt's beginning) to the next attempt's first
            step.
        seconds_to_resume: the part of it from the loss on.
    """

    ranks: int
    first_step: int | None
    last_step: int
    saved_step: int
    reason: str
    seconds_lost: float = 0.0
    seconds_to_resume: float = 0.0


@dataclass(frozen=True)
class RanksResult:
    """How a job on several ranks ended.

    Attributes:
        result: as on one rank; None where the job was interrupted and did not end its step in time.
        step, total: the last one made, and of all; 0 where the first was never made.
        saved: step of the last checkpoint; None where there is none.
        attempts: that were lost on the way.
    """

    result: Result | None
    step: int
    total: int
    saved: int | None
    attempts: list[Attempt]

    @property
    def interrupted(self) -> bool:
        """Whether it is unfinished."""
        return self.result is None or self.result.stopped == "interrupted"


def stylize_on_ranks(
    request: StylizeRequest,
    workers: int,
    listener: Listener | None = None,
    *,
    options: WorkerOptions | None = None,
    cluster: Cluster | None = None,
) -> RanksResult:
    """Run one job on up to `workers` ranks, as often as it takes.

    Args:
        cluster: an open one, which stays open; None opens one for this job, which takes the main thread.

    Raises:
        SgsstError: of the job itself, as one rank would raise it.
        RanksFailedError: the ranks were lost again and again, or failed for a reason that is no error of the job.
    """
    if cluster is None:
        with Cluster(workers) as own:
            return stylize_on_ranks(request, workers, listener, options=options, cluster=own)
    return _Job(request, workers, listener or Listener(), options or WorkerOptions(), cluster).run()


class _Lost(Exception):  # noqa: N818 (the job goes on)
    """An attempt's ranks are lost."""

    def __init__(self, reason: str, error: Exception | None = None) -> None:
        super().__init__(reason)
        self.reason = reason
        self.error = error


@dataclass
class _Rank:
    """One rank of the present attempt."""

    actor: Any
    place: Place | None = None
    question: Any = None
    asked: float = 0.0
    answered: float = field(default_factory=time.monotonic)
    status: Status = field(default_factory=Status)

    @property
    def outcome(self) -> Outcome | None:
        return self.status.outcome

    @property
    def left_out(self) -> bool:
        """Whether the job goes on without it, whatever becomes of it."""
        return self.outcome is not None and self.outcome.kind == "left-out"

    @property
    def silence(self) -> float:
        """Seconds since its last answer."""
        return 0.0 if self.left_out else time.monotonic() - self.answered


class _Job:
    """All attempts of one job."""

    def __init__(
        self, request: StylizeRequest, workers: int, listener: Listener, options: WorkerOptions, cluster: Cluster
    ) -> None:
        self._request = request
        self._asked = self._workers = workers
        self._listener = listener
        self._options = options
        self._cluster = cluster
        self._run = secrets.token_hex(8)
        self._attempts: list[Attempt] = []
        self._ranks: list[_Rank] = []
        self._reservation: Reservation | None = None
        self._step = self._total = 0  # the farthest of all attempts
        self._first_step: int | None = None  # of the present attempt
        self._last_step = 0
        self._saved: int | None = None
        self._prepared = False
        self._warned = self._previewed = 0
        self._useless = 0  # attempts in a row without progress
        self._let_go = False  # of GPUs that Ray still takes for its own
        self._safe_at = self._lost_at = time.monotonic()

    def run(self) -> RanksResult:
        while True:
            before = (self._step, self._saved)
            self._safe_at = time.monotonic() if not self._attempts else self._safe_at
            try:
                try:
                    return self._ended(self._attempt())
                except self._ray_errors() as error:
                    raise _Lost(f"Ray failed: {_first_line(error)}", error) from error
                finally:
                    self._lost_at = time.monotonic()
                    self._end_ranks()
            except _Lost as lost:
                self._note(lost, useless=(self._step, self._saved) == before)
            if self._listener.stop():
                return self._ended(None)

    def _ended(self, result: Result | None) -> RanksResult:
        step = result.step if result else self._step
        return RanksResult(result, step, self._total, self._saved, self._attempts)

    @staticmethod
    def _ray_errors() -> tuple[type[Exception], ...]:
        import ray

        return (ray.exceptions.RayError, ConnectionError)

    # --- one attempt -----------------------------------------------------------------------------------------------

    def _attempt(self) -> Result | None:
        """Start ranks and watch them to their end; None where they had to be stopped by force."""
        self._first_step, self._last_step = None, self._saved or 0
        self._warned = self._previewed = 0
        if self._let_go or not self._cluster.alive():
            self._cluster.close()
            self._cluster.open()
            self._let_go = False
        self._start()
        deadline: float | None = None
        ended: float | None = None
        while True:
            if deadline is None and self._listener.stop():
                deadline = time.monotonic() + STOP_SECONDS
                self._ranks[0].actor.stop.remote()
            if deadline is not None and time.monotonic() > deadline:
                return None
            self._ask()
            self._show()
            first = self._ranks[0].outcome
            if first is not None and first.kind == "done":
                ended = ended or time.monotonic()
                if all(rank.outcome for rank in self._ranks) or time.monotonic() - ended > _LAST_WORDS:
                    return first.result
            else:
                self._look_for_losses()

    def _start(self) -> None:
        import ray

        try:
            self._reservation = reserve(self._workers)
        except NoRoomError as error:
            raise _Lost(str(error)) from error
        kind = ray.remote(self._options.actor)
        self._ranks = [_Rank(kind.options(**options).remote()) for options in self._reservation.actor_options()]
        places = ray.get([rank.actor.place.remote() for rank in self._ranks], timeout=START_SECONDS)
        for rank, place in zip(self._ranks, places, strict=True):
            rank.place = place
        # Rank 0 writes the files: it belongs where the driver is. Neighbours share a machine.
        here = ray.get_runtime_context().get_node_id()
        order = sorted(range(len(places)), key=lambda index: (places[index].node != here, places[index].node))
        self._ranks = [self._ranks[index] for index in order]
        alone = len({place.node for place in places}) == 1
        host = "127.0.0.1" if alone else places[order[0]].address
        address = f"{host}:{ray.get(self._ranks[0].actor.free_port.remote(), timeout=START_SECONDS)}"
        tasks = [self._task(number, address) for number in range(len(self._ranks))]
        ray.get(
            [rank.actor.start.remote(task) for rank, task in zip(self._ranks, tasks, strict=True)],
            timeout=START_SECONDS,
        )
        for rank in self._ranks:
            rank.answered = time.monotonic()

    def _task(self, number: int, address: str) -> Task:
        assert self._reservation is not None
        return Task(
            request=self._request,
            rank=number,
            size=len(self._ranks),
            address=address,
            threads=self._reservation.threads,
            timeout=self._options.rank_timeout,
            folder=Path.cwd(),
            resume=self._resume(),
            run=self._run,
            checkpoint_seconds=self._options.checkpoint_seconds,
            preview_folder=self._options.preview_folder,
            preview_seconds=self._options.preview_seconds,
            workers={"asked": self._asked, "attempts": [asdict(attempt) for attempt in self._attempts]},
            seconds_lost=time.monotonic() - self._safe_at,
            seconds_since_loss=time.monotonic() - self._lost_at,
        )

    def _resume(self) -> Resume:
        """The first attempt does what the user asked for; later ones go on from what this job has saved."""
        from worker.request import Resume

        if not self._attempts:
            return Resume(self._request.resume)
        return Resume(True, required=False, run=None if self._request.resume else self._run)

    def _ask(self) -> None:
        """Ask every rank how it is, and take in what has been answered."""
        import ray

        now = time.monotonic()
        for rank in self._ranks:
            if rank.question is None and not rank.left_out and now - rank.asked >= POLL_SECONDS:
                rank.question, rank.asked = rank.actor.poll.remote(), now
        questions = {rank.question: rank for rank in self._ranks if rank.question is not None}
        if not questions:
            time.sleep(POLL_SECONDS / 4)
            return
        ready, _ = ray.wait(list(questions), num_returns=len(questions), timeout=POLL_SECONDS)
        for question in ready:
            rank = questions[question]
            rank.question = None
            try:
                rank.status = ray.get(question, timeout=START_SECONDS)
                rank.answered = time.monotonic()
                if rank.left_out:
                    self._leave_out(rank)
            except ray.exceptions.ActorUnavailableError:  # perhaps only for now: the time-out decides
                continue
            except ray.exceptions.ActorDiedError as error:
                raise _Lost(f"{self._name(rank)} was lost: {_reason_of_death(error)}", None) from error
            except ray.exceptions.RayActorError as error:
                raise _Lost(f"{self._name(rank)} was lost: {_first_line(error)}", None) from error

    def _leave_out(self, rank: _Rank) -> None:
        """End a rank that the plan does without, and let go of its GPU.

        On a cluster its place stays reserved until the attempt ends: Ray gives places back together only.
        """
        import ray

        assert rank.place is not None
        if not self._cluster.local:
            return
        ray.kill(rank.actor, no_restart=True)
        kill([rank.place.process])  # what it held of the GPU is free when it is gone
        if not rank.place.gpus:
            return
        kept = [gpu for other in self._ranks if other.place and not other.left_out for gpu in other.place.gpus]
        self._workers, self._let_go = len(kept), True
        os.environ["CUDA_VISIBLE_DEVICES"] = ",".join(kept)  # for the next attempt
        self._listener.left_out(rank.place.gpus)

    def _show(self) -> None:
        """Pass on what rank 0 has to tell."""
        status = self._ranks[0].status
        for line in status.warnings[self._warned :]:
            self._listener.warn(line)
        self._warned = len(status.warnings)
        for path in status.previews[self._previewed :]:
            self._listener.preview(path)
        self._previewed = len(status.previews)
        if status.prepared is not None and self._first_step is None:
            self._first_step = self._last_step = status.prepared.step
            self._total = status.prepared.total
            if not self._prepared:
                self._prepared = True
                self._listener.prepared(status.prepared)
        if status.progress is not None and status.progress.step != self._last_step:
            if self._last_step == self._first_step:
                self._running_again()
            self._last_step = status.progress.step
            self._step = max(self._step, self._last_step)
            self._listener.progress(status.progress)
        if status.saved is not None and status.saved != self._saved:
            self._saved, self._safe_at = status.saved, time.monotonic()

    def _running_again(self) -> None:
        """The first step after a loss."""
        if not self._attempts or self._attempts[-1].seconds_to_resume:
            return
        now = time.monotonic()
        lost = self._attempts[-1]
        lost.seconds_lost, lost.seconds_to_resume = round(now - self._safe_at, 3), round(now - self._lost_at, 3)
        count = f"{len(self._ranks)} worker{'s' if len(self._ranks) > 1 else ''}"
        self._listener.happened(
            f"Going on from step {self._first_step} with {count}, {lost.seconds_to_resume:.1f} s after the loss."
        )

    def _look_for_losses(self) -> None:
        """Raise what ended a rank: the error of the job itself, or the loss behind it."""
        if not self._cluster.alive():
            raise _Lost("Ray's own processes on this machine were lost")
        failed = [rank for rank in self._ranks if rank.outcome and rank.outcome.kind == "failed"]
        for rank in failed:
            assert rank.outcome is not None
            if not rank.outcome.echo:
                self._raise_failure(rank, rank.outcome)
        silent = max(self._ranks, key=lambda rank: rank.silence)
        if silent.silence > self._options.rank_timeout:
            raise self._silent(silent)
        if not failed:
            return
        # Connections break when another rank ends: wait until it shows which, and why.
        started = time.monotonic()
        while time.monotonic() - started < _GRACE:
            self._ask()
            if not self._cluster.alive():
                raise _Lost("Ray's own processes on this machine were lost")
            for rank in self._ranks:
                if rank.outcome and rank.outcome.kind == "failed" and not rank.outcome.echo:
                    self._raise_failure(rank, rank.outcome)
        outcome = failed[0].outcome
        assert outcome is not None
        if silent.silence > _GRACE:
            raise self._silent(silent)
        raise _Lost(f"{self._name(failed[0])} lost its connection: {_first_line(outcome.error)}", outcome.error)

    def _silent(self, rank: _Rank) -> _Lost:
        return _Lost(f"{self._name(rank)} was lost: it has not answered for {rank.silence:.0f} s")

    def _raise_failure(self, rank: _Rank, outcome: Outcome) -> None:
        assert outcome.error is not None
        if isinstance(outcome.error, SgsstError) and not isinstance(outcome.error, RanksDriftedError):
            raise outcome.error
        outcome.error.add_note(outcome.trace)
        raise _Lost(f"{self._name(rank)} failed: {_first_line(outcome.error)}", outcome.error)

    def _name(self, rank: _Rank) -> str:
        where = f" on {rank.place.host}" if rank.place else ""
        return f"Worker {self._ranks.index(rank)}{where}"

    # --- between attempts ------------------------------------------------------------------------------------------

    def _note(self, lost: _Lost, *, useless: bool) -> None:
        """Write down a loss, and tell it.

        Raises:
            Exception: what the last two attempts failed with, where it was the same at the same step.
            RanksFailedError: nothing is gained by another attempt.
        """
        again = bool(self._attempts) and (lost.reason, self._last_step) == (
            self._attempts[-1].reason,
            self._attempts[-1].last_step,
        )
        self._useless = self._useless + 1 if useless else 0
        saved = self._saved or 0
        count = len(self._ranks) or self._workers
        self._attempts.append(Attempt(count, self._first_step, self._last_step, saved, lost.reason))
        if again and useless and lost.error is not None:
            if isinstance(lost.error, SgsstError | MemoryError | RuntimeError):
                raise lost.error
            raise RanksFailedError(f"{lost.reason}; the same happened twice at step {self._last_step}.") from lost.error
        if self._useless >= MOST_ATTEMPTS:
            raise RanksFailedError(
                f"{self._useless} attempts in a row came no further than step {self._step}. The last one: "
                f"{lost.reason}."
            ) from lost.error
        self._listener.happened(f"{lost.reason}, after step {self._last_step}.")

    def _end_ranks(self) -> None:
        """End every rank of the attempt, whatever state it is in, and give its place back."""
        local = [rank.place.process for rank in self._ranks if rank.place and rank.place.process.home == home()]
        kill(local)
        if self._cluster.alive():
            # What cannot be reached any more cannot be ended either, and its own node's daemon does it.
            with contextlib.suppress(Exception):
                self._end_remote()
        self._reservation = None

    def _end_remote(self) -> None:
        import ray

        for rank in self._ranks:
            ray.kill(rank.actor, no_restart=True)
        if self._reservation is not None:
            self._reservation.release()
        places = [rank.place for rank in self._ranks if rank.place and rank.place.process.home != home()]
        pending = [_kill_on(place).remote([place.process]) for place in places]
        if pending:
            ray.wait(pending, num_returns=len(pending), timeout=5.0)


def _kill_on(place: Place) -> Any:
    """A task that ends processes on a rank's node: a stopped process does not listen to Ray."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def end(processes: list[ProcessId]) -> None:
        kill(processes)

    strategy = NodeAffinitySchedulingStrategy(place.node, soft=False)
    return ray.remote(end).options(num_cpus=0, max_retries=0, scheduling_strategy=strategy)


def _first_line(error: BaseException | None) -> str:
    lines = str(error).strip().splitlines()
    return lines[0].rstrip(".") if lines else type(error).__name__


def _reason_of_death(error: Exception) -> str:
    """What Ray knows about the end of a rank's process, in a few words."""
    text = " ".join(str(error).split())
    if "memory" in text.lower() and "low on memory" in text.lower():
        return "killed, because its machine had run out of memory"
    if "SIGKILL" in text or "Worker unexpectedly exits" in text or "connection error code" in text:
        return "its process was killed"
    if "node" in text.lower() and ("died" in text or "dead" in text):
        return "its machine is gone"
    return _first_line(error)
