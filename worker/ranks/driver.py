"""Driver of a job on several ranks: start the ranks, watch them, and resume from the last checkpoint after a failure.

Who watches whom: the driver polls each rank, and ends all of them when one dies, hangs or is killed for lack of memory.
Ranks notice each other's end by broken connections, and Ray's daemons end ranks that outlive their parent. A sweeper
(`worker.processes`) watches the driver, and ends what is left of its local Ray instance.

An attempt is one set of ranks. An error of the job itself would occur again, so it is raised at once. After any other
failure, the next attempt resumes the job with as many ranks as the cluster has resources for, until several attempts in
a row make no progress.
"""

import contextlib
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from sgsst_core.errors import ClusterAwayError, RanksDriftedError, RanksFailedError, SgsstError
from sgsst_core.progress import Progress
from worker.job import JobSpec, Result, Resume, scene_bytes
from worker.processes import ProcessId, home, kill
from worker.ranks.cluster import Cluster, NoCapacityError, Reservation, first_line, reserve
from worker.run import (
    Ended,
    Listener,
    LostAttempt,
    RankPlace,
    RankProcess,
    RankStatus,
    RankTask,
    WorkerOptions,
    Workplace,
)

#: Seconds that an interrupted job has to finish its step and save a checkpoint.
STOP_SECONDS = 10.0


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
        self._lost: list[LostAttempt] = []
        self._in_vain = 0
        self._relay = Relay(listener, self._report_resumed)
        self._group = RankGroup()
        self._lost_at = time.monotonic()

    def run(self) -> Ended:
        """Start attempts until the job has ended.

        Raises:
            Exception: If the failure policy raises a rank's error.
            RanksFailedError: If the failure policy gives up.
        """
        relay = self._relay
        while True:
            before = relay.farthest
            try:
                return self._ended(self._attempt())
            except AttemptFailedError as error:
                failure = error
            self._in_vain = 0 if relay.farthest != before else self._in_vain + 1
            count = len(self._group.handles) or self._workers
            self._lost.append(LostAttempt(count, relay.first_step, relay.last_step, relay.saved or 0, failure.reason))
            self._listener.happened(check_retry(failure, self._lost, self._in_vain))
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
            raise AttemptFailedError("loss" if own else "machine", f"Ray failed: {first_line(error)}", error) from error
        finally:
            self._lost_at = time.monotonic()
            end_ranks(self._group, self._cluster, self._options.workplace)

    def _watch(self) -> Result | None:
        first = self._group.handles[0]
        deadline: float | None = None
        while True:
            if deadline is None and self._listener.stop():
                deadline = time.monotonic() + STOP_SECONDS
                first.actor.stop.remote()
            if self._listener.finish():
                first.actor.finish.remote()
            if deadline is not None and time.monotonic() > deadline:
                return None
            poll_ranks(self._group)
            self._relay.pass_on(first.status)
            if (outcome := first.status.outcome) and outcome.error is None:
                return outcome.result
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
        self._progress: Progress | None = None
        self._warned = self._reported_files = 0
        self.stored: list[Any] = []

    @property
    def farthest(self) -> tuple[int, int | None]:
        """Return the highest step and the step of the last checkpoint. One of them changes with any progress."""
        return self.step, self.saved

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
        if status.prepared is not None and self.first_step is None:
            if not self.total:  # else an earlier attempt was prepared
                self._listener.prepared(status.prepared)
            self.first_step = self.last_step = status.prepared.step
            self.total = status.prepared.total
        if status.progress is not None and status.progress != self._progress:
            self._pass_on_progress(status.progress)
        if status.saved is not None and status.saved != self.saved:
            self.saved, self.safe_at = status.saved, time.monotonic()
            self.last_step = max(self.last_step, status.saved)  # not every step is reported
            self.step = max(self.step, self.last_step)

    def _pass_on_progress(self, progress: Progress) -> None:
        self._progress = progress
        if progress.is_step and progress.step != self.last_step:
            if self.last_step == self.first_step:
                self._resumed()
            self.last_step = progress.step
            self.step = max(self.step, self.last_step)
        self._listener.progress(progress)


