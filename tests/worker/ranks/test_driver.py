"""Tests of the driver of ranks: retries, relayed events, requested resources, and clusters that do not answer."""

import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Literal

import psutil
import pytest

from sgsst_core.errors import ClusterAwayError, RanksDriftedError, RanksFailedError, SceneError
from sgsst_core.progress import Progress
from worker.execute import Prepared
from worker.job import memory_beside_gpus, scene_bytes
from worker.processes import home
from worker.ranks.cluster import Cluster, NoCapacityError, reserve
from worker.ranks.driver import MOST_ATTEMPTS, AttemptFailedError, Relay, check_retry, failure_of
from worker.run import Listener, LostAttempt, RankStatus

KILLED = AttemptFailedError("loss", "Worker 1 on here was lost: its process was killed")


def lost(*last_steps: int) -> list[LostAttempt]:
    return [LostAttempt(2, 0, step, step, "") for step in last_steps]


def raised(error: Exception) -> AttemptFailedError:
    return failure_of(error, "Worker 0 on here")


def test_job_error_is_raised_at_once() -> None:
    error = SceneError("scene.ply: is truncated.")
    with pytest.raises(SceneError) as info:
        check_retry(raised(error), lost(0, 7), 0)
    assert info.value is error


def test_drifted_ranks_are_retried() -> None:
    failure = raised(RanksDriftedError("Rank 1 has other colors."))
    assert failure.kind == "loss"
    expected = "Worker 0 on here failed: Rank 1 has other colors, after step 5."
    assert check_retry(failure, lost(5), 1) == expected


@pytest.mark.parametrize("in_vain", range(MOST_ATTEMPTS))
def test_lost_ranks_are_retried_until_attempts_are_in_vain(in_vain: int) -> None:
    expected = "Worker 1 on here was lost: its process was killed, after step 8."
    assert check_retry(KILLED, lost(*range(0, 200, 10), 8), in_vain) == expected


@pytest.mark.parametrize(("kind", "error"), [("loss", RanksFailedError), ("machine", ClusterAwayError)])
def test_too_many_attempts_without_progress_give_up(kind: Literal["loss", "machine"], error: type[Exception]) -> None:
    with pytest.raises(error) as info:
        check_retry(AttemptFailedError(kind, KILLED.reason), lost(30, 20, 20, 20), MOST_ATTEMPTS)
    assert str(info.value) == (
        "3 attempts in a row came no further than step 30. The last one: Worker 1 on here was lost: its process was "
        "killed."
    )


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (RuntimeError("CUDA error"), RuntimeError),
        (MemoryError("can't allocate"), MemoryError),
        (RanksDriftedError("Rank 1 drifted."), RanksDriftedError),
        (KeyError("a"), RanksFailedError),
    ],
)
def test_error_of_last_attempt_is_raised(error: Exception, expected: type[Exception]) -> None:
    with pytest.raises(expected):
        check_retry(raised(error), lost(4, 4, 4), MOST_ATTEMPTS)


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


def test_resumed_attempt_relays_no_preparation() -> None:
    recorder = EventRecorder()
    recorder.after(RankStatus(prepared=Prepared([], 0, 10), progress=step(5), saved=4))
    assert recorder.relay.farthest == (5, 4)
    recorder.relay.begin_attempt()
    assert (recorder.relay.first_step, recorder.relay.last_step) == (None, 4)
    again = RankStatus(prepared=Prepared([], 4, 10))
    assert recorder.after(again, replace(again, progress=step(5))) == [("resumed", None), ("sos", 5)]
    assert (recorder.relay.first_step, recorder.relay.farthest) == (4, (5, 4))


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


def test_home_without_proc_names_host_and_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "platform", "darwin")
    assert home() == (socket.gethostname(), psutil.Process().username())


GB = 1_000_000_000


def test_scene_memory_is_its_decompressed_size() -> None:
    assert (scene_bytes("room.ply", GB), scene_bytes("ROOM.SPZ", 25_000_000)) == (GB, 248_000_000)
    assert scene_bytes("room.compressed.ply", 61_000_000) == 248_000_000
    assert memory_beside_gpus(4, 5 * GB) == 52 * GB, "every rank reads the scene"


@contextmanager
def taken(memory: int) -> Iterator[None]:
    """Reserve memory of the cluster within the block, as another job would."""
    from ray.util import placement_group, remove_placement_group

    group = placement_group([{"memory": memory}])
    assert group.wait(120)
    yield
    remove_placement_group(group)


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends processes with their parent")
@pytest.mark.usefixtures("joined")
def test_ray_grants_no_gpus_without_free_memory() -> None:
    """The cluster has two GPUs and 10 GB; a rank with a scene of 1 GB needs 5 GB."""
    with Cluster(2):
        reserved = reserve(2, GB)
        assert reserved.ranks == 2
        reserved.release()
        with taken(3 * GB):
            fewer = reserve(2, GB)
            assert (fewer.ranks, fewer.gpus) == (1, 1)
            fewer.release()
        with taken(6 * GB), pytest.raises(NoCapacityError, match="needs CPU 1, GPU 1, memory 5,000,000,000"):
            reserve(2, GB)
        again = reserve(2, GB)
        assert again.ranks == 2, "what was waited for in vain is not asked for any more"
        again.release()


@pytest.mark.parametrize("address", ["127.0.0.1:{port}", "ray://127.0.0.1:{port}", "127.0.0.1:99999", "a..b:6379"])
def test_cluster_that_is_not_there_is_reported_at_once(address: str) -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        address = address.format(port=closed.getsockname()[1])
        with pytest.raises(ClusterAwayError, match=f"{address} cannot be reached: .* Check RAY_ADDRESS"):
            Cluster(1, address).open()
