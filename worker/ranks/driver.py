"""Driver of a job on several ranks: start the ranks, watch them, and resume from the last checkpoint after a failure.

Who watches whom: the driver polls each rank, and ends all of them when one dies, hangs or is killed for lack of memory.
Ranks notice each other's end by broken connections, and Ray's daemons end ranks that outlive their parent. A sweeper
(`worker.processes`) watches the driver, and ends what is left of its local Ray instance.

An attempt is one set of ranks. An error of the job itself would occur again, so it is raised at once. After any other
failure, the next attempt resumes the job with as many ranks as the cluster has resources for, as long as attempts make
progress. An error that occurs twice at the same step is raised, and several attempts in a row without progress are the
last ones.
"""

from __future__ import annotations

import contextlib
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NoReturn

from sgsst_core.errors import ClusterAwayError, InfrastructureError, RanksDriftedError, RanksFailedError, SgsstError
from worker.job import JobSpec, Result, Resume, scene_bytes
from worker.processes import ProcessId, home, kill
from worker.ranks.cluster import Cluster, NoCapacityError, Reservation, first_line, reserve
from worker.ranks.rank import Outcome, RankPlace, RankProcess, RankStatus, RankTask, WorkerOptions, Workplace
from worker.run import Ended, Listener, LostAttempt

if TYPE_CHECKING:
    from sgsst_core.progress import Progress


#: Seconds that an interrupted job has to finish its step and save a checkpoint.
STOP_SECONDS = 10.0
#: Seconds that the other ranks have to exit after rank 0 is done.
_LAST_WORDS = 5.0


def stylize_on_ranks(
    request: JobSpec,
    workers: int,
    listener: Listener | None = None,
    *,
    options: WorkerOptions | None = None,
    cluster: Cluster | None = None,
) -> Ended:
    """Run one job on up to `workers` ranks, in as many attempts as necessary.

    Args:
        workers: Maximum number of ranks.
        listener: Callbacks for the events of the job; None ignores all events.
        options: Options of running and watching ranks; None for the defaults.
        cluster: Open cluster, which is not closed. None opens a cluster for this job, which must be done on the main
            thread.

    Raises:
        SgsstError: If the job itself fails, as it would on one rank.
        RanksFailedError: If ranks are lost too often, or fail for a reason that is not an error of the job.
    """
    if cluster is None:
        with Cluster(workers) as own:
            return stylize_on_ranks(request, workers, listener, options=options, cluster=own)
    return _Attempts(request, workers, listener or Listener(), options or WorkerOptions(), cluster).run()