# --- ranks of one attempt ---------------------------------------------------------------------------------------------


@dataclass(eq=False)
class AttemptFailedError(Exception):
    """Error if an attempt ends before its job is done.

    Attributes:
        kind: "job" for an error of the job itself; "machine" for ranks that were lost with their machine, the network
            or Ray; "loss" for ranks that died or failed for another reason.
        reason: Short description without a full stop.
        error: Error that a rank raised; None if it died before it raised.
    """

    kind: Literal["job", "loss", "machine"]
    reason: str
    error: Exception | None = None


@dataclass
class RankHandle:
    """Handle of one rank.

    Attributes:
        place: Location of the rank's process; None until the rank has reported it.
        pending_poll: Ray reference to the response to a pending poll; None if no poll is pending.
        answered_at: Time of the last response, in monotonic seconds.
        status: Latest status that the rank has returned.
    """

    actor: Any
    place: RankPlace | None = None
    pending_poll: Any = None
    answered_at: float = field(default_factory=time.monotonic)
    status: RankStatus = field(default_factory=RankStatus)

    @property
    def silence(self) -> float:
        """Return the seconds since the last response."""
        return time.monotonic() - self.answered_at


@dataclass
class RankGroup:
    """Ranks of one attempt, ordered by number.

    Attributes:
        handles: Handles of the ranks; empty until they are started.
        reservation: Reserved resources; None before the reservation.
        broken_at: Time at which a rank has reported a lost connection, in monotonic seconds; None if none has.
    """

    handles: list[RankHandle] = field(default_factory=list)
    reservation: Reservation | None = None
    broken_at: float | None = None

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
        raise AttemptFailedError("loss", str(error), ClusterAwayError(f"{error}.")) from error
    kind = ray.remote(actor)
    options = map(group.reservation.actor_options, range(group.reservation.ranks))
    group.handles = [RankHandle(kind.options(**each).remote()) for each in options]
    places: list[RankPlace] = ray.get([rank.actor.place.remote() for rank in group.handles], timeout=START_SECONDS)
    for rank, place in zip(group.handles, places, strict=True):
        rank.place = place
    # Rank 0 writes the files, so it is a rank on this machine if there is one. Ranks of one machine follow each other.
    here = ray.get_runtime_context().get_node_id()
    order = sorted(range(len(places)), key=lambda index: (places[index].node != here, places[index].node))
    group.handles, places = [group.handles[index] for index in order], [places[index] for index in order]
    host = "127.0.0.1" if len({place.node for place in places}) == 1 else places[0].address
    address = f"{host}:{ray.get(group.handles[0].actor.listen.remote(host), timeout=START_SECONDS)}"
    started = [rank.actor.start.remote(make_task(number, address)) for number, rank in enumerate(group.handles)]
    ray.get(started, timeout=START_SECONDS)
    for rank in group.handles:
        rank.answered_at = time.monotonic()


#: Seconds before each poll of the ranks, and seconds to wait for their responses.
POLL_SECONDS = 0.1
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

    time.sleep(POLL_SECONDS)
    for rank in group.handles:
        if rank.pending_poll is None:
            rank.pending_poll = rank.actor.poll.remote()
    polls = {rank.pending_poll: rank for rank in group.handles}
    ready, _ = ray.wait(list(polls), num_returns=len(polls), timeout=POLL_SECONDS)
    for poll in ready:
        rank = polls[poll]
        rank.pending_poll = None
        try:
            rank.status = ray.get(poll, timeout=_FETCH_SECONDS)
            rank.answered_at = time.monotonic()
        except ray.exceptions.ActorUnavailableError:  # may be temporary: the timeout decides
            continue
        except ray.exceptions.RayActorError as error:
            reason = _reason_of_death(error)
            raise AttemptFailedError(
                "machine" if reason == _MACHINE_GONE else "loss", f"{group.name_of(rank)} was lost: {reason}"
            ) from error


