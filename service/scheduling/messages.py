"""Messages between a dispatcher and the process of an attempt: task, reports, and how the attempt ended."""

import errno
import re
import signal
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any

from pydantic import BaseModel

from service.inputs import CHECKPOINT, scene_size
from service.problems import DatabaseUnavailableError, NoSpaceError, StoreError
from service.states import AttemptOutcome, Cause, Published
from sgsst_core import errors
from sgsst_core.progress import Progress
from worker.job import JobSpec, Result
from worker.run import Stored

if TYPE_CHECKING:
    from service.scheduling.attempt_files import RankFolder


@dataclass(frozen=True)
class StoreWorkplace:
    """Description of a job's files for its ranks.

    Attributes:
        job_id, epoch: Prefix of the job's stored files.
        inputs: `role`, `name`, `sha256` and `size` of each input, for `stage`.
        files: Contents of the inputs.
        checkpoint: Checkpoint to resume from; None for none.
        weights: Feature network weights; empty to use the machine's own.
    """

    url: str
    job_id: str
    epoch: int
    inputs: tuple[dict[str, Any], ...]
    files: tuple[Published, ...]
    checkpoint: Published | None
    weights: tuple[Published, ...]

    @property
    def scene_bytes(self) -> int:
        """Size of the scene in bytes, once it is read."""
        return scene_size(self.inputs)

    def open(self, rank: int, stored: Stored) -> "RankFolder":
        """Stage the job's files for a rank.

        Missing files are fetched once into the machine's cache, which all its ranks share.

        Raises:
            InfrastructureError: If the store is unreachable or has lost a file, or the disk is full.
        """
        from service.scheduling.attempt_files import RankFolder

        try:
            return RankFolder(self, rank, stored)
        except OSError as error:
            raise errors.InfrastructureError(f"The job's files cannot be staged here: {error}.") from error

    def after(self, stored: Sequence[Published]) -> "StoreWorkplace":
        """Return a copy whose checkpoint is the last one among these files."""
        saved = [file for file in stored if file.name == CHECKPOINT]
        return replace(self, checkpoint=saved[-1]) if saved else self

    def tidy(self) -> None:
        """Remove folders of dead ranks on this machine."""
        from service.scheduling.attempt_files import remove_leftovers

        remove_leftovers()


class Task(BaseModel):
    """Content of `task.json`.

    Attributes:
        spec: Specification of the job, with paths relative to the folder. Whether it resumes depends on a checkpoint,
            which is in `out` or in the workplace and may turn out to be unusable.
        workers: Maximum number of ranks; 1 runs the job in this process alone.
        cluster: Whether to run even a single rank on the Ray cluster.
        workplace: Description of the job's files for ranks on machines that share no folder with this one; None if all
            ranks share the folder.
    """

    spec: JobSpec
    workers: int
    cluster: bool
    checkpoint_seconds: float
    preview_seconds: float
    workplace: StoreWorkplace | None = None


class StopRequest(StrEnum):
    """External request to end a running attempt."""

    #: The user has canceled the job.
    CANCEL = "cancel"
    #: The dispatcher is shutting down: save the job's state and return the job to the queue.
    RELEASE = "release"
    #: Another dispatcher has the job: nothing more may be written.
    ABANDON = "abandon"


#: Error of an attempt that has failed because of a machine, a network or the file store, without the `cause`.
OUTAGE = {
    "code": errors.InfrastructureError.code,
    "message": "A machine of the service, its network or its store of files failed. The job will be retried.",
}
#: Causes by type of error; the first match counts. Jobs write to folders of the service, so output errors are the
#: disk's, and only an operator can install missing weights.
_CAUSES: tuple[tuple[type[BaseException], Cause], ...] = (
    (NoSpaceError, Cause.DISK),
    (StoreError, Cause.STORE),
    (DatabaseUnavailableError, Cause.DATABASE),
    (errors.OutputError, Cause.DISK),
    (errors.InfrastructureError, Cause.MACHINE),
    (errors.WeightsError, Cause.MACHINE),
)
#: Error numbers of a full, broken or read-only disk, and of a file system that cannot be reached.
_DISK_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.ESTALE, errno.ENOTCONN, errno.ENODEV)
#: Text of a full disk in the errors of libraries that drop the number, such as safetensors and NumPy.
_FULL = re.compile(r"No space left on device|Disk quota exceeded|requested and \d+ written")


