"""Driver of a job on several ranks: start the ranks, watch them, and resume from the last checkpoint after a failure.

An attempt is one set of ranks. When one of them dies, hangs or is killed for lack of memory, all others are ended. If
`failure_policy` allows it, the next attempt resumes the job with as many ranks as the cluster has resources for.
"""

from __future__ import annotations

import secrets
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from worker.ranks.cluster import Cluster
from worker.ranks.failure_policy import FailedAttempt, Failure, check_retry, first_line
from worker.ranks.memory import scene_bytes
from worker.ranks.rank import RankProcess, RankStatus, RankTask, WorkerOptions
from worker.ranks.rank_group import (
    AttemptFailedError,
    RankGroup,
    end_ranks,
    long_wait,
    look_for_losses,
    poll_ranks,
    start_ranks,
)
from worker.run import Ended, Listener, LostAttempt

if TYPE_CHECKING:
    from sgsst_core.progress import Progress
    from worker.job import JobSpec, Result

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
            if first.outcome is not None and first.outcome.kind == "done":
                done_at = done_at or time.monotonic()
                if all(rank.outcome for rank in self._group.handles) or time.monotonic() - done_at > _LAST_WORDS:
                    return first.outcome.result
            else:
                look_for_losses(self._group, self._cluster, self._options.rank_timeout)

    def _task(self, number: int, address: str) -> RankTask:
        from worker.job import Resume

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
