"""Tests of the table of job states, and of features that need an extra."""

import sys
from itertools import product

import pytest

from service.states import (
    ACTIONS,
    FINISHED,
    JobStatus,
    Transition,
    allowed,
    installed_extras,
    missing_extras,
    next_status,
)

#: Rows: initial states; columns: transitions. A dot marks a combination that is not allowed.
EXPECTED = """
            take      start     succeed    fail    requeue  stop      finish     cancel     retry   expire
queued      starting  .         .          .       .        .         .          canceled   .       .
starting    .         running   succeeded  failed  queued   canceled  .          canceling  .       .
running     .         running   succeeded  failed  queued   canceled  finishing  canceling  .       .
finishing   .         .         succeeded  failed  queued   canceled  finishing  canceling  .       .
canceling   .         canceling succeeded  .       .        canceled  .          canceling  .       .
succeeded   .         .         .          .       .        .         .          .          queued  expired
failed      .         .         .          .       .        .         .          .          queued  expired
canceled    .         .         .          .       .        .         .          canceled   queued  expired
expired     .         .         .          .       .        .         .          .          .       .
"""


def expected() -> dict[tuple[JobStatus, Transition], JobStatus | None]:
    first, *rows = [line.split() for line in EXPECTED.strip().splitlines()]
    return {
        (JobStatus(row[0]), Transition(name)): None if cell == "." else JobStatus(cell)
        for row in rows
        for name, cell in zip(first, row[1:], strict=True)
    }


@pytest.mark.parametrize(("status", "transition"), list(product(JobStatus, Transition)))
def test_every_transition_of_every_state(status: JobStatus, transition: Transition) -> None:
    wanted = expected()[status, transition]
    assert allowed(status, transition) == (wanted is not None)
    if wanted is not None:
        assert next_status(status, transition) == wanted
        return
    with pytest.raises(KeyError):
        next_status(status, transition)


def test_actions_apply_to_states_that_they_change() -> None:
    assert {name: action.statuses for name, action in ACTIONS.items()} == {
        Transition.FINISH: (JobStatus.RUNNING,),
        Transition.CANCEL: (JobStatus.QUEUED, JobStatus.STARTING, JobStatus.RUNNING, JobStatus.FINISHING),
        Transition.RETRY: FINISHED,
    }


def test_missing_extra_is_not_offered_and_named_to_the_operator(monkeypatch: pytest.MonkeyPatch) -> None:
    assert installed_extras() == {"video": True, "heif": True}
    assert missing_extras() == []
    monkeypatch.setitem(sys.modules, "av", None)
    assert installed_extras() == {"video": False, "heif": True}
    assert missing_extras() == ["Videos are not offered. To add them: pip install 'sgsst-service[video]'"]