def look_for_losses(group: RankGroup, cluster: Cluster, rank_timeout: float) -> None:
    """Raise an error with the root cause if a rank has failed or was lost.

    A rank's connection breaks when another rank ends, but it takes a moment until the driver knows which one.

    Args:
        cluster: Ray cluster that runs them.
        rank_timeout: Seconds without a response after which a rank counts as lost.

    Raises:
        AttemptFailedError: If a rank has failed or does not respond, or if Ray has ended.
    """
    if not cluster.alive():
        raise AttemptFailedError("machine", "Ray's own processes on this machine were lost")
    now, broken = time.monotonic(), None
    for rank in group.handles:
        outcome = rank.status.outcome
        if outcome is None or outcome.error is None:
            continue
        name, error = group.name_of(rank), outcome.error
        if not outcome.echo:
            error.add_note(f"{name}:\n{outcome.trace}")
            raise failure_of(error, name)
        broken = broken or f"{name} lost its connection: {first_line(error)}"
        group.broken_at = group.broken_at or now
    waited = group.broken_at is not None and now - group.broken_at > _GRACE
    silent = max(group.handles, key=lambda rank: rank.silence)
    if silent.silence > (_GRACE if waited else rank_timeout):
        remote = silent.place is not None and silent.place.process.home != home()
        reason = f"{group.name_of(silent)} was lost: it has not answered for {silent.silence:.0f} s"
        raise AttemptFailedError("machine" if remote else "loss", reason)
    if waited and broken:
        raise AttemptFailedError("loss", broken)


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
    import ray
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    places = [rank.place for rank in group.handles if rank.place]
    _end([place.process for place in places if place.process.home == home()], workplace)
    # If a rank cannot be reached, the Ray daemon of its node ends it.
    with contextlib.suppress(Exception):
        if not cluster.alive():
            return
        for rank in group.handles:
            ray.kill(rank.actor, no_restart=True)
        if group.reservation is not None:
            group.reservation.release()
        pending = []
        for place in places:
            if place.process.home != home():
                strategy = NodeAffinitySchedulingStrategy(place.node, soft=False)
                end = ray.remote(_end).options(num_cpus=0, max_retries=0, scheduling_strategy=strategy)
                pending.append(end.remote([place.process], workplace))
        if pending:
            ray.wait(pending, num_returns=len(pending), timeout=_REMOTE_SECONDS)


def _end(processes: Sequence[ProcessId], workplace: Workplace | None) -> None:
    """End processes of this machine, and delete the folders that they leave in a workplace."""
    kill(processes)
    if workplace is not None:
        workplace.tidy()


# --- policy after a failed attempt ------------------------------------------------------------------------------------

#: Maximum number of attempts in a row without progress.
MOST_ATTEMPTS = 3


def failure_of(error: Exception, rank: str) -> AttemptFailedError:
    """Classify an error that a rank raised."""
    if isinstance(error, SgsstError) and not isinstance(error, RanksDriftedError):
        return AttemptFailedError("job", str(error), error)
    return AttemptFailedError("loss", f"{rank} failed: {first_line(error)}", error)


def check_retry(failure: AttemptFailedError, attempts: Sequence[LostAttempt], in_vain: int) -> str:
    """Return a sentence about the last of these attempts if another one may help.

    Args:
        failure: Cause of the end of the last attempt.
        attempts: All lost attempts of the job in order; at least one.
        in_vain: Number of the last attempts without progress: none of them has completed a step or saved a checkpoint
            that no earlier attempt had reached.

    Raises:
        Exception: Error that a rank raised, if it is one of the job itself, or the last attempt ended with it.
        RanksFailedError: If another attempt is unlikely to help.
        ClusterAwayError: If it is unlikely to help because of a machine, the network or Ray.
    """
    error = failure.error
    if error is not None and failure.kind == "job":
        raise error
    if in_vain >= MOST_ATTEMPTS:
        if isinstance(error, SgsstError | MemoryError | RuntimeError):
            raise error
        farthest = max(attempt.last_step for attempt in attempts)
        give_up = ClusterAwayError if failure.kind == "machine" else RanksFailedError
        raise give_up(
            f"{in_vain} attempts in a row came no further than step {farthest}. The last one: {failure.reason}."
        ) from error
    return f"{failure.reason}, after step {attempts[-1].last_step}."