class _Attempts:
    """Sequence of attempts at one job."""

    def __init__(
        self, request: JobSpec, workers: int, listener: Listener, options: WorkerOptions, cluster: Cluster
    ) -> None:
        self._request = request
        self._workers = workers
        self._listener, self._options, self._cluster = listener, options, cluster
        self._run_id = secrets.token_hex(8)
        self._failed: list[FailedAttempt] = []
        self._lost: list[LostAttempt] = []
        self._relay = Relay(listener, self._report_resumed)
        self._group = RankGroup()
        self._lost_at = time.monotonic()

    def run(self) -> Ended:
        """Start attempts until the job has ended.

        Raises:
            Exception: If the failure policy raises a rank's error.
            RanksFailedError: If the failure policy gives up.
        """
        while True:
            relay, before = self._relay, self._relay.farthest
            try:
                return self._ended(self._attempt())
            except AttemptFailedError as error:
                failure = error.failure
            self._failed.append(FailedAttempt(failure, relay.last_step, relay.farthest != before))
            count = len(self._group.handles) or self._workers
            self._lost.append(LostAttempt(count, relay.first_step, relay.last_step, relay.saved or 0, failure.reason))
            self._listener.happened(check_retry(self._failed))
            if self._listener.stop():
                return self._ended(None)

    def _ended(self, result: Result | None) -> Ended:
        step = result.steps if result else self._relay.step
        return Ended(result, step, self._relay.total, self._relay.saved, self._lost)

    # --- one attempt -----------------------------------------------------------------------------------------------

    def _attempt(self) -> Result | None:
        """Start ranks and watch them until they end. Return None if they had to be killed after an interruption.

        Raises:
            AttemptFailedError: If the attempt ends before the job is done.
        """
        import ray

        self._relay.begin_attempt()
        self._group = RankGroup()
        try:
            if not self._cluster.alive():
                self._cluster.close()
                self._cluster.open()
            start_ranks(self._group, self._workers, self._scene_bytes(), self._options.actor or RankProcess, self._task)
            return self._watch()
        except (ray.exceptions.RayError, ConnectionError) as error:
            own = isinstance(error, ray.exceptions.RayTaskError | ray.exceptions.OutOfMemoryError)
            kind: Literal["loss", "machine"] = "loss" if own else "machine"
            raise AttemptFailedError(Failure(kind, f"Ray failed: {first_line(error)}", error)) from error
        finally:
            self._lost_at = time.monotonic()
            end_ranks(self._group, self._cluster, self._options.workplace)

    def _watch(self) -> Result | None:
        first = self._group.handles[0]
        deadline: float | None = None
        done_at: float | None = None
        finishing = False
        said: str | None = None
        while True:
            if deadline is None and self._listener.stop():
                deadline = time.monotonic() + STOP_SECONDS
                first.actor.stop.remote()
            if not finishing and self._listener.finish():
                finishing = True
                first.actor.finish.remote()
            if deadline is not None and time.monotonic() > deadline:
                return None
            poll_ranks(self._group)
            self._relay.pass_on(first.status)
            if self._relay.before_steps and (line := long_wait(self._group)) and line != said:
                self._listener.happened(said := line)
            if first.outcome is not None and first.outcome.error is None:
                done_at = done_at or time.monotonic()
                if all(rank.outcome for rank in self._group.handles) or time.monotonic() - done_at > _LAST_WORDS:
                    return first.outcome.result
            else:
                look_for_losses(self._group, self._cluster, self._options.rank_timeout)

    def _task(self, number: int, address: str) -> RankTask:
        reservation, workplace = self._group.reservation, self._options.workplace
        assert reservation is not None
        resume = Resume(self._request.resume, self._options.resume_required)
        if self._lost:  # only checkpoints of this run, unless the user wanted to resume
            resume = Resume(True, required=False, run=None if self._request.resume else self._run_id)
        return RankTask(
            request=self._request,
            rank=number,
            size=len(self._group.handles),
            address=address,
            threads=reservation.threads,
            options=replace(self._options, workplace=workplace and workplace.after(self._relay.stored)),
            folder=Path.cwd(),
            resume=resume,
            run_id=self._run_id,
            workers={"requested": self._workers, "attempts": [asdict(attempt) for attempt in self._lost]},
            seconds_lost=time.monotonic() - self._relay.safe_at,
            seconds_since_loss=time.monotonic() - self._lost_at,
        )

    def _scene_bytes(self) -> int:
        """Return the estimated bytes of the refined scene in memory; 0 if this machine cannot access its file."""
        workplace, scene = self._options.workplace, self._request.source.scene
        try:
            size = workplace.scene_bytes if workplace else scene_bytes(scene.name, scene.stat().st_size)
        except OSError:
            return 0
        return int(size * self._request.settings.growth)

    def _report_resumed(self) -> None:
        """Report that the job has resumed after a loss, and record how long the recovery took."""
        if not self._lost or self._lost[-1].seconds_to_resume:
            return
        now = time.monotonic()
        lost = self._lost[-1]
        lost.seconds_lost, lost.seconds_to_resume = round(now - self._relay.safe_at, 3), round(now - self._lost_at, 3)
        ranks = len(self._group.handles)
        self._listener.happened(
            f"Resuming from step {self._relay.first_step} with {ranks} worker{'s' if ranks > 1 else ''}, "
            f"{lost.seconds_to_resume:.1f} s after the loss."
        )


