"""Process of one attempt at a job: `python -m service.scheduling.attempt_process FOLDER`.

The folder contains the staged inputs and `task.json`; results go to its subfolder `out`. The process reports events as
lines of JSON on stdout (`Report`), and logs for people on stderr. On SIGTERM it finishes the current step and saves a
checkpoint; on SIGUSR1 it finishes the current step and ends the job with its present colors as the result. It dies with
the dispatcher that started it, and so do the processes that it has started.
"""

import os
import signal
import sys
import threading
import time
import traceback
from pathlib import Path
from typing import TYPE_CHECKING

from service.inputs import PLAN
from service.scheduling.messages import OUTAGE, Ending, Report, Task, cause_of_error, failure
from service.states import AttemptOutcome, Cause
from sgsst_core.errors import RanksFailedError, SgsstError
from sgsst_core.progress import Progress
from worker.processes import die_with_parent, process_start

if TYPE_CHECKING:
    from worker.execute import Prepared
    from worker.job import Result

#: Niceness of CPU jobs, which use all cores: the API takes precedence if it runs on the same machine.
_NICENESS = 5
#: Folder of previews, relative to the attempt's folder.
_PREVIEWS = Path("out", "previews")


def run(task: Task) -> None:
    """Run the attempt and report how it ended, whatever the reason."""
    stopping, finishing = threading.Event(), threading.Event()
    signal.signal(signal.SIGTERM, lambda number, frame: stopping.set())
    signal.signal(signal.SIGUSR1, lambda number, frame: finishing.set())
    send(Report(progress=Progress(stage="reading")))
    try:
        result = _stylize(task, stopping, finishing)
    except Exception as error:
        report_failure(error)
        return
    if result is not None and result.stopped != "interrupted":
        send(Report(ending=Ending(AttemptOutcome.SUCCEEDED, result=result)))


def _stylize(task: Task, stopping: threading.Event, finishing: threading.Event) -> "Result | None":
    from worker.run import Listener, WorkerOptions, stylize

    listener = Listener(
        prepared=report_prepared,
        progress=lambda now: send(Report(progress=now)),
        warn=log,
        stop=stopping.is_set,
        finish=finishing.is_set,
        happened=log,
        stored=lambda file: send(Report(stored=file)),
    )
    options = WorkerOptions(
        checkpoint_seconds=task.checkpoint_seconds,
        preview_folder=_PREVIEWS,
        preview_seconds=task.preview_seconds,
        resume_required=False,
        workplace=task.workplace,
        plan_file=Path(PLAN),
        started=process_start(),
    )
    workers = task.workers if task.workers > 1 or task.cluster else None
    return stylize(task.spec, workers, listener, options).result


def report_failure(error: Exception) -> None:
    """Report the error that ended the attempt. The log gets its traceback only if it is unexpected."""
    send(Report(ending=failure(error)))
    if cause_of_error(error) != Cause.JOB:
        log(OUTAGE["message"])  # the details are for the operator only
    elif isinstance(error, SgsstError) and not isinstance(error, RanksFailedError):
        log(f"error: {error}")
    else:  # unexpected, as is what made ranks fail
        traceback.print_exception(error)


def report_prepared(prepared: "Prepared") -> None:
    """Log the decisions of the plan, and report that the first step starts."""
    for heading, line in prepared.lines:
        log(f"{heading}: {line}")
    send(Report(prepared=True))


def log(line: str) -> None:
    """Write a line to the log for people."""
    print(f"{time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())} {line}", file=sys.stderr, flush=True)


def send(report: Report) -> None:
    """Send a report to the dispatcher."""
    _channel.write(report.model_dump_json(exclude_defaults=True) + "\n")
    _channel.flush()


#: Channel to the dispatcher: the process' original stdout. Output of libraries is redirected to stderr.
_channel = sys.stdout


def main() -> None:
    """Run the task in the folder given on the command line."""
    global _channel
    die_with_parent()
    if not os.environ.get("CUDA_VISIBLE_DEVICES"):  # GPU jobs need little CPU time and must not be delayed
        os.nice(_NICENESS)
    _channel = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    os.chdir(sys.argv[1])
    run(Task.model_validate_json(Path("task.json").read_bytes()))


if __name__ == "__main__":
    main()
