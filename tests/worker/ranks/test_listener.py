"""Tests that the relay forwards each event of rank 0 exactly once per attempt, and tracks the job's progress."""

from __future__ import annotations

from dataclasses import replace

import pytest

from sgsst_core.progress import Progress
from worker.prepare import Prepared
from worker.ranks.driver import Relay
from worker.ranks.rank import RankStatus
from worker.run import Listener


class EventRecorder:
    """Recorder of all events of a listener, in order."""

    def __init__(self) -> None:
        self.events: list[tuple[str, object]] = []
        self.relay = Relay(
            Listener(
                prepared=lambda plan: self.events.append(("prepared", plan.step)),
                progress=lambda now: self.events.append((now.stage, now.step)),
                warn=lambda line: self.events.append(("warning", line)),
            ),
            lambda: self.events.append(("resumed", None)),
        )
        self.relay.begin_attempt()

    def after(self, *statuses: RankStatus) -> list[tuple[str, object]]:
        """Pass these status responses of rank 0 to the relay, and return the resulting events."""
        known = len(self.events)
        for status in statuses:
            self.relay.pass_on(status)
        return self.events[known:]


def planned(done: int) -> RankStatus:
    return RankStatus(progress=Progress(stage="planning", step=done, total=4, eta_s=1.0))


def step(number: int) -> Progress:
    return Progress(stage="sos", step=number, total=10, loss=1.0)


def test_planning_progress_is_relayed_until_prepared() -> None:
    recorder = EventRecorder()
    assert recorder.after(RankStatus(), planned(0), planned(1), planned(1), planned(4)) == [
        ("planning", 0),
        ("planning", 1),
        ("planning", 4),
    ]
    done = replace(planned(4), prepared=Prepared([], 0, 10))
    assert recorder.after(done, done, replace(done, progress=step(1))) == [
        ("prepared", 0),
        ("resumed", None),
        ("sos", 1),
    ]


def test_views_of_a_quality_check_are_relayed() -> None:
    recorder = EventRecorder()
    done = RankStatus(prepared=Prepared([], 0, 10), progress=step(10))
    checked = [step(10).model_copy(update={"views_checked": view, "views_to_check": 2}) for view in (0, 0, 1)]
    checks = [replace(done, progress=each) for each in checked]
    assert recorder.after(done, *checks)[1:] == [("resumed", None), ("sos", 10), ("sos", 10), ("sos", 10)]


def test_new_attempt_relays_planning_again() -> None:
    recorder = EventRecorder()
    recorder.after(planned(3))
    recorder.relay.begin_attempt()
    assert recorder.after(planned(3)) == [("planning", 3)]


def test_resumed_attempt_relays_no_preparation() -> None:
    recorder = EventRecorder()
    recorder.after(RankStatus(prepared=Prepared([], 0, 10), progress=step(5), saved=4))
    assert recorder.relay.farthest == (5, 4)
    recorder.relay.begin_attempt()
    assert (recorder.relay.first_step, recorder.relay.last_step) == (None, 4)
    again = RankStatus(prepared=Prepared([], 4, 10))
    assert recorder.after(again, replace(again, progress=step(5))) == [("resumed", None), ("sos", 5)]
    assert recorder.relay.first_step == 4
    assert recorder.relay.farthest == (5, 4)


@pytest.mark.parametrize("again", [False, True])
def test_warnings_are_relayed_once_per_attempt(again: bool) -> None:
    recorder = EventRecorder()
    first = RankStatus(warnings=("a",))
    recorder.after(first)
    status = replace(first, warnings=("a", "b"))
    if again:
        recorder.relay.begin_attempt()  # its ranks report all events again
        assert len(recorder.after(status)) == 2
    else:
        assert recorder.after(status) == [("warning", "b")]