class Relay:
    """Relay that passes each event of rank 0 to a listener once, and tracks the progress of the job.

    Args:
        resumed: Callback after the first step of an attempt, before the listener is notified.

    Attributes:
        step: Highest step of all attempts.
        total: Number of all steps; 0 until an attempt is prepared.
        saved: Step of the last checkpoint; None if there is none.
        first_step: Step at which the current attempt started; None until it is prepared.
        last_step: Last step of the current attempt, or the step that it resumed from.
        stored: Descriptions of all stored files of all attempts.
        safe_at: Time of the last checkpoint, or of the start of the job, in monotonic seconds.
    """

    def __init__(self, listener: Listener, resumed: Callable[[], None]) -> None:
        self._listener, self._resumed = listener, resumed
        self.step = self.total = self.last_step = 0
        self.saved: int | None = None
        self.first_step: int | None = None
        self.safe_at = time.monotonic()
        self._prepared = False
        self._progress: Progress | None = None
        self._warned = self._reported_files = 0
        self.stored: list[Any] = []

    @property
    def farthest(self) -> tuple[int, int | None]:
        """Return the highest step and the step of the last checkpoint. One of them changes with any progress."""
        return self.step, self.saved

    @property
    def before_steps(self) -> bool:
        """Return whether the current attempt has not made a step."""
        return self._progress is None or not self._progress.is_step

    def begin_attempt(self) -> None:
        """Reset the state of the current attempt for a new set of ranks."""
        self.first_step, self.last_step = None, self.saved or 0
        self._warned = self._reported_files = 0
        self._progress = None

    def pass_on(self, status: RankStatus) -> None:
        """Notify the listener of everything that is new in the latest status of rank 0."""
        for line in status.warnings[self._warned :]:
            self._listener.warn(line)
        self._warned = len(status.warnings)
        for file in status.stored[self._reported_files :]:
            self.stored.append(file)
            self._listener.stored(file)
        self._reported_files = len(status.stored)
        if status.progress is not None and not status.progress.is_step:
            self._pass_on_progress(status.progress)
        if status.prepared is not None and self.first_step is None:
            self.first_step = self.last_step = status.prepared.step
            self.total = status.prepared.total
            if not self._prepared:
                self._prepared = True
                self._listener.prepared(status.prepared)
        if status.progress is not None and status.progress.is_step:
            self._pass_on_progress(status.progress)
        if status.saved is not None and status.saved != self.saved:
            self.saved, self.safe_at = status.saved, time.monotonic()
            self.last_step = max(self.last_step, status.saved)  # not every step is reported
            self.step = max(self.step, self.last_step)

    def _pass_on_progress(self, progress: Progress) -> None:
        if progress == self._progress:
            return
        self._progress = progress
        if progress.is_step and progress.step != self.last_step:
            if self.last_step == self.first_step:
                self._resumed()
            self.last_step = progress.step
            self.step = max(self.step, self.last_step)
        self._listener.progress(progress)


# --- ranks of one attempt ---------------------------------------------------------------------------------------------


