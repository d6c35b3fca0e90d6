"""States of a job, and the table of all transitions between them, from which API, clients and page derive theirs.

In addition, what the process of an attempt reports, and which extras are installed, because this module imports
neither a database nor settings: commands for scenes use it without the extra `service`.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from importlib.util import find_spec
from typing import Literal


class JobStatus(StrEnum):
    """Status of a job."""

    QUEUED = "queued"
    STARTING = "starting"
    RUNNING = "running"
    FINISHING = "finishing"
    CANCELING = "canceling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELED = "canceled"
    EXPIRED = "expired"


class AttemptOutcome(StrEnum):
    """Outcome of an attempt."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELED = "canceled"
    #: The dispatcher shut down and returned the job to the queue.
    RELEASED = "released"
    #: The dispatcher stopped sending heartbeats.
    LOST = "lost"


class Cause(StrEnum):
    """Cause of an attempt's end without a result."""

    #: The job itself: its files or settings, an error of the method, or a crash of its process.
    JOB = "job"
    STORE = "store"
    DISK = "disk"
    DATABASE = "database"
    #: A machine or the network between machines.
    MACHINE = "machine"
    #: The dispatcher's process has ended, or its machine.
    DISPATCHER = "dispatcher"


class Transition(StrEnum):
    """Transition of a job from one state to another."""

    #: A dispatcher leases the job.
    TAKE = "take"
    #: The inputs have been read and the first step starts.
    START = "start"
    SUCCEED = "succeed"
    #: An attempt failed and is not followed by another one.
    FAIL = "fail"
    #: An attempt ended early and is followed by another one.
    REQUEUE = "requeue"
    #: The dispatcher has stopped the job.
    STOP = "stop"
    #: The user ends the job early and keeps its result so far.
    FINISH = "finish"
    #: The user cancels the job.
    CANCEL = "cancel"
    #: The user retries the job, or continues one that was stopped early.
    RETRY = "retry"
    #: The retention time of the results is over.
    EXPIRE = "expire"


@dataclass(frozen=True)
class Published:
    """File in the file store that is or will be published by a database row; `step` is set for checkpoints."""

    name: str
    location: str
    size: int
    sha256: str
    step: int | None = None


#: Event of a job about which its webhook can get a message.
WebhookEvent = Literal["started", "progress", "completed"]

_S = JobStatus
#: States in which a dispatcher works toward the job's result.
WORKING = (_S.STARTING, _S.RUNNING, _S.FINISHING)
#: States in which a job makes steps.
STEPPING = (_S.RUNNING, _S.FINISHING)
#: States in which a dispatcher holds the job.
ACTIVE = (*WORKING, _S.CANCELING)
UNFINISHED = (_S.QUEUED, *ACTIVE)
#: States of an ended job that still has its files.
FINISHED = (_S.SUCCEEDED, _S.FAILED, _S.CANCELED)
#: Final states, unless the user retries the job.
ENDED = (*FINISHED, _S.EXPIRED)

#: Texts that the page displays.
TITLES: Mapping[JobStatus, str] = {
    status: "Done" if status is _S.SUCCEEDED else status.capitalize() for status in JobStatus
}

#: Target state per transition and initial state; other combinations are not allowed. A job that is being canceled is
#: stopped however its attempt ends, unless the attempt succeeds first.
TRANSITIONS: Mapping[Transition, Mapping[JobStatus, JobStatus]] = {
    Transition.TAKE: {_S.QUEUED: _S.STARTING},
    Transition.START: {_S.STARTING: _S.RUNNING, _S.RUNNING: _S.RUNNING, _S.CANCELING: _S.CANCELING},
    Transition.SUCCEED: dict.fromkeys(ACTIVE, _S.SUCCEEDED),
    Transition.FAIL: dict.fromkeys(WORKING, _S.FAILED),
    Transition.REQUEUE: dict.fromkeys(WORKING, _S.QUEUED),
    Transition.STOP: dict.fromkeys(ACTIVE, _S.CANCELED),
    Transition.FINISH: {_S.RUNNING: _S.FINISHING, _S.FINISHING: _S.FINISHING},
    Transition.CANCEL: {**dict.fromkeys((_S.QUEUED, _S.CANCELED), _S.CANCELED), **dict.fromkeys(ACTIVE, _S.CANCELING)},
    Transition.RETRY: dict.fromkeys(FINISHED, _S.QUEUED),  # one that succeeded only if it was stopped early
    Transition.EXPIRE: dict.fromkeys(FINISHED, _S.EXPIRED),
}


@dataclass(frozen=True)
class Action:
    """Transition that users request with `POST /v1/jobs/{id}/{transition}`."""

    help: str
    statuses: tuple[JobStatus, ...]


#: Actions of users. Each one is a command, and a button of the page.
ACTIONS: Mapping[Transition, Action] = {
    action: Action(text, tuple(status for status, target in TRANSITIONS[action].items() if target is not status))
    for action, text in {
        Transition.FINISH: "End a running job after its current step, and keep its result so far.",
        Transition.CANCEL: "Cancel a job.",
        Transition.RETRY: "Queue a failed, canceled or stopped job again; it continues from its last checkpoint.",
    }.items()
}


def allowed(status: str, transition: Transition) -> bool:
    """Return whether a status allows a transition."""
    return status in TRANSITIONS[transition]


def next_status(status: str, transition: Transition) -> JobStatus:
    """Return the status that a transition leads to.

    Raises:
        KeyError: If the status does not allow the transition.
    """
    return TRANSITIONS[transition][JobStatus(status)]


#: Module that each extra installs, and what it is for.
_EXTRAS = {"video": ("av", "Videos"), "heif": ("pillow_heif", "HEIC images")}


def installed_extras() -> dict[str, bool]:
    """Return whether each optional extra is installed."""
    return {extra: find_spec(module) is not None for extra, (module, _) in _EXTRAS.items()}


def missing_extras() -> list[str]:
    """Return a line for the operator about each feature that is not offered, with the command that installs it."""
    missing = [extra for extra, there in installed_extras().items() if not there]
    return [f"{_EXTRAS[each][1]} are not offered. To add them: {install_command(each)}" for each in missing]


def install_command(extra: str) -> str:
    """Return the command that installs an extra."""
    return f"pip install 'sgsst-service[{extra}]'"
