"""Tests that jobs with killed, suspended or disconnected ranks give the same results as an undisturbed run."""

import json
import os
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import psutil
import pytest
from PIL import Image

from sgsst_core.progress import Progress
from tests.api.service import PATIENCE, wait_for
from tests.worker.ranks.faults import Fault, FaultyRank, fired, folders, name_of, shared_memory, small_request
from worker.execute import Prepared, execute, prepare
from worker.job import JobSpec
from worker.ranks.cluster import Cluster
from worker.ranks.driver import stylize_on_ranks
from worker.run import Ended, Listener, WorkerOptions

pytestmark = [
    pytest.mark.usefixtures("one_thread", "vgg16_weights"),
    pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux ends processes with their parent"),
]

ROOT = Path(__file__).resolve().parents[3]
STEPS = 24
#: Maximum relative difference of the loss from that of an undisturbed run.
TOLERANCE = 1e-3


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    before = os.environ.get("PYTHONPATH")
    os.environ["PYTHONPATH"] = os.pathsep.join([str(ROOT), *([before] if before else [])])
    os.environ.pop("RAY_ADDRESS", None)
    with Cluster(2) as opened:
        yield opened
    if before is None:
        del os.environ["PYTHONPATH"]
    else:
        os.environ["PYTHONPATH"] = before


@dataclass
class EventRecorder:
    """Recorder of a job's events, which stops the job at step `stop_at`."""

    stop_at: int | None = None
    finish_at: int | None = None
    planned: list[Progress] = field(default_factory=list)
    prepared: list[Prepared] = field(default_factory=list)
    steps: list[int] = field(default_factory=list)
    happened: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def listener(self) -> Listener:
        def progress(current: Progress) -> None:
            if current.is_step:
                self.steps.append(current.step)
            elif current.total:
                self.planned.append(current)

        def reached(step: int | None) -> bool:
            return step is not None and bool(self.steps) and self.steps[-1] >= step

        return Listener(
            prepared=self.prepared.append,
            progress=progress,
            happened=self.happened.append,
            warn=self.warnings.append,
            stop=lambda: reached(self.stop_at),
            finish=lambda: reached(self.finish_at),
        )


def run(
    request: JobSpec,
    cluster: Cluster,
    events: EventRecorder | None = None,
    fault: Fault | None = None,
    workers: int = 2,
) -> Ended:
    """Run a job on ranks, optionally with a fault, with a checkpoint after almost every step.

    Ranks without a fault may take long: on a busy machine, one compiles kernels for minutes while the other waits.
    """
    if fault is not None:
        fault.write(request)
    options = WorkerOptions(
        rank_timeout=WorkerOptions.rank_timeout if fault is None else 5.0,
        checkpoint_seconds=0.2,
        preview_folder=request.out.with_name("previews"),
        preview_seconds=0.1,
        actor=FaultyRank,
    )
    return stylize_on_ranks(request, workers, (events or EventRecorder()).listener(), options=options, cluster=cluster)


def loss_of(ended: Ended) -> float:
    """Return the final loss on the evaluation views."""
    assert ended.result is not None
    assert ended.result.loss_after is not None
    return ended.result.loss_after


@pytest.fixture(scope="module")
def undisturbed(cluster: Cluster, tmp_path_factory: pytest.TempPathFactory) -> tuple[float, bytes]:
    """Return the final loss and the result file of a run on two ranks without a fault."""
    request = small_request(tmp_path_factory.mktemp("undisturbed"), STEPS)
    events = EventRecorder()
    ended = run(request, cluster, events)
    assert ended.attempts == []
    order = ("planning", "starting")
    passed = [(order.index(now.stage), now.step) for now in events.planned]  # the latest ones that were asked for
    assert passed == sorted(set(passed))
    assert passed
    assert events.steps[-1] == ended.total == STEPS
    report = json.loads(request.out.with_name("s.report.json").read_text())
    assert (report["workers"]["used"], len(report["workers"]["ranks"])) == (2, 2)
    previews = list(request.out.with_name("previews").iterdir())
    assert previews
    for path in previews:
        with Image.open(path) as image:
            assert image.format == "JPEG"
    return loss_of(ended), request.out.read_bytes()


@pytest.mark.slow
def test_two_ranks_reach_the_loss_of_one_rank(undisturbed: tuple[float, bytes], tmp_path: Path) -> None:
    job = prepare(small_request(tmp_path, STEPS))
    alone = execute(job, Listener(warn=pytest.fail))
    assert undisturbed[0] == pytest.approx(alone.loss_after, rel=TOLERANCE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (Fault(1, "all_reduce", 30, "SIGKILL", 0.001), "was killed"),
        (Fault(0, "checkpoint", 4, "SIGKILL"), "was killed"),
        (Fault(1, "render", 25, "SIGSTOP"), "not answered"),
    ],
)
def test_lost_rank_costs_at_most_a_checkpoint_interval(
    fault: Fault, reason: str, undisturbed: tuple[float, bytes], cluster: Cluster, tmp_path: Path
) -> None:
    request, events = small_request(tmp_path, STEPS), EventRecorder()
    ended = run(request, cluster, events, fault)
    assert fired(request) is not None
    assert [reason in attempt.reason for attempt in ended.attempts] == [True]
    lost = ended.attempts[0]
    assert 0 < lost.saved_step <= lost.last_step
    assert len(events.prepared) == 1
    assert "Resuming from step" in events.happened[-1]
    # Two ranks again add in the same order, so the file is the same.
    assert loss_of(ended) == pytest.approx(undisturbed[0], rel=TOLERANCE)
    assert request.out.read_bytes() == undisturbed[1]
    report = json.loads(request.out.with_name("s.report.json").read_text())
    assert [entry["reason"] for entry in report["workers"]["attempts"]] == [lost.reason]
    assert report["workers"]["seconds_lost"] > 0
    assert len(report["history"]) == STEPS
    assert {path.suffix for path in request.out.parent.iterdir()} & {".safetensors", ".part"} == set()


