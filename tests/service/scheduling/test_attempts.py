"""Tests of how an attempt ended, of its reports, and of publishing its files, without running a process."""

import errno
import io
import resource
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.numpy import save_file

from service import problems
from service.files.blobs import BlobFolder
from service.files.objects import Artifacts
from service.problems import NoSpaceError
from service.scheduling import attempt_process
from service.scheduling.attempt_files import Outbox, Publisher
from service.scheduling.attempt_process import report_failure, report_prepared, send
from service.scheduling.attempts import progress_seconds
from service.scheduling.housekeeping import clean_up
from service.scheduling.messages import Ending, Report, StopRequest, attempt_ending, cause_of_error, failure, outage
from service.settings import ServiceSettings
from service.states import AttemptOutcome, Cause, Published
from service.store import Store
from service.store.queue import Lease, cause_of
from sgsst_core.errors import (
    ClusterAwayError,
    DivergedError,
    ImageError,
    InfrastructureError,
    OutputError,
    RanksFailedError,
    WeightsError,
)
from sgsst_core.progress import Progress
from worker.execute import Prepared
from worker.job import Result

DONE = Ending(AttemptOutcome.SUCCEEDED, Result(stopped="finished", steps=3, total=3))
ERROR = {"code": "diverged", "message": "The loss is not finite."}
FAILED = Ending(AttemptOutcome.FAILED, error=ERROR, permanent=True)
REQUESTS = [None, StopRequest.CANCEL, StopRequest.RELEASE]


def ending(
    requested: StopRequest | None, last: Ending | None, code: int = 0, log: str = "the log", **has: bool
) -> Ending:
    return attempt_ending(requested, last, code, log, **{"has_result": True, **has})


@pytest.mark.parametrize("requested", REQUESTS)
def test_finished_attempt_beats_stop_request(requested: StopRequest | None) -> None:
    assert ending(requested, DONE) == DONE


@pytest.mark.parametrize("requested", REQUESTS)
def test_finished_attempt_without_a_result_fails(requested: StopRequest | None) -> None:
    outcome = ending(requested, DONE, has_result=False)
    assert (outcome.outcome, outcome.permanent) == (AttemptOutcome.FAILED, False)
    assert outcome.error == {"code": "internal", "message": "The job ended without a result."}


@pytest.mark.parametrize(
    ("requested", "outcome"), [(StopRequest.CANCEL, "canceled"), (StopRequest.RELEASE, "released")]
)
@pytest.mark.parametrize("last", [FAILED, None])
@pytest.mark.parametrize("code", [0, 1, -signal.SIGKILL])
def test_requested_stop_is_not_a_failure(requested: StopRequest, outcome: str, last: Ending | None, code: int) -> None:
    assert ending(requested, last, code) == Ending(AttemptOutcome(outcome))


def test_process_ended_by_ray_is_an_outage() -> None:
    """When the cluster's head dies, Ray terminates connected processes with exit code 1 and without a message."""
    outcome = ending(None, None, 1, "raylet has died", cluster=True)
    assert (outcome.outcome, outcome.error, outcome.permanent) == (AttemptOutcome.FAILED, outage(Cause.MACHINE), False)
    assert outcome.detail == "The process that ran the job ended with code 1.\nraylet has died"
    for other in (ending(None, None, 1), ending(None, None, -signal.SIGKILL, cluster=True)):
        assert other.error is not None
        assert other.error["code"] == "crashed"
    assert ending(None, FAILED, 1, cluster=True).error == ERROR


@pytest.mark.parametrize("permanent", [False, True])
def test_reported_failure_is_recorded_unchanged(permanent: bool) -> None:
    last = Ending(AttemptOutcome.FAILED, error=ERROR, permanent=permanent)
    assert ending(None, last) == last


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (-signal.SIGKILL, "was killed; the machine may have run out of memory"),
        (-signal.SIGSEGV, "was ended by SIGSEGV"),
        (3, "ended with code 3"),
        (0, "ended with code 0"),
    ],
)
def test_process_without_a_reported_ending_has_crashed(code: int, text: str) -> None:
    outcome = ending(None, None, code)
    assert (outcome.outcome, outcome.permanent) == (AttemptOutcome.FAILED, False)
    error: dict[str, Any] = outcome.error or {}
    assert (error["code"], error["log"]) == ("crashed", "the log")
    assert text in error["message"]


