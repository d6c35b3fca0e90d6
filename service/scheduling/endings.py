"""How an attempt has ended, decided from what its process told, how it exited, and what was wanted of it. Pure."""

from __future__ import annotations

import errno
import signal
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from service.scheduling.messages import Message
from service.store.states import AttemptOutcome
from sgsst_core.errors import InfrastructureError, OutputError, WeightsError


class Wish(StrEnum):
    """What somebody wants of an attempt that would go on by itself."""

    #: Its user wants the job to end.
    CANCEL = "cancel"
    #: Its dispatcher is to end: the job's state is saved, and the job given back.
    RELEASE = "release"
    #: Another dispatcher has the job: nothing more may be written.
    ABANDON = "abandon"


#: What a job's user is told where a machine, a network or the store of files has failed.
OUTAGE = {
    "code": InfrastructureError.code,
    "message": "A machine of the service, its network or its store of files has failed. The job is tried again.",
}
#: What the system says when the fault is a machine's: a full, broken or read-only disk, a file system that is away.
_MACHINE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.EROFS, errno.ESTALE, errno.ENOTCONN, errno.ENODEV)


def is_outage(error: BaseException) -> bool:
    """Whether an error is that of a machine, a network or a store: nothing is wrong with the job.

    What cannot be written is, since jobs write to folders of the service; so are networks that are not installed, which
    nothing but an operator can change.
    """
    if isinstance(error, OSError):
        return error.errno in _MACHINE_ERRORS
    return isinstance(error, InfrastructureError | OutputError | WeightsError)


@dataclass(frozen=True)
class Ending:
    """How an attempt has ended.

    Attributes:
        outcome: for its record; SUCCEEDED, CANCELED, RELEASED or FAILED.
        error: of a failure: `code`, `message` and what else there is to know.
        permanent: another attempt would fail the same way.
        detail: of a failure, for the operator alone.
    """

    outcome: AttemptOutcome
    error: dict[str, Any] | None = None
    permanent: bool = False
    detail: str | None = None


def attempt_ending(
    wish: Wish | None,
    last: Message | None,
    exit_code: int,
    log_tail: str | None,
    *,
    has_result: bool,
    cluster: bool = False,
) -> Ending:
    """How an attempt has ended whose process is gone.

    Args:
        wish: CANCEL or RELEASE where somebody wanted the end; it may have come too late.
        last: the process' last word: `done`, `failed` or `interrupted`; None where it had none.
        exit_code: of the process; negative for the signal that ended it.
        log_tail: what its log ends with; None where there is no log.
        has_result: whether the stylized scene is there.
        cluster: the process only watches over ranks on a Ray cluster. Ray ends it, with a code and without a word, when
            the cluster's head or the machine's own node dies: that is an outage.
    """
    if last is not None and last["kind"] == "done":
        if has_result:
            return Ending(AttemptOutcome.SUCCEEDED)
        return Ending(AttemptOutcome.FAILED, {"code": "internal", "message": "The job ended without a result."})
    if wish == Wish.CANCEL:
        return Ending(AttemptOutcome.CANCELED)
    if wish == Wish.RELEASE:
        return Ending(AttemptOutcome.RELEASED)
    if last is not None and last["kind"] == "failed":
        return Ending(AttemptOutcome.FAILED, last["error"], last["permanent"], last.get("detail"))
    crash = _crash_error(exit_code, log_tail)
    if cluster and exit_code > 0:
        return Ending(
            AttemptOutcome.FAILED, OUTAGE, detail="\n".join(text for text in (crash["message"], log_tail) if text)
        )
    return Ending(AttemptOutcome.FAILED, crash)


def _crash_error(exit_code: int, log_tail: str | None) -> dict[str, Any]:
    """What to say of a process that ended without a word."""
    if exit_code == -signal.SIGKILL:
        message = "The process that ran the job was killed; perhaps the machine had run out of memory."
    elif exit_code < 0:
        message = f"The process that ran the job was ended by {signal.Signals(-exit_code).name}."
    else:
        message = f"The process that ran the job ended with code {exit_code}."
    error = {"code": "crashed", "message": message}
    return error if log_tail is None else {**error, "log": log_tail}