@pytest.mark.slow
def test_job_survives_killed_raylet(undisturbed: tuple[float, bytes], cluster: Cluster, tmp_path: Path) -> None:
    request, events = small_request(tmp_path, STEPS), EventRecorder()
    killed: list[int] = []

    def stop() -> bool:
        if events.steps and not killed:
            raylet = next(child for child in psutil.Process().children() if name_of(child) == "raylet")
            killed.append(raylet.pid)
            raylet.kill()
        return False

    options = WorkerOptions(rank_timeout=5.0, checkpoint_seconds=0.2)
    ended = stylize_on_ranks(request, 2, replace(events.listener(), stop=stop), options=options, cluster=cluster)
    assert killed
    assert (len(ended.attempts), loss_of(ended)) == (1, pytest.approx(undisturbed[0], rel=TOLERANCE))


@pytest.mark.slow
def test_full_disk_skips_checkpoint_and_canceled_job_resumes(
    undisturbed: tuple[float, bytes], cluster: Cluster, tmp_path: Path
) -> None:
    request, events = small_request(tmp_path, STEPS), EventRecorder(stop_at=8)
    ended = run(request, cluster, events, Fault(0, "checkpoint", 1, "full"))
    assert ["The checkpoint could not be written" in line for line in events.warnings] == [True]
    assert ended.interrupted
    assert ended.attempts == []
    assert 8 <= ended.step < STEPS
    assert ended.saved == ended.step
    assert not request.out.exists()
    events = EventRecorder()
    ended = run(request.model_copy(update={"resume": True}), cluster, events)
    assert events.prepared[0].step > 0
    assert loss_of(ended) == pytest.approx(undisturbed[0], rel=TOLERANCE)


@pytest.mark.slow
def test_job_that_is_finished_early_keeps_its_colors(cluster: Cluster, tmp_path: Path) -> None:
    request = small_request(tmp_path, 100_000)
    ended = run(request, cluster, EventRecorder(finish_at=4))
    assert not ended.interrupted
    assert ended.result is not None
    assert (ended.result.stopped, ended.result.report_error) == ("on-request", None)
    assert 4 <= ended.step < 100_000
    assert request.out.exists()
    report = json.loads(request.out.with_name("s.report.json").read_text())
    assert (report["stopped"], report["workers"]["used"]) == ("on-request", 2)


# --- the command ---------------------------------------------------------------------------------------------------


def command(request: JobSpec, *options: str) -> list[str]:
    """Return the arguments of `sgsst stylize` for the same job."""
    source = request.source
    files = [str(source.scene), "--cameras", str(source.cameras), "--style", str(request.styles[0].path)]
    settings = ["--backbone", "vgg16", "--steps-sos", "400", "--no-early-stop"]
    return ["stylize", *files, "--out", str(request.out), *settings, "--workers", "2", *options]


def start(arguments: list[str]) -> subprocess.Popen[str]:
    """Start the command in a process, and wait until it has printed its plan."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    environment.pop("RAY_ADDRESS", None)
    process = subprocess.Popen(
        [sys.executable, "-m", "api.cli", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if line.startswith("schedule"):
            return process
    raise AssertionError(process.communicate()[1])


@pytest.mark.slow
def test_killed_driver_leaves_no_processes_or_files(tmp_path: Path) -> None:
    process = start(command(small_request(tmp_path, STEPS)))
    family = [child for child in psutil.Process(process.pid).children(recursive=True) if child.is_running()]
    used = folders(family)
    assert any("RankProcess" in name_of(child) for child in family)
    assert used
    stopped = next(child for child in family if "RankProcess" in name_of(child))
    stopped.suspend()
    shared = shared_memory(family)
    process.kill()
    process.communicate()
    _, alive = psutil.wait_procs(family, timeout=PATIENCE)
    assert alive == []
    wait_for(lambda: not any(path.exists() for path in used | shared), "the job's folders and memory to be deleted")


@pytest.mark.slow
def test_ctrl_c_saves_and_prints_the_command_that_resumes(tmp_path: Path) -> None:
    request = small_request(tmp_path, STEPS)
    arguments = command(request)
    process = start(arguments)
    os.killpg(process.pid, signal.SIGINT)  # like a terminal, also to Ray's processes
    _, error = process.communicate(timeout=120)
    assert process.returncode == 130, error
    assert "Traceback" not in error
    assert f"saved in {request.out.with_name('s.checkpoint.safetensors')}" in error
    assert shlex.split(error.strip().splitlines()[-1]) == ["sgsst", *arguments, "--resume"]
