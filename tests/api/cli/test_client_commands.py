"""Tests of the client commands against a real service: messages, exit codes, and files."""

import json
import os
import signal
import subprocess
import sys
import threading
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import httpx2
import pytest
from PIL import Image

from api.cli.main import main
from api.client import Client
from api.client.transport import ApiError, RequestError
from service.states import JobStatus
from service.store.tables import JobRow
from tests.api.conftest import Sgsst
from tests.api.service import ROOT, Service
from tests.full_disk import full_disk
from tests.http_servers import LocalServer, send

MISSING = "job_1a1fe701a104f943e9d4d8cce5b818c"


@pytest.fixture(scope="module")
def files(paths: dict[str, Path]) -> list[str]:
    """Return the arguments of `submit` for a small scene."""
    return [str(paths["scene"]), "--style", str(paths["style"]), "--cameras", str(paths["cameras"])]


@pytest.fixture(autouse=True)
def url(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SGSST_URL", service.url)


def submit(files: list[str], sgsst: Sgsst, *options: str) -> str:
    """Submit a job, and return its id."""
    return sgsst(["submit", *files, *options]).strip()


def test_exit_codes_and_errors_as_json(
    files: list[str], capsys: pytest.CaptureFixture[str], sgsst: Sgsst, service: Service
) -> None:
    job_id = submit(files, sgsst)
    for command, code, kind in (
        (["status", MISSING], 3, "not-found"),
        (["retry", job_id], 4, "conflict"),
        (["finish", job_id], 4, "conflict"),
        (["status"], 2, "usage"),
        (["jobs", "--limt", "3"], 2, "usage"),
        (["submit", files[0], "--style", "missing.png", "--orbit", "3"], 2, ""),
        (["submit", *files, "--retention-days", "9999"], 2, "invalid-request"),
    ):
        assert main([*command, "--json"]) == code, command
        out, error = capsys.readouterr()
        assert out == ""
        content = json.loads(error)
        assert content["code"].startswith(kind)
        assert content["detail"]
    sgsst(["cancel", job_id])
    sgsst(["watch", job_id], 5)  # the job did not succeed
    assert sgsst(["status", MISSING], 3) == f"error: There is no job {MISSING}.\n"


def test_job_that_ended_early_says_how_little_was_done(files: list[str], sgsst: Sgsst, service: Service) -> None:
    job_id = submit(files, sgsst)
    service.finish(job_id, {"stylized.ply": b"result"}, stopped="within", steps=2, total=60, loss_after=1.94)
    shown = sgsst(["status", job_id])
    assert "2 of 60: its time budget was used up (submit it again with a larger `within`" in shown
    assert "(97.0%)" in shown
    assert "2 of 60: its time budget was used up" in sgsst(["watch", job_id])


def test_service_that_is_not_there_is_reported_at_once(sgsst: Sgsst, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is retried, so nothing is waited for; the port of a closed socket refuses connections."""
    waits: list[float] = []
    monkeypatch.setattr("api.cli.client_commands._print_retry", lambda details: waits.append(details.wait_for))
    for command in (["status", MISSING], ["jobs"], ["watch", MISSING], ["download", MISSING], ["cancel", MISSING]):
        assert "cannot be reached" in sgsst([*command, "--url", "http://127.0.0.1:9"], 1)
    assert waits == []


def test_interrupted_watch_says_that_the_job_continues(
    files: list[str], sgsst: Sgsst, service: Service, tmp_path: Path
) -> None:
    job_id = submit(files, sgsst)
    commands = (["watch", job_id], ["submit", *files, "--out", str(tmp_path / "out.ply")])
    for command in commands:
        process = subprocess.Popen(
            [sys.executable, "-m", "api.cli", *command],
            cwd=ROOT,
            env=os.environ | {"PYTHONPATH": str(ROOT)},
            stderr=subprocess.PIPE,
            text=True,
        )
        assert process.stderr is not None
        shown = ""
        while "queued" not in shown:
            line = process.stderr.readline()
            assert line, shown
            shown += line
        process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=60)[1]
        assert process.returncode == 130, shown + rest
        assert "The job continues on the service." in rest
        assert "Cancel: sgsst cancel job_" in rest
    assert httpx2.get(f"{service.url}/v1/jobs/{job_id}").json()["status"] == "queued"


def test_interrupted_batch_waits_for_its_jobs_again(
    files: list[str], tmp_path: Path, sgsst: Sgsst, service: Service
) -> None:
    out = tmp_path / "results"
    arguments = ["batch", *files, "--out", str(out), "--workers", "2", "--url", service.url]
    command = [sys.executable, "-m", "api.cli", *arguments]

    def interrupted_job() -> str:
        with subprocess.Popen(command, stderr=subprocess.PIPE, env=service.environment, cwd=ROOT, text=True) as process:
            assert process.stderr is not None
            assert "queued" in process.stderr.readline()  # the job is followed
            process.send_signal(signal.SIGINT)
            assert process.wait(60) == 130
        entry = json.loads((out / "batch.json").read_text())["scene_style"]
        assert entry["complete"] is False
        return str(entry["job"])

    expired = interrupted_job()
    with service.store() as store, store.database.writing() as session:
        session.get_one(JobRow, expired).status = JobStatus.EXPIRED
    job_id = interrupted_job()
    assert job_id != expired, "its result is gone"
    assert httpx2.get(f"{service.url}/v1/jobs/{job_id}").json()["parameters"]["workers"] == 2
    service.finish(job_id, {"stylized.ply": Path(files[0]).read_bytes()})
    sgsst(arguments)
    assert (out / "scene_style.ply").read_bytes() == Path(files[0]).read_bytes()
    assert Image.open(out / "batch.jpg").width > 100
    assert "complete" in sgsst([*arguments[:-1], "http://127.0.0.1:1"])


def test_download_replaces_no_file_of_another_job(
    files: list[str],
    sgsst: Sgsst,
    service: Service,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    ids = []
    for content in (b"first", b"second"):
        ids.append(submit(files, sgsst))
        service.finish(ids[-1], {"stylized.ply": content})
    monkeypatch.chdir(tmp_path)
    result = tmp_path / "stylized.ply"
    assert main(["download", ids[0]]) == 0
    assert main(["download", ids[0]]) == 0, "the same file again"
    assert "exists, and is not this job's file" in sgsst(["download", ids[1]], 2)
    assert result.read_bytes() == b"first"
    assert main(["download", ids[1], "--out", "other.ply"]) == 0
    assert main(["download", ids[1], "--overwrite"]) == 0
    assert result.read_bytes() == (tmp_path / "other.ply").read_bytes() == b"second"
    assert main(["download", ids[0], "all"]) == main(["download", ids[0], "all"]) == 0


@pytest.mark.parametrize(
    "name", ["{outside}", "../outside", "a/../../outside", r"..\outside", r"C:outside", r"\outside"]
)
def test_files_outside_of_the_folder_are_refused_before_the_download(sgsst: Sgsst, tmp_path: Path, name: str) -> None:
    requested = []
    artifacts = [{"name": each, "sha256": ""} for each in ("stylized.ply", name.format(outside=tmp_path / "outside"))]

    def answer(handler: BaseHTTPRequestHandler) -> None:
        requested.append(handler.path)
        send(handler, json.dumps({"artifacts": artifacts}).encode(), Content_Type="application/json")

    with LocalServer(answer) as server:
        said = sgsst(["download", MISSING, "all", "--out", str(tmp_path / "folder"), "--url", server.origin], 2)
    assert "which is outside of the download's folder" in " ".join(said.split())
    assert requested == [f"/v1/jobs/{MISSING}/artifacts"]
    assert list(tmp_path.iterdir()) == []


def test_outputs_are_checked_before_a_job_is_queued(
    files: list[str], sgsst: Sgsst, service: Service, tmp_path: Path
) -> None:
    """Neither the scene nor a file of another kind is overwritten, and nothing fails after the job has ended."""
    before = len(httpx2.get(f"{service.url}/v1/jobs").json()["jobs"])
    (tmp_path / "file").touch()
    for out, message in (
        (files[0], "is the scene itself"),
        (tmp_path, "is a folder. Name a file in it"),
        (tmp_path / "out.splat", "does not end in .ply"),
        (tmp_path / "file" / "out.ply", "there is a file of that name"),
    ):
        assert message in sgsst(["submit", *files, "--out", str(out)], 2)
    assert len(httpx2.get(f"{service.url}/v1/jobs").json()["jobs"]) == before


def test_names_of_results_are_checked_before_any_request(sgsst: Sgsst) -> None:
    for arguments, message in (
        (["--out", "x.usdz"], "x.usdz: does not end in .ply"),
        (["--out", "x.zip"], "x.zip: does not end in .ply"),
    ):
        assert message in " ".join(sgsst(["download", MISSING, *arguments, "--url", "http://127.0.0.1:1"], 2).split())


def test_webhook_events_are_checked_before_files_are_sent(files: list[str], sgsst: Sgsst) -> None:
    for event, message in (("ended", "is not started, progress or completed"), ("started", "requires --webhook")):
        assert message in sgsst(["submit", *files, "--webhook-events", event, "--url", "http://127.0.0.1:1"], 2)


def test_share_prints_the_link(files: list[str], sgsst: Sgsst, service: Service) -> None:
    job_id = submit(files, sgsst)
    assert "only results can be shared" in sgsst(["share", job_id], 4)
    service.finish(job_id, {"stylized.ply": b"result"})
    link = sgsst(["share", job_id, "--poster", "--days", "1"]).strip()
    assert link.startswith(f"{service.url}/shared/shr_")
    assert httpx2.get(link).status_code == 200
    assert "days" in sgsst(["share", job_id, "--days", "91"], 2)


def test_download_to_a_full_disk_can_be_resumed(
    files: list[str], sgsst: Sgsst, service: Service, tmp_path: Path
) -> None:
    job_id = submit(files, sgsst)
    service.finish(job_id, {"stylized.ply": bytes(200_000)})
    out = tmp_path / "new" / "out.ply"
    with full_disk(100_000):
        assert f"error: {out}: cannot be written: File too large." in sgsst(["download", job_id, "--out", str(out)], 2)
    assert not out.exists()
    sgsst(["download", job_id, "--out", str(out)])
    assert [(path, path.stat().st_size) for path in out.parent.iterdir()] == [(out, 200_000)]


@pytest.mark.parametrize("job_id", ["", "?", ".", "..", "a/b", "a b#c"])
@pytest.mark.parametrize("command", ["status", "watch", "download", "cancel", "delete"])
def test_id_that_no_job_has_is_refused(command: str, job_id: str, sgsst: Sgsst) -> None:
    assert sgsst([command, job_id], 3) == f"error: There is no job {job_id!r}. `sgsst jobs` lists the IDs of jobs.\n"


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--url", "http://127.0.0.1:abc", "not an address of a service"),
        ("--url", "http://", "not an address of a service"),
        ("--url", "http://127.0.0.1:65536", "not an address of a service"),
        ("--url", "http://127.0.0.1:-1", "not an address of a service"),
        ("--url", "http://a..b", "not an address of a service"),
        ("--key", "kéy", "Copy it again"),
        ("--key", "a\nb", "Copy it again"),
    ],
)
def test_address_or_key_that_cannot_be_used_is_refused(option: str, value: str, message: str, sgsst: Sgsst) -> None:
    assert message in sgsst(["jobs", option, value], 2)


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("ALL_PROXY", "socks5://user:secret@127.0.0.1:9"),
        ("http_proxy", "socks9://127.0.0.1:9"),
        ("HTTPS_PROXY", "http://[::1"),
        ("SSL_CERT_FILE", "/nonexistent"),
        ("SSL_CERT_FILE", os.devnull),
        ("SSLKEYLOGFILE", "/nonexistent/keys"),
    ],
)
def test_environment_that_cannot_be_used_is_reported(
    variable: str, value: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """No thread is left that would keep the process running."""
    monkeypatch.delenv("SSL_CERT_FILE", raising=False)
    monkeypatch.setenv("no_proxy", "elsewhere.example")
    monkeypatch.setenv(variable, value)
    before = threading.enumerate()
    assert main(["jobs"]) == 2
    assert threading.enumerate() == before
    shown = capsys.readouterr().err
    assert variable in shown.partition(" cannot be used")[0]
    assert "Correct or unset it." in shown
    assert "secret" not in shown
    with pytest.raises(RequestError, match="cannot be used"):
        Client()


def test_proxy_with_a_port_that_cannot_be_is_named(sgsst: Sgsst, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:65536")
    for command in (["jobs"], ["watch", MISSING]):
        assert "http_proxy decides on a proxy." in sgsst([*command, "--url", "http://service.example"], 1)


def test_variable_of_the_proxy_is_named_if_the_service_cannot_be_reached(
    sgsst: Sgsst, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("http_proxy", "http://user:secret@127.0.0.1:9")
    shown = sgsst(["jobs", "--url", "http://service.example"], 1)
    assert "--url names another address; http_proxy decides on a proxy." in shown
    assert "secret" not in shown
    monkeypatch.delenv("http_proxy")
    assert "proxy" not in sgsst(["jobs", "--url", "http://127.0.0.1:9"], 1)


EVIL = "\x1b]0;title\x07\x1b[2J\x9b2J\u202e[/red]"


def answer_in_color(handler: BaseHTTPRequestHandler) -> None:
    """Answer a request for a job, for all jobs or for events with texts that contain escape sequences."""
    job: dict[str, Any] = {"id": "job_1" + EVIL, "status": "running" + EVIL, "name": "name" + EVIL}
    job |= {"created_at": "2026-01-01T00:00:00Z", "result": None, "error": {"message": "error" + EVIL}}
    progress = {"stage": "stage" + EVIL, "step": 1, "total": 2, "fraction": 0.5}
    if handler.path.endswith("/events"):
        body = f"id: 1\nevent: progress\ndata: {json.dumps(progress)}\n\n"
    elif handler.path.startswith("/v1/jobs?"):
        body = json.dumps({"jobs": [{**job, "progress": progress}], "next_cursor": None})
    elif handler.path.endswith(MISSING):
        body = json.dumps({**job, "status": "failed"})
    else:
        body = json.dumps({"detail": "refused" + EVIL})
    kind = "text/event-stream" if body.startswith("id") else "application/json"
    send(handler, body.encode(), 404 if "detail" in body else 200, Content_Type=kind)


@pytest.mark.parametrize("terminal", [False, True])
def test_escape_sequences_of_a_service_are_not_printed(
    terminal: bool, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")
    with LocalServer(answer_in_color) as server:
        monkeypatch.setenv("SGSST_URL", server.origin)
        for command, code, text in (
            (["status", MISSING], 0, "error]0;title[2J2J[/red]"),
            (["jobs"], 0, "running]0;"),
            (["watch", MISSING], 5, "stage]0;"),
            (["status", "job_2"], 3, "refused]0;"),
        ):
            assert main(command) == code
            shown = "".join(capsys.readouterr())
            assert not any(evil in shown for evil in ("\x1b]", "\x07", "\x1b[2J", "\x9b", "\u202e"))
            assert text in shown or terminal
        server.shutdown()


def answer_as_a_stranger(handler: BaseHTTPRequestHandler) -> None:
    """Send a page, as another program at the address of the service, redirect `/moved`, or send nothing."""
    if handler.path.startswith("/moved"):
        send(handler, status=301, Location="https://new.example/")
    elif handler.path.startswith("/empty"):
        send(handler)
    else:
        send(handler, b"<html>", Content_Type="text/html")


def test_address_of_another_program_is_reported(sgsst: Sgsst) -> None:
    with LocalServer(answer_as_a_stranger) as server:
        for path, what in (
            ("", "200 and sends text/html"),
            ("/moved", "301 and redirects to https://new.example/"),
            ("/empty", "200 and sends no JSON"),
        ):
            for command in (["status", MISSING], ["jobs"], ["download", MISSING], ["watch", MISSING]):
                assert f" answers {what}, unlike the service. Check the address." in sgsst(
                    [*command, "--url", server.origin + path], 1
                )
        for path, what in (("", "sends text/html"), ("/moved", "redirects to https://new.example/")):
            assert what in sgsst(["delete", MISSING, "--url", server.origin + path], 1)
        with Client(server.origin) as client, pytest.raises(ApiError, match="sends text/html, unlike the service"):
            list(client.watch(MISSING))
        server.shutdown()
