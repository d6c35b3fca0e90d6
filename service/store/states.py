"""The states of a job, and every way from one to another, in one table. Pure: the store's updates follow it."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum


class JobStatus(StrEnum):
    """What a job is doing."""

    QUEUED = "queued"
    STARTING = "starting"
    RUNNING = "running"
    CANCELING = "canceling"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELED = "canceled"
    EXPIRED = "expired"


class AttemptOutcome(StrEnum):
    """How an attempt ended."""

    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELED = "canceled"
    #: Its dispatcher shut down and put the job back.
    RELEASED = "released"
    #: Its dispatcher was not heard of again.
    LOST = "lost"


class Transition(StrEnum):
    """What moves a job from one state to another."""

    #: A dispatcher leases it, for the first time or after another one that was lost.
    TAKE = "take"
    #: Its inputs are read and its steps begin.
    BEGIN = "begin"
    SUCCEED = "succeed"
    #: An attempt failed, and there is no other one.
    FAIL = "fail"
    #: An attempt ended early, and another one follows.
    REQUEUE = "requeue"
    #: Its dispatcher has stopped it.
    STOP = "stop"
    #: Its user wants it to end.
    CANCEL = "cancel"
    #: Its user wants it to run again.
    RETRY = "retry"
    #: Its results have been kept long enough.
    EXPIRE = "expire"


_S = JobStatus
#: A dispatcher works on it.
ACTIVE = (_S.STARTING, _S.RUNNING, _S.CANCELING)
UNFINISHED = (_S.QUEUED, *ACTIVE)
#: Ended, with what it has made.
FINISHED = (_S.SUCCEEDED, _S.FAILED, _S.CANCELED)
#: Nothing more happens to it, unless its user retries it.
ENDED = (*FINISHED, _S.EXPIRED)

#: For each transition the states that it starts from, and where it leads; from all others there is no way. A job that
#: is being canceled is stopped whatever becomes of its attempt, unless that succeeds first.
TRANSITIONS: Mapping[Transition, Mapping[JobStatus, JobStatus]] = {
    Transition.TAKE: dict.fromkeys((_S.QUEUED, _S.STARTING, _S.RUNNING), _S.STARTING),
    Transition.BEGIN: {_S.STARTING: _S.RUNNING, _S.RUNNING: _S.RUNNING, _S.CANCELING: _S.CANCELING},
    Transition.SUCCEED: dict.fromkeys(ACTIVE, _S.SUCCEEDED),
    Transition.FAIL: dict.fromkeys((_S.STARTING, _S.RUNNING), _S.FAILED),
    Transition.REQUEUE: dict.fromkeys((_S.STARTING, _S.RUNNING), _S.QUEUED),
    Transition.STOP: dict.fromkeys(ACTIVE, _S.CANCELED),
    Transition.CANCEL: {
        _S.QUEUED: _S.CANCELED,
        _S.STARTING: _S.CANCELING,
        _S.RUNNING: _S.CANCELING,
        _S.CANCELING: _S.CANCELING,
        _S.CANCELED: _S.CANCELED,
    },
    Transition.RETRY: dict.fromkeys((_S.FAILED, _S.CANCELED), _S.QUEUED),
    Transition.EXPIRE: dict.fromkeys(FINISHED, _S.EXPIRED),
}


class TransitionError(Exception):
    """There is no such way out of a job's state."""


def allowed(status: str, transition: Transition) -> bool:
    """Whether there is such a way out of a state."""
    return status in TRANSITIONS[transition]


def next_status(status: str, transition: Transition) -> JobStatus:
    """Where a transition leads.

    Raises:
        TransitionError: nowhere, from this state.
    """
    found = TRANSITIONS[transition].get(JobStatus(status))
    if found is None:
        raise TransitionError(f"There is no {transition} for a job with status {status}.")
    return found