@pytest.mark.parametrize(
    ("error", "cause"),
    [
        (problems.STORE_UNAVAILABLE("The store of files does not answer."), Cause.STORE),
        (problems.DATABASE_BUSY(), Cause.DATABASE),
        (problems.NO_SPACE("The disk is full."), Cause.DISK),
        (OutputError("out/stylized.ply: cannot be written: No space left on device."), Cause.DISK),
        (OSError(errno.ENOSPC, "No space left on device"), Cause.DISK),
        (OSError("24576 requested and 4096 written"), Cause.DISK),
        (RuntimeError("Error while serializing: I/O error: No space left on device (os error 28)"), Cause.DISK),
        (WeightsError("no VGG weights in /root/.cache/sgsst"), Cause.MACHINE),
        (InfrastructureError("The folder is not on this machine."), Cause.MACHINE),
        (ClusterAwayError("The Ray cluster at head:6379 cannot be joined."), Cause.MACHINE),
        (OSError(errno.EINVAL, "Invalid argument"), Cause.JOB),
        (ImageError("style.png: is not an image"), Cause.JOB),
        (MemoryError("out of memory"), Cause.JOB),
        (RanksFailedError("3 attempts in a row came no further than step 0."), Cause.JOB),
    ],
)
def test_cause_of_each_error(error: Exception, cause: Cause) -> None:
    assert cause_of_error(error) == cause
    reported, its_own = failure(error), cause == Cause.JOB
    assert (reported.error == outage(cause)) == (not its_own)
    assert cause_of(reported.error) == cause
    assert (str(error) in (reported.detail or "")) == (not its_own), "for the operator"
    assert reported.outcome == AttemptOutcome.FAILED
    assert its_own or not reported.permanent


def test_process_of_an_attempt_starts_without_libraries_of_the_service() -> None:
    code = (
        "import sys, worker.run, service.scheduling.attempt_process; "
        "print(*{'sqlalchemy', 'httpx2', 'fsspec', 'pydantic_settings', 'torch'} & set(sys.modules))"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == ""


@pytest.fixture
def channel(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """Return the stream that receives the attempt's reports to the dispatcher."""
    written = io.StringIO()
    monkeypatch.setattr(attempt_process, "_channel", written)
    return written


def reports(channel: io.StringIO) -> list[Report]:
    """Return the reports as the dispatcher reads them."""
    return [Report.model_validate_json(line) for line in channel.getvalue().splitlines()]


def test_dispatcher_gets_progress_unchanged(channel: io.StringIO) -> None:
    sent = [
        Progress(stage="planning", step=0, total=8),
        Progress(stage="sos", step=6, total=12, loss=0.5, scales=[None, 0.5], seconds=20.0, eta_s=10.0),
        Progress(stage="measuring", step=60, total=60, loss=0.5, views_checked=3, views_to_check=8),
    ]
    for each in sent:
        send(Report(progress=each))
    assert [report.progress for report in reports(channel)] == sent


def test_plan_is_logged_before_the_first_step(channel: io.StringIO, capsys: pytest.CaptureFixture[str]) -> None:
    report_prepared(Prepared([("scene", "616 Gaussians")], 3, 12))
    assert reports(channel) == [Report(prepared=True)]
    assert "scene: 616 Gaussians" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "traced"),
    [
        (DivergedError("The loss is not finite."), False),
        (RanksFailedError("3 attempts came no further."), True),
        (ZeroDivisionError("by zero"), True),
    ],
)
def test_log_has_tracebacks_of_unexpected_errors_only(
    error: Exception, traced: bool, channel: io.StringIO, capsys: pytest.CaptureFixture[str]
) -> None:
    error.add_note("Worker 0 on here:\nTraceback (most recent call last):")
    report_failure(error)
    assert [report.ending for report in reports(channel)] == [failure(error)]
    log = capsys.readouterr().err
    assert str(error) in log
    assert ("Worker 0" in log) == traced


def test_long_running_job_writes_progress_less_often() -> None:
    assert [progress_seconds(elapsed) for elapsed in (0, 30, 60, 120, 300, 1e6)] == [1, 1, 1, 2, 5, 5]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "attempt" / "out" / "previews").mkdir(parents=True)
    (tmp_path / "attempt" / "log.txt").write_text("first\n")
    return tmp_path / "attempt"


@pytest.fixture
def publisher(lease: Lease, folder: Path, store: Store, settings: ServiceSettings) -> Publisher:
    return Publisher(lease, folder, store, Artifacts(settings.artifacts_url), log_seconds=1e6)


def announced(store: Store, lease: Lease) -> list[str]:
    """Return the names of the files that were announced to watchers, in order."""
    return [event.data["name"] for event in store.jobs.events(lease.job_id, 0) if event.kind == "artifact"]


def test_full_disk_delays_publishing(folder: Path, settings: ServiceSettings) -> None:
    """The limit on the size of files stands for a disk without space."""
    outbox = Outbox("job_1", 1, folder / "out", Artifacts(settings.artifacts_url))
    (folder / "out" / "stylized.views.jpg").write_bytes(bytes(1 << 20))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 16, hard))
    put: list[Published] = []
    try:
        with pytest.raises(NoSpaceError):
            outbox.put(outbox.unfinished(), put.append)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert put == []
    assert stored_names(settings) == []
    outbox.put(outbox.unfinished(), put.append)
    assert [file.name for file in put] == ["views.jpg"]


def content(store: Store, settings: ServiceSettings, lease: Lease, name: str) -> bytes:
    row = store.jobs.artifact(lease.job_id, name)
    assert row is not None
    return b"".join(Artifacts(settings.artifacts_url).objects.read(row.location, 0, row.size))


