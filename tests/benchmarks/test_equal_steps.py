"""Tests of the comparison of schedules at equal cost."""

from benchmarks.equal_steps import Pace, seconds_of, steps_as_long_as


def test_schedule_takes_as_long_as_another_run() -> None:
    """The first step on two scales prepares the view, so it does not count as the others."""
    pace: Pace = {(1,): [1.0] * 60, (0, 1): [9.0, *[4.0] * 19]}
    assert seconds_of(pace) == {"seconds": 145.0, "counted": 140.0, "steps": 80}
    assert steps_as_long_as(pace, 100, 200) == {"steps_coarse": 16, "steps_sos": 31}
    assert 16 * 1.0 + 31 * 4.0 == 140.0
