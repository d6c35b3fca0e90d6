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


class Told:
    """Recorder of all events of a listener, in order."""

    def __init__(self) -> None:
        self.events: list[tuple[str, object]] = []
        self.relay = Relay(
            Listener(
                planning=lambda now: self.events.append(("planning", now.fraction)),
                prepared=lambda found: self.events.append(("prepared", found.step)),
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


def test_planning_is_told_as_it_goes_on_and_no_more_when_it_is_done() -> None:
    told = Told()
    assert told.after(RankStatus(), planned(0), planned(1), planned(1), planned(4)) == [
        ("planning", 0.0),
        ("planning", 0.25),
        ("planning", 1.0),
    ]
    done = replace(planned(4), prepared=Prepared([], 0, 10))
    assert told.after(done, done, replace(done, progress=step(1))) == [
        ("prepared", 0),
        ("resumed", None),
        ("step", 1),
    ]


def test_an_attempt_that_plans_again_tells_it_again() -> None:
    told = Told()
    told.after(planned(3))
    told.relay.begin_attempt()
    assert told.after(planned(3)) == [("planning", 0.75)]


def test_an_attempt_that_goes_on_from_a_checkpoint_is_prepared_silently() -> None:
    told = Told()
    told.after(RankStatus(prepared=Prepared([], 0, 10), progress=step(5), saved=4))
    assert told.relay.farthest == (5, 4)
    told.relay.begin_attempt()
    assert (told.relay.first_step, told.relay.last_step) == (None, 4)
    again = RankStatus(prepared=Prepared([], 4, 10))
    assert told.after(again, replace(again, progress=step(5))) == [("resumed", None), ("step", 5)]
    assert told.relay.first_step == 4
    assert told.relay.farthest == (5, 4)


@pytest.mark.parametrize("again", [False, True])
def test_warnings_and_pictures_are_told_once(again: bool) -> None:
    told = Told()
    first = RankStatus(warnings=("a",), previews=(Path("out/1.jpg"),))
    told.after(first)
    status = replace(first, warnings=("a", "b"), previews=(Path("out/1.jpg"), Path("out/2.jpg")))
    if again:
        told.relay.begin_attempt()  # its ranks report all events again
        assert len(told.after(status)) == 4
    else:
        assert told.after(status) == [("warning", "b"), ("preview", "2.jpg")]
