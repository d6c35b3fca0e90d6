"""One attempt at one job, in a process of its own: `python -m service.scheduling.attempt_process FOLDER`.

The folder holds the staged inputs and `task.json`; results go to its `out`. What happens is told in lines of JSON on
stdout (`Message`), what people may want to read on stderr. SIGTERM lets the step in hand finish and saves a checkpoint.
The process dies with the dispatcher that started it, and takes what it started along.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from service.files.staging import Staged
from service.parameters import JobParameters
from service.scheduling.endings import OUTAGE, is_outage
from service.scheduling.messages import Message
from service.scheduling.workplace import StoreWorkplace
from service.store.leases import Published
from worker.processes import die_with_parent

if TYPE_CHECKING:
    from sgsst_core.planning.progress import PlanningProgress
    from sgsst_core.stylizing.loop import Progress
    from worker.description import Prepared
    from worker.execute import Result
    from worker.request import StylizeRequest

#: A job takes every core for as long as it runs. Where that is the service's machine, requests go first; alone on its
#: cores, a job loses nothing by it.
_NICENESS = 5
#: Of previews, in the attempt's folder.
_PREVIEWS = Path("out", "previews")


@dataclass(frozen=True)
class Task:
    """`task.json`.

    Attributes:
        staged: paths of the inputs, relative to the folder.
        parameters: of the job.
        workers: ranks to run it on at most; 1 for this process alone.
        cluster: run even one rank on the Ray cluster.
        resume: go on from the checkpoint in `out`, or in the workplace, where it can be used.
        checkpoint_seconds, preview_seconds: see the settings.
        workplace: of ranks on machines that share no folder with this one; None where they do.
    """

    staged: Staged
    parameters: JobParameters
    workers: int
    cluster: bool
    resume: bool
    checkpoint_seconds: float
    preview_seconds: float
    workplace: StoreWorkplace | None = None

    def save(self, folder: Path) -> None:
        """Write it for `load`."""
        values = {**vars(self), "staged": self.staged.as_json(), "parameters": self.parameters.model_dump(mode="json")}
        values["workplace"] = self.workplace and self.workplace.as_json()
        (folder / "task.json").write_text(json.dumps(values))

    @staticmethod
    def load(folder: Path) -> Task:
        """Read what `save` wrote."""
        values = json.loads((folder / "task.json").read_text())
        staged = Staged.of_json(values.pop("staged"))
        if values["workplace"] is not None:
            values["workplace"] = StoreWorkplace.from_json(values["workplace"])
        return Task(staged, JobParameters(**values.pop("parameters")), **values)


class AttemptProcess:
    """An attempt, in the process that makes it."""

    def __init__(self, task: Task) -> None:
        self._task = task
        self._stopping = threading.Event()

    def run(self) -> None:
        """Run to the end, whatever it is, and tell how it was."""
        signal.signal(signal.SIGTERM, lambda number, frame: self._stopping.set())
        tell({"kind": "stage", "stage": "reading"})
        try:
            result = self._run_on_ranks() if self._task.workers > 1 or self._task.cluster else self._run_alone()
        except Exception as error:
            tell(failure(error))
            if is_outage(error):
                log(OUTAGE["message"])  # what is known of it is the operator's
            else:
                traceback.print_exc()
            return
        if result is None or result.stopped == "interrupted":
            tell({"kind": "interrupted"})
        else:
            tell({"kind": "done", "result": summary(result)})

    def _request(self) -> StylizeRequest:
        from dataclasses import replace

        from service.request import stylize_request

        return replace(stylize_request(self._task.staged, self._task.parameters), resume=self._task.resume)

    def _run_alone(self) -> Result:
        from worker.description import describe
        from worker.execute import execute
        from worker.prepare import prepare
        from worker.previews import Previews
        from worker.request import Resume

        resume = Resume(self._task.resume, required=False)
        job = prepare(self._request(), resume=resume, warn=log, show_planning=tell_planning)
        tell_prepared(describe(job))

        return execute(
            job,
            progress=tell_progress,
            stop=self._stopping.is_set,
            warn=log,
            preview=Previews(_PREVIEWS, self._task.preview_seconds, tell_preview, log),
            checkpoint_seconds=self._task.checkpoint_seconds,
        )

    def _run_on_ranks(self) -> Result | None:
        from worker.ranks.attempts import WorkerOptions, stylize_on_ranks
        from worker.ranks.listener import Listener

        listener = Listener(
            planning=tell_planning,
            prepared=tell_prepared,
            progress=tell_progress,
            happened=log,
            warn=log,
            stop=self._stopping.is_set,
            preview=tell_preview,
            left_out=tell_left_out,
            stored=tell_stored,
        )
        options = WorkerOptions(
            checkpoint_seconds=self._task.checkpoint_seconds,
            preview_folder=_PREVIEWS,
            preview_seconds=self._task.preview_seconds,
            resume_required=False,
            workplace=self._task.workplace,
        )
        return stylize_on_ranks(self._request(), self._task.workers, listener, options=options).result


def tell_planning(now: PlanningProgress) -> None:
    """How far the survey of the views has come; its steps are views."""
    tell(
        {
            "kind": "stage",
            "stage": "planning",
            "step": now.done,
            "total": now.total,
            "seconds_left": now.seconds_left,
        }
    )


def tell_prepared(prepared: Prepared) -> None:
    """What was decided, for the log, and where the steps begin."""
    for heading, line in prepared.lines:
        log(f"{heading}: {line}")
    tell({"kind": "prepared", "step": prepared.step, "total": prepared.total})


def tell_progress(now: Progress) -> None:
    """A step."""
    tell(
        {
            "kind": "progress",
            "stage": now.stage,
            "step": now.step,
            "total": now.total,
            "loss": now.loss,
            "seconds": now.seconds,
            "seconds_left": now.seconds_left,
            "scales": list(now.scales) or None,
        }
    )


def tell_left_out(gpus: Sequence[str]) -> None:
    """GPUs that the plan does without."""
    tell({"kind": "left-out", "gpus": list(gpus)})


def tell_stored(file: Published) -> None:
    """A file that a rank has put into the store of files."""
    tell({"kind": "stored", "file": asdict(file)})


def tell_preview(path: Path) -> None:
    """A picture of the running job."""
    tell({"kind": "preview", "path": str(path)})


def summary(result: Result) -> dict[str, Any]:
    """What a job's record says about its end; the report has the rest."""
    before, after = result.losses
    return {
        "stopped": result.stopped,
        "steps": result.step,
        "loss_before": before,
        "loss_after": after,
        "report_error": result.report_error,
    }


