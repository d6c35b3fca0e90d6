"""States of a job, and the table of all transitions between them."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum


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


class Transition(StrEnum):
    """Transition of a job from one state to another."""

    #: A dispatcher leases the job, for the first time or after its previous lease was lost.
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
    #: The user retries the job.
    RETRY = "retry"
    #: The retention time of the results is over.
    EXPIRE = "expire"


_S = JobStatus
#: States in which a dispatcher works on the job.
ACTIVE = (_S.STARTING, _S.RUNNING, _S.FINISHING, _S.CANCELING)
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
    Transition.TAKE: dict.fromkeys((_S.QUEUED, _S.STARTING, _S.RUNNING, _S.FINISHING), _S.STARTING),
    Transition.START: {_S.STARTING: _S.RUNNING, _S.RUNNING: _S.RUNNING, _S.CANCELING: _S.CANCELING},
    Transition.SUCCEED: dict.fromkeys(ACTIVE, _S.SUCCEEDED),
    Transition.FAIL: dict.fromkeys((_S.STARTING, _S.RUNNING, _S.FINISHING), _S.FAILED),
    Transition.REQUEUE: dict.fromkeys((_S.STARTING, _S.RUNNING, _S.FINISHING), _S.QUEUED),
    Transition.STOP: dict.fromkeys(ACTIVE, _S.CANCELED),
    Transition.FINISH: {_S.RUNNING: _S.FINISHING, _S.FINISHING: _S.FINISHING},
    Transition.CANCEL: {
        _S.QUEUED: _S.CANCELED,
        _S.STARTING: _S.CANCELING,
        _S.RUNNING: _S.CANCELING,
        _S.FINISHING: _S.CANCELING,
        _S.CANCELING: _S.CANCELING,
        _S.CANCELED: _S.CANCELED,
    },
    Transition.RETRY: dict.fromkeys((_S.FAILED, _S.CANCELED), _S.QUEUED),
    Transition.EXPIRE: dict.fromkeys(FINISHED, _S.EXPIRED),
}

#: Transitions that users request with `POST /v1/jobs/{id}/{transition}`, and the statuses that each one changes. The
#: page has a button for each.
ACTIONS: Mapping[Transition, tuple[JobStatus, ...]] = {
    action: tuple(status for status, target in TRANSITIONS[action].items() if target is not status)
    for action in (Transition.FINISH, Transition.CANCEL, Transition.RETRY)
}


class TransitionError(Exception):
    """Transition that a job's status does not allow."""


def allowed(status: str, transition: Transition) -> bool:
    """Return whether a status allows a transition."""
    return status in TRANSITIONS[transition]


def next_status(status: str, transition: Transition) -> JobStatus:
    """Return the status that a transition leads to.

    Raises:
        TransitionError: If the status does not allow the transition.
    """
    target = TRANSITIONS[transition].get(JobStatus(status))
    if target is None:
        raise TransitionError(f"There is no {transition} for a job with status {status}.")
    return target