class AttemptFailedError(Exception):
    """Error if an attempt ends before its job is done."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.reason)
        self.failure = failure


@dataclass
class RankHandle:
    """Handle of one rank.

    Attributes:
        group: Ray placement group that the actor runs in.
        place: Location of the rank's process; None until the rank has reported it.
        pending_poll: Ray reference to the response to a pending poll; None if no poll is pending.
        polled_at, answered_at: Times of the last poll and the last response, in monotonic seconds.
        status: Latest status that the rank has returned.
    """

    actor: Any
    group: Any
    place: RankPlace | None = None
    pending_poll: Any = None
    polled_at: float = 0.0
    answered_at: float = field(default_factory=time.monotonic)
    status: RankStatus = field(default_factory=RankStatus)

    @property
    def outcome(self) -> Outcome | None:
        """Return the outcome of the rank; None while it runs."""
        return self.status.outcome

    @property
    def silence(self) -> float:
        """Return the seconds since the last response."""
        return time.monotonic() - self.answered_at


@dataclass
class RankGroup:
    """Ranks of one attempt, ordered by number.

    Attributes:
        handles: Handles of the ranks; empty until they are started.
        reservation: Reserved resources; None before the reservation and after its release.
    """

    handles: list[RankHandle] = field(default_factory=list)
    reservation: Reservation | None = None

    def name_of(self, rank: RankHandle) -> str:
        """Return the name of a rank for messages."""
        where = f" on {rank.place.host}" if rank.place else ""
        return f"Worker {self.handles.index(rank)}{where}"


#: Seconds that the processes of all ranks may take to start; eight at once share the cores of a busy machine.
START_SECONDS = 180.0
#: Function that creates the task of a rank from its number and the "host:port" of rank 0, once all ranks are started.
MakeTask = Callable[[int, str], RankTask]


def start_ranks(group: RankGroup, workers: int, scene: int, actor: type[RankProcess], make_task: MakeTask) -> None:
    """Start as many ranks as the cluster has resources for, and send each its task.

    Args:
        group: Empty group to fill. If an error is raised, it holds the ranks that were started.
        workers: Maximum number of ranks.
        scene: Bytes of the job's scene, for the host memory to reserve on machines with GPUs.
        actor: Class of the Ray actor that runs a rank.

    Raises:
        AttemptFailedError: If there are no free resources.
        RayError: If a process does not start in time.
    """
    import ray

    try:
        group.reservation = reserve(workers, scene)
    except NoCapacityError as error:
        raise AttemptFailedError(Failure("loss", str(error), ClusterAwayError(f"{error}."))) from error
    kind = ray.remote(actor)
    reserved = zip(group.reservation.actor_options(), group.reservation.groups, strict=True)
    group.handles = [RankHandle(kind.options(**options).remote(), place) for options, place in reserved]
    places = _from_all(group, "place")
    for rank, place in zip(group.handles, places, strict=True):
        rank.place = place
    group.handles = _numbered(group.handles, ray.get_runtime_context().get_node_id())
    address = _address(group.handles)
    _from_all(group, "start", [(make_task(number, address),) for number in range(len(group.handles))])
    for rank in group.handles:
        rank.answered_at = time.monotonic()


def _from_all(group: RankGroup, method: str, arguments: list[tuple[Any, ...]] | None = None) -> list[Any]:
    """Call a method of all ranks concurrently, and return the results."""
    import ray

    given = arguments or [()] * len(group.handles)
    calls = [getattr(rank.actor, method).remote(*own) for rank, own in zip(group.handles, given, strict=True)]
    return ray.get(calls, timeout=START_SECONDS)


def _numbered(handles: list[RankHandle], here: str) -> list[RankHandle]:
    """Return the ranks in the order of their numbers.

    Rank 0 writes the files, so it is a rank on the driver's machine if there is one. Ranks of one machine get
    consecutive numbers.
    """

    def order(rank: RankHandle) -> tuple[bool, str]:
        place = _place(rank)
        return place.node != here, place.node

    return sorted(handles, key=order)


def _address(handles: list[RankHandle]) -> str:
    """Make rank 0 listen, and return its "host:port"."""
    import ray

    alone = len({_place(rank).node for rank in handles}) == 1
    host = "127.0.0.1" if alone else _place(handles[0]).address
    return f"{host}:{ray.get(handles[0].actor.listen.remote(host), timeout=START_SECONDS)}"


def _place(rank: RankHandle) -> RankPlace:
    assert rank.place is not None  # all ranks report their location before they are numbered
    return rank.place


#: Seconds between two polls of a rank.
POLL_SECONDS = 0.25
#: Seconds to wait for a response that Ray reports as ready.
_FETCH_SECONDS = 60.0
#: Reason of a rank's death with its machine.
_MACHINE_GONE = "its machine is gone"
#: Seconds to wait for the root cause after a rank has lost its connection to another rank.
_GRACE = 3.0


def poll_ranks(group: RankGroup) -> None:
    """Poll every rank, and store the responses that have arrived.

    Raises:
        AttemptFailedError: If the process of a rank has ended.
    """
    import ray

    now = time.monotonic()
    for rank in group.handles:
        if rank.pending_poll is None and now - rank.polled_at >= POLL_SECONDS:
            rank.pending_poll, rank.polled_at = rank.actor.poll.remote(), now
    polls = {rank.pending_poll: rank for rank in group.handles if rank.pending_poll is not None}
    if not polls:
        time.sleep(POLL_SECONDS / 4)
        return
    ready, _ = ray.wait(list(polls), num_returns=len(polls), timeout=POLL_SECONDS)
    for poll in ready:
        _take_answer(group, polls[poll], poll)


def _take_answer(group: RankGroup, rank: RankHandle, poll: Any) -> None:
    import ray

    rank.pending_poll = None
    try:
        rank.status = ray.get(poll, timeout=_FETCH_SECONDS)
        rank.answered_at = time.monotonic()
    except ray.exceptions.ActorUnavailableError:  # may be temporary: the timeout decides
        return
    except ray.exceptions.ActorDiedError as error:
        reason = _reason_of_death(error)
        raise _lost(f"{group.name_of(rank)} was lost: {reason}", machine=reason == _MACHINE_GONE) from error
    except ray.exceptions.RayActorError as error:
        raise _lost(f"{group.name_of(rank)} was lost: {first_line(error)}") from error


def look_for_losses(group: RankGroup, cluster: Cluster, rank_timeout: float) -> None:
    """Raise an error with the root cause if a rank has failed or was lost.

    Args:
        cluster: Ray cluster that runs them.
        rank_timeout: Seconds without a response after which a rank counts as lost.

    Raises:
        AttemptFailedError: If a rank has failed or does not respond, or if Ray has ended.
    """
    _look_for_reasons(group, cluster)
    silent = max(group.handles, key=lambda rank: rank.silence)
    if silent.silence > rank_timeout:
        raise _silent(group, silent)
    for rank in group.handles:
        if rank.outcome is not None and rank.outcome.error is not None:
            _wait_for_the_reason(group, cluster, rank, rank.outcome.error)


#: Seconds of waiting for others before the first step that are reported.
LONG_WAIT = 60.0


def long_wait(group: RankGroup) -> str | None:
    """Return a sentence about the ranks that wait long for others, and what these do; None if no rank waits long."""
    waiting = [rank for rank in group.handles if rank.status.waiting > LONG_WAIT]
    if not waiting:
        return None
    others = [rank for rank in group.handles if rank not in waiting and rank.outcome is None]
    doing = [
        f"{group.name_of(rank)} ({rank.status.progress.stage if rank.status.progress else 'reading'})"
        for rank in others
    ]
    names = ", ".join(map(group.name_of, waiting))
    return f"Waiting for more than {LONG_WAIT:.0f} s: {names}. " + (
        f"Still at work: {', '.join(doing)}."
        if others
        else "All wait for each other's messages: check the network between their machines."
    )


def _wait_for_the_reason(group: RankGroup, cluster: Cluster, failed: RankHandle, error: Exception) -> NoReturn:
    """Wait for the cause of a rank's broken connection and raise it.

    A connection breaks when another rank ends, but it takes a moment until the driver knows which one.
    """
    started = time.monotonic()
    while time.monotonic() - started < _GRACE:
        poll_ranks(group)
        _look_for_reasons(group, cluster)
    silent = max(group.handles, key=lambda rank: rank.silence)
    if silent.silence > _GRACE:
        raise _silent(group, silent)
    raise _lost(f"{group.name_of(failed)} lost its connection: {first_line(error)}", error)


def _look_for_reasons(group: RankGroup, cluster: Cluster) -> None:
    """Raise an error if Ray has ended, or if a rank has failed for a reason other than the loss of another rank."""
    if not cluster.alive():
        raise _lost("Ray's own processes on this machine were lost", machine=True)
    for rank in group.handles:
        outcome = rank.outcome
        if outcome is None or outcome.error is None or outcome.echo:
            continue
        failure = failure_of(outcome.error, group.name_of(rank))
        if failure.kind == "loss" or isinstance(outcome.error, InfrastructureError):
            outcome.error.add_note(f"{group.name_of(rank)}:\n{outcome.trace}")
        raise AttemptFailedError(failure)


def _silent(group: RankGroup, rank: RankHandle) -> AttemptFailedError:
    remote = rank.place is not None and rank.place.process.home != home()
    return _lost(f"{group.name_of(rank)} was lost: it has not answered for {rank.silence:.0f} s", machine=remote)


def _lost(reason: str, error: Exception | None = None, *, machine: bool = False) -> AttemptFailedError:
    return AttemptFailedError(Failure("machine" if machine else "loss", reason, error))


def _reason_of_death(error: Exception) -> str:
    """Return a short description of Ray's reason for the end of a rank's process."""
    text = " ".join(str(error).split())
    if "memory" in text.lower() and "low on memory" in text.lower():
        return "killed, because its machine had run out of memory"
    if "SIGKILL" in text or "Worker unexpectedly exits" in text or "connection error code" in text:
        return "its process was killed"
    if "node" in text.lower() and ("died" in text or "dead" in text):
        return _MACHINE_GONE
    return first_line(error)


#: Seconds to wait for processes on other machines to end.
_REMOTE_SECONDS = 5.0


def end_ranks(group: RankGroup, cluster: Cluster, workplace: Workplace | None = None) -> None:
    """End all ranks of an attempt, release their resources, and delete the folders that they leave in a workplace."""
    kill([rank.place.process for rank in group.handles if rank.place and rank.place.process.home == home()])
    if cluster.alive():
        # If a rank cannot be reached, the Ray daemon of its node ends it.
        with contextlib.suppress(Exception):
            _end_remote(group, workplace)
    if workplace is not None:
        workplace.tidy()
    group.reservation = None


def _end_remote(group: RankGroup, workplace: Workplace | None) -> None:
    import ray

    for rank in group.handles:
        ray.kill(rank.actor, no_restart=True)
    if group.reservation is not None:
        group.reservation.release()
    places = [rank.place for rank in group.handles if rank.place and rank.place.process.home != home()]
    pending = [_kill_on(place).remote([place.process], workplace) for place in places]
    if pending:
        ray.wait(pending, num_returns=len(pending), timeout=_REMOTE_SECONDS)


def _kill_on(place: RankPlace) -> Any:
    """Return a Ray task that ends processes on the node of a rank."""
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    def end(processes: list[ProcessId], workplace: Workplace | None) -> None:
        kill(processes)
        if workplace is not None:
            workplace.tidy()

    strategy = NodeAffinitySchedulingStrategy(place.node, soft=False)
    return ray.remote(end).options(num_cpus=0, max_retries=0, scheduling_strategy=strategy)


# --- policy after a failed attempt ------------------------------------------------------------------------------------

#: Maximum number of attempts in a row without progress.
MOST_ATTEMPTS = 3


@dataclass(frozen=True)
class Failure:
    """Cause of a failed attempt.

    Attributes:
        kind: "job" for an error of the job itself; "machine" for ranks that were lost with their machine, the network
            or Ray; "loss" for ranks that died or failed for another reason.
        reason: Short description without a full stop.
        error: Error that a rank raised; None if it died before it raised.
    """

    kind: Literal["job", "loss", "machine"]
    reason: str
    error: Exception | None = None


@dataclass(frozen=True)
class FailedAttempt:
    """Outcome of a failed attempt, for `check_retry`.

    Attributes:
        last_step: Last completed step, or the step that the attempt started from.
        progressed: Whether the attempt completed a step or saved a checkpoint that no earlier attempt had reached.
    """

    failure: Failure
    last_step: int
    progressed: bool


def failure_of(error: Exception, rank: str) -> Failure:
    """Classify an error that a rank raised."""
    if isinstance(error, SgsstError) and not isinstance(error, RanksDriftedError):
        return Failure("job", str(error), error)
    return Failure("loss", f"{rank} failed: {first_line(error)}", error)


def check_retry(attempts: Sequence[FailedAttempt]) -> str:
    """Return a sentence about the last of these attempts if another one may help.

    Args:
        attempts: All failed attempts of the job in order; at least one.

    Raises:
        Exception: Error that a rank raised, if it is one of the job itself or occurred twice at the same step.
        RanksFailedError: If another attempt is unlikely to help.
        ClusterAwayError: If it is unlikely to help because of a machine, the network or Ray.
    """
    last = attempts[-1]
    failure = last.failure
    give_up = ClusterAwayError if failure.kind == "machine" else RanksFailedError
    if failure.kind == "job" and failure.error is not None:
        raise failure.error
    ends = [(attempt.failure.reason, attempt.last_step) for attempt in attempts[-2:]]
    if failure.error is not None and not last.progressed and len(ends) == 2 and ends[0] == ends[1]:
        if isinstance(failure.error, SgsstError | MemoryError | RuntimeError):
            raise failure.error
        raise give_up(f"{failure.reason}; the same happened twice at step {last.last_step}.") from failure.error
    in_vain = len(list(takewhile(lambda attempt: not attempt.progressed, reversed(attempts))))
    if in_vain >= MOST_ATTEMPTS:
        farthest = max(attempt.last_step for attempt in attempts)
        raise give_up(
            f"{in_vain} attempts in a row came no further than step {farthest}. The last one: {failure.reason}."
        ) from failure.error
    return f"{failure.reason}, after step {last.last_step}."