def failure(error: Exception) -> Message:
    """An error as it is told: whether the same would happen again decides whether the job is tried again."""
    from sgsst_core.errors import DivergedError, InvalidInputError, SgsstError

    if is_outage(error):
        detail = "".join(traceback.format_exception(error))
        return {"kind": "failed", "error": OUTAGE, "permanent": False, "detail": detail}
    code = error.code if isinstance(error, SgsstError) else "out-of-memory" if _out_of_memory(error) else "internal"
    message = (
        str(error) if isinstance(error, SgsstError) or _out_of_memory(error) else f"{type(error).__name__}: {error}"
    )
    permanent = isinstance(error, InvalidInputError | DivergedError)
    return {"kind": "failed", "error": {"code": code, "message": message}, "permanent": permanent}


def _out_of_memory(error: Exception) -> bool:
    text = str(error)
    return isinstance(error, MemoryError) or "can't allocate memory" in text or "out of memory" in text


def log(line: str) -> None:
    """A line for people."""
    print(f"{time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())} {line}", file=sys.stderr, flush=True)


def tell(message: Message) -> None:
    """A line for the dispatcher."""
    _channel.write(json.dumps(message) + "\n")
    _channel.flush()


#: Messages go through the stdout that the process was given; what libraries print goes to stderr from then on.
_channel = sys.stdout


def main() -> None:
    """Run the task of the folder that the command line names."""
    global _channel
    die_with_parent()
    if not os.environ.get("CUDA_VISIBLE_DEVICES"):  # a GPU's work is not in the way, and must not wait
        os.nice(_NICENESS)
    _channel = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    os.chdir(sys.argv[1])
    AttemptProcess(Task.load(Path())).run()


if __name__ == "__main__":
    main()