def cause_of_error(error: BaseException) -> Cause:
    """Return what an error that ended an attempt is the fault of."""
    known = next((cause for kind, cause in _CAUSES if isinstance(error, kind)), None)
    if known is not None:
        return known
    if isinstance(error, OSError) and error.errno in _DISK_ERRORS:
        return Cause.DISK
    return Cause.DISK if _FULL.search(str(error)) else Cause.JOB


def outage(cause: Cause) -> dict[str, Any]:
    """Return the recorded error of an attempt that ended for another cause than the job."""
    return {**OUTAGE, "cause": cause}


@dataclass(frozen=True)
class Ending:
    """End of an attempt.

    Attributes:
        outcome: Outcome for the record: SUCCEEDED, CANCELED, RELEASED or FAILED.
        error: Error of a failure: `code`, `message` and further members.
        permanent: Whether another attempt would fail in the same way.
        detail: Details of a failure for the operator only.
    """

    outcome: AttemptOutcome
    result: Result | None = None
    error: dict[str, Any] | None = None
    permanent: bool = False
    detail: str | None = None


def failure(error: Exception) -> Ending:
    """Return the ending for an error; the error is permanent if a retry would fail in the same way."""
    cause = cause_of_error(error)
    if cause != Cause.JOB:
        detail = "".join(traceback.format_exception(error))
        return Ending(AttemptOutcome.FAILED, error=outage(cause), detail=detail)
    code, message = "internal", f"{type(error).__name__}: {error}"
    if isinstance(error, errors.SgsstError) or errors.is_out_of_memory(error):
        code, message = error.code if isinstance(error, errors.SgsstError) else "out-of-memory", str(error)
    permanent = isinstance(error, errors.InvalidInputError | errors.DivergedError)
    return Ending(AttemptOutcome.FAILED, error={"code": code, "message": message}, permanent=permanent)


class Report(BaseModel):
    """Report of an attempt's process to its dispatcher, a line of JSON; one of its fields is set.

    Attributes:
        prepared: Whether the inputs have been read, so that the first step starts.
        stored: File that a rank has put into the file store.
        ending: Success or failure of the attempt. A process that is interrupted reports neither.
    """

    progress: Progress | None = None
    prepared: bool = False
    stored: Published | None = None
    ending: Ending | None = None


def attempt_ending(
    request: StopRequest | None,
    reported: Ending | None,
    exit_code: int,
    log_tail: str,
    *,
    has_result: bool,
    cluster: bool = False,
) -> Ending:
    """Return the ending of an attempt whose process has exited.

    Args:
        request: CANCEL or RELEASE if the end was requested, possibly too late; None otherwise.
        reported: Ending that the process has reported; None if it was interrupted or died.
        exit_code: Exit code of the process; negative for the signal that killed it.
        log_tail: Last part of the process' log.
        has_result: Whether the stylized scene exists.
        cluster: Whether the process only supervises ranks on a Ray cluster. Ray terminates it with an exit code and
            without a report if the cluster's head or the machine's own node dies; that counts as an outage.
    """
    if reported is not None and reported.outcome == AttemptOutcome.SUCCEEDED:
        if has_result:
            return reported
        return Ending(AttemptOutcome.FAILED, error={"code": "internal", "message": "The job ended without a result."})
    if request == StopRequest.CANCEL:
        return Ending(AttemptOutcome.CANCELED)
    if request == StopRequest.RELEASE:
        return Ending(AttemptOutcome.RELEASED)
    if reported is not None:
        return reported
    crash = _crash_error(exit_code, log_tail)
    if cluster and exit_code > 0:
        return Ending(
            AttemptOutcome.FAILED,
            error=outage(Cause.MACHINE),
            detail="\n".join(text for text in (crash["message"], log_tail) if text),
        )
    return Ending(AttemptOutcome.FAILED, error=crash)


def _crash_error(exit_code: int, log_tail: str) -> dict[str, Any]:
    """Return the error of a process that ended without a report."""
    if exit_code == -signal.SIGKILL:
        message = "The process that ran the job was killed; the machine may have run out of memory."
    elif exit_code < 0:
        message = f"The process that ran the job was ended by {signal.Signals(-exit_code).name}."
    else:
        message = f"The process that ran the job ended with code {exit_code}."
    return {"code": "crashed", "message": message, "log": log_tail}
