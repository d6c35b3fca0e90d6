"""Runner of a job, for the command line, the service and every rank: `stylize` runs a whole job, `run_rank` one rank.

Neither PyTorch nor Ray is imported before a job runs: the driver of several ranks computes nothing itself.
"""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from worker.job import JobSpec, Result, Resume
from worker.ranks.rank import WorkerOptions

if TYPE_CHECKING:
    from sgsst_core.parallel import Collectives
    from sgsst_core.progress import Progress
    from worker.prepare import Prepared


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
        happened: Called with a sentence about each lost or resumed attempt on ranks, and about a long wait for a rank.
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
    from worker.execute import execute
    from worker.prepare import Previews, describe, prepare

    gc.enable()

    # what preceded a job of several ranks belongs to its command, on another clock perhaps
    start = max(time.time() - options.started, 0.0) if collectives is None else 0.0
    if collectives is None:  # PyTorch knows the cores of the machine only
        torch.set_num_threads(min(torch.get_num_threads(), container.cores()))
    preview, collectives = None, collectives or ALONE
    left = seconds_left(request.settings.within, options.started)
    if options.preview_folder:
        preview = Previews(options.preview_folder, options.preview_seconds, listener.warn)
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
