"""Tests that the relay forwards each event of rank 0 exactly once per attempt, and tracks the job's progress."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from sgsst_core.planning.survey import PlanningProgress
from sgsst_core.stylizing.loop import Progress
from worker.description import Prepared
from worker.ranks.listener import Listener, Relay
from worker.ranks.rank import RankStatus


class EventRecorder:
    """Recorder of all events of a listener, in order."""

    def __init__(self) -> None:
        self.events: list[tuple[str, object]] = []
        self.relay = Relay(
            Listener(
                planning=lambda now: self.events.append(("planning", now.fraction)),
                prepared=lambda plan: self.events.append(("prepared", plan.step)),
                progress=lambda now: self.events.append(("step", now.step)),
                warn=lambda line: self.events.append(("warning", line)),
                preview=lambda path: self.events.append(("preview", path.name)),
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
    return RankStatus(planning=PlanningProgress(done, 4, 1.0))


def step(number: int) -> Progress:
    return Progress("sos", number, 10, 1.0, 1.0, 1.0)


def test_planning_progress_is_relayed_until_prepared() -> None:
    recorder = EventRecorder()
    assert recorder.after(RankStatus(), planned(0), planned(1), planned(1), planned(4)) == [
        ("planning", 0.0),
        ("planning", 0.25),
        ("planning", 1.0),
    ]
    done = replace(planned(4), prepared=Prepared([], 0, 10))
    assert recorder.after(done, done, replace(done, progress=step(1))) == [
        ("prepared", 0),
        ("resumed", None),
        ("step", 1),
    ]


def test_views_of_a_quality_check_are_relayed() -> None:
    recorder = EventRecorder()
    done = RankStatus(prepared=Prepared([], 0, 10), progress=step(10))
    checks = [replace(done, progress=replace(step(10), stage="measuring", views=(view, 2))) for view in (0, 0, 1)]
    assert recorder.after(done, *checks)[1:] == [("resumed", None), ("step", 10), ("step", 10), ("step", 10)]


def test_new_attempt_relays_planning_again() -> None:
    recorder = EventRecorder()
    recorder.after(planned(3))
    recorder.relay.begin_attempt()
    assert recorder.after(planned(3)) == [("planning", 0.75)]


def test_resumed_attempt_relays_no_preparation() -> None:
    recorder = EventRecorder()
    recorder.after(RankStatus(prepared=Prepared([], 0, 10), progress=step(5), saved=4))
    assert recorder.relay.farthest == (5, 4)
    recorder.relay.begin_attempt()
    assert (recorder.relay.first_step, recorder.relay.last_step) == (None, 4)
    again = RankStatus(prepared=Prepared([], 4, 10))
    assert recorder.after(again, replace(again, progress=step(5))) == [("resumed", None), ("step", 5)]
    assert recorder.relay.first_step == 4
    assert recorder.relay.farthest == (5, 4)


@pytest.mark.parametrize("again", [False, True])
def test_warnings_and_previews_are_relayed_once_per_attempt(again: bool) -> None:
    recorder = EventRecorder()
    first = RankStatus(warnings=("a",), previews=(Path("out/1.jpg"),))
    recorder.after(first)
    status = replace(first, warnings=("a", "b"), previews=(Path("out/1.jpg"), Path("out/2.jpg")))
    if again:
        recorder.relay.begin_attempt()  # its ranks report all events again
        assert len(recorder.after(status)) == 4
    else:
        assert recorder.after(status) == [("warning", "b"), ("preview", "2.jpg")]