def stored_names(settings: ServiceSettings) -> list[str]:
    return sorted(path.name for path in (settings.folder / "artifacts").rglob("*") if path.is_file())


def test_new_and_changed_files_are_published(
    publisher: Publisher, folder: Path, store: Store, settings: ServiceSettings, lease: Lease
) -> None:
    publisher.publish_unfinished(whole_log=True)
    assert announced(store, lease) == ["log.txt"]
    (folder / "out" / "stylized.plan.json").write_text("{}")
    (folder / "out" / "previews" / "step_000010.jpg").write_bytes(b"jpg")
    (folder / "out" / "previews" / "half").write_bytes(b"no preview")
    publisher.publish_unfinished()
    publisher.publish_unfinished()
    assert sorted(announced(store, lease)) == ["log.txt", "plan.json", "previews/step_000010.jpg"]
    (folder / "out" / "stylized.plan.json").write_text('{"decisions": []}')
    publisher.publish_unfinished()
    assert announced(store, lease)[-1] == "plan.json"
    assert content(store, settings, lease, "plan.json") == b'{"decisions": []}'
    assert stored_names(settings) == ["log.txt", "plan.json", "step_000010.jpg"], "the older plan is still there"


def test_live_colors_are_published_until_the_job_has_succeeded(
    publisher: Publisher, folder: Path, store: Store, settings: ServiceSettings, lease: Lease
) -> None:
    live = folder / "out" / "live"
    live.mkdir()
    (live / "scene.ply").write_bytes(b"scene")
    for colors in (b"one", b"two"):
        (live / ".colors.part").write_bytes(colors)
        (live / ".colors.part").replace(live / "colors.f16")
        publisher.publish_unfinished()
        assert content(store, settings, lease, "live/colors.f16") == colors
    assert content(store, settings, lease, "live/scene.ply") == b"scene"
    assert stored_names(settings).count("colors.f16") == 1, "the older one is still there"
    (folder / "out" / "stylized.ply").write_bytes(b"ply")
    publisher.succeed({})
    clean_up(store, Artifacts(settings.artifacts_url), BlobFolder(settings.folder, store.inputs, 0))
    assert stored_names(settings) == ["log.txt", "stylized.ply"]
    assert [row.name for row in store.jobs.artifacts(lease.job_id)] == ["log.txt", "stylized.ply"]


def test_log_is_copied_periodically_and_completely_at_the_end(
    publisher: Publisher, folder: Path, store: Store, settings: ServiceSettings, lease: Lease
) -> None:
    publisher.publish_unfinished(whole_log=True)
    (folder / "log.txt").write_text("first\nsecond\n")
    publisher.publish_unfinished()
    assert content(store, settings, lease, "log.txt") == b"first\n"
    publisher.publish_unfinished(whole_log=True)
    assert content(store, settings, lease, "log.txt") == b"first\nsecond\n"
    assert publisher.log_tail() == "first\nsecond\n"


def test_published_checkpoint_records_its_step(publisher: Publisher, folder: Path, store: Store, lease: Lease) -> None:
    checkpoint = folder / "out" / "stylized.checkpoint.safetensors"
    for step, saved in ((10, 10), (25, 25), (None, 25)):
        if step is None:
            checkpoint.write_bytes(b"damaged")
        else:
            save_file({"x": np.zeros(step)}, checkpoint, metadata={"step": str(step)})
        publisher.publish_unfinished()
        assert store.jobs.get(lease.job_id, None).saved_step == saved
    assert announced(store, lease) == ["log.txt"], "checkpoints are not announced"


def test_success_publishes_results_and_sweeps_leftovers(
    publisher: Publisher, folder: Path, store: Store, settings: ServiceSettings, lease: Lease
) -> None:
    save_file({"x": np.zeros(1)}, folder / "out" / "stylized.checkpoint.safetensors", metadata={"step": "1"})
    publisher.publish_unfinished(whole_log=True)
    assert not publisher.has_result()
    for name in ("stylized.ply", "stylized.report.json", "stylized.loss.png", "stray.txt"):
        (folder / "out" / name).write_text(name)
    for name, epoch in (("cut_off.jpg", lease.epoch), ("later.jpg", lease.epoch + 1)):
        Artifacts(settings.artifacts_url).put(lease.job_id, epoch, name, folder / "log.txt")
    assert publisher.has_result()
    publisher.succeed({"steps": 1})
    clean_up(store, Artifacts(settings.artifacts_url), BlobFolder(settings.folder, store.inputs, 0))
    job = store.jobs.get(lease.job_id, None)
    assert (job.status, job.result) == ("succeeded", {"steps": 1})
    names = ["log.txt", "loss.png", "report.json", "stylized.ply"]
    assert [row.name for row in store.jobs.artifacts(lease.job_id)] == names
    assert stored_names(settings) == ["later.jpg", *names], "the row of a derived file may be still to come"
    assert store.jobs.unswept(10) == []
