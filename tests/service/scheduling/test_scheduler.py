"""Tests of which job a machine starts next, on snapshots of queues and machines."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from service.scheduling.job_size import estimated_seconds
from service.scheduling.machine import Machine
from service.scheduling.packing import Capacity, Grant, QueuedJob
from service.scheduling.scheduler import (
    Decision,
    Forecast,
    Holding,
    Reason,
    Snapshot,
    backfill,
    measured_pace,
    next_job,
)

NOW = 1_000_000.0
CAPACITY = Capacity(Machine(tuple(f"gpu{number}" for number in range(8)), 16, 100 * 10**9), None)
#: Parameters of a job that ends within a minute.
SHORT: dict[str, Any] = {"preset": "preview", "resolution": 640}


def job(name: str, workers: int = 1, waited: float = 10.0, **parameters: Any) -> QueuedJob:
    inputs = [{"role": "scene", "name": "scene.ply", "size": 10**8}]
    return QueuedJob(name, NOW - waited, {"preset": "paper", "workers": workers} | parameters, inputs)


def running(*ends: float | None) -> list[Holding]:
    """Return jobs that hold one GPU each, and end in this number of seconds."""
    return [Holding(Grant(1, (f"gpu{number}",)), None if end is None else NOW + end) for number, end in enumerate(ends)]


def snapshot(*ends: float | None, pace: float | None = 1.0, **more: Any) -> Snapshot:
    return Snapshot(CAPACITY, running(*ends), waiting=9, now=NOW, pace=pace, **more)


def test_nothing_starts_from_an_empty_queue() -> None:
    assert next_job([], snapshot()) == Decision(Reason.NONE_FITS)


def test_first_job_that_fits_starts_on_the_free_gpus() -> None:
    decision = next_job([job("first", 2), job("second")], snapshot(60.0))
    assert (decision.job_id, decision.reason, decision.reserved_for) == ("first", Reason.FITS, None)
    assert decision.grant is not None
    assert decision.grant.gpus == ("gpu1", "gpu2")


def test_long_job_does_not_overtake_a_reserved_job() -> None:
    decision = next_job([job("large", 8), job("long")], snapshot(600.0, 100.0))
    assert decision == Decision(Reason.NONE_ENDS_IN_TIME, reserved_for="large", forecast=Forecast("large", NOW + 600))


def test_short_job_is_backfilled() -> None:
    queue = [job("large", 8), job("long"), job("short", **SHORT), job("short too", **SHORT)]
    decision = next_job(queue, snapshot(600.0))
    assert (decision.job_id, decision.reason, decision.reserved_for) == ("short", Reason.ENDS_IN_TIME, "large")


def test_forecast_counts_only_the_ends_that_the_reserved_job_needs() -> None:
    decision = next_job([job("large", 7)], snapshot(900.0, 300.0, 600.0))
    assert decision.forecast == Forecast("large", NOW + 600)


@pytest.mark.parametrize(
    ("ends", "pace", "reason"),
    [
        ((600.0,), None, Reason.NO_FORECAST),
        ((None,), 1.0, Reason.NO_FORECAST),
        ((600.0,), 100.0, Reason.NONE_ENDS_IN_TIME),
        ((19.0,), 0.001, Reason.STARTS_SOON),
        ((20.0,), 0.001, Reason.ENDS_IN_TIME),
        ((-5.0,), 1.0, Reason.STARTS_SOON),
    ],
)
def test_backfilling_needs_a_pace_a_forecast_and_enough_time(
    ends: tuple[float | None, ...], pace: float | None, reason: Reason
) -> None:
    decision = next_job([job("large", 8), job("short", **SHORT)], snapshot(*ends, pace=pace))
    assert (decision.reason, decision.reserved_for) == (reason, "large")
    assert (decision.job_id is None) == (reason != Reason.ENDS_IN_TIME)


def test_backfilling_adds_a_safety_margin_of_half() -> None:
    short = job("short", **SHORT)
    seconds = estimated_seconds(short.parameters, short.inputs)
    queue = [job("large", 8), short]
    assert next_job(queue, snapshot(1.49 * seconds)).job_id is None
    assert next_job(queue, snapshot(1.51 * seconds)).job_id == "short"


def test_later_forecast_does_not_extend_the_gap() -> None:
    earlier = Forecast("large", NOW + 15)
    decision = next_job([job("large", 8), job("short", **SHORT)], snapshot(600.0, forecast=earlier))
    assert (decision.reason, decision.forecast) == (Reason.STARTS_SOON, earlier)


def test_forecast_of_another_job_is_replaced() -> None:
    decision = next_job([job("large", 8)], snapshot(600.0, forecast=Forecast("other", NOW + 15)))
    assert decision.forecast == Forecast("large", NOW + 600)


def test_forecast_survives_decisions_without_one() -> None:
    earlier = Forecast("large", NOW + 15)
    assert next_job([job("first")], snapshot(600.0, forecast=earlier)).forecast == earlier
    assert next_job([job("large", 8)], snapshot(None, forecast=earlier)).forecast == earlier


def test_one_of_several_dispatchers_skips_a_job_with_a_longer_remaining_wait() -> None:
    queue = [job("large", 8, waited=59.0), job("small")]
    decision = next_job(queue, snapshot(60.0, dispatchers=2))
    assert (decision.job_id, decision.reserved_for) == ("small", None)
    assert next_job(queue[:1], snapshot(60.0, dispatchers=2)).reason == Reason.NONE_FITS


@pytest.mark.parametrize(
    ("waited", "more"), [(60.0, {}), (59.0, {"forecast": Forecast("large", NOW + 60)}), (59.0, {"dispatchers": 1})]
)
def test_capacity_is_reserved_by_the_only_dispatcher_or_after_an_equal_wait(
    waited: float, more: dict[str, Any]
) -> None:
    decision = next_job([job("large", 8, waited)], snapshot(60.0, **({"dispatchers": 2} | more)))
    assert decision.reserved_for == "large"


def test_pace_is_the_median_of_the_running_jobs_or_the_previous_one() -> None:
    grant = Grant(1)
    holdings = [Holding(grant, NOW, pace) for pace in (3.0, 1.0, 2.0)]
    assert measured_pace([*holdings, Holding(grant)], 9.0) == 2.0
    assert measured_pace([Holding(grant)], 9.0) == 9.0


JOBS = st.tuples(st.sampled_from([1, 2, 4, 8]), st.sampled_from([0.0, 30.0, 1000.0]), st.booleans())


@given(
    st.lists(JOBS, max_size=8),
    st.lists(st.none() | st.floats(1, 1000), max_size=8),
    st.none() | st.floats(0.1, 10),
    st.integers(1, 3),
)
def test_queue_at_once_and_job_by_job_give_the_same_decision(
    jobs: list[tuple[int, float, bool]], ends: list[float | None], pace: float | None, dispatchers: int
) -> None:
    """The dispatcher decides job by job, because the store locks one job at a time."""
    queue = [job(str(number), *each[:2], **(SHORT if each[2] else {})) for number, each in enumerate(jobs)]
    state = snapshot(*ends, pace=pace, dispatchers=dispatchers)
    decision = next_job(queue, state)
    assert (decision.job_id, decision.grant, decision.reserved_for) == job_by_job(queue, state)
    busy = {gpu for each in state.holdings for gpu in each.grant.gpus}
    assert decision.grant is None or not busy.intersection(decision.grant.gpus)


def job_by_job(queue: list[QueuedJob], state: Snapshot) -> tuple[str | None, Grant | None, str | None]:
    for position, first in enumerate(queue):
        decision = next_job([first], state)
        if decision.grant is not None:
            return decision.job_id, decision.grant, None
        if decision.reserved_for is None:
            continue
        if decision.reason == Reason.NONE_ENDS_IN_TIME:
            assert decision.forecast is not None
            assert state.pace is not None
            for other in queue[position + 1 :]:
                chosen = backfill([other], decision.forecast, state.pace, state)
                if chosen.grant is not None:
                    return chosen.job_id, chosen.grant, first.id
        return None, None, first.id
    return None, None, None
