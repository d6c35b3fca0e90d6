"""Tests of messages that all commands share: after Ctrl-C, about words that an option does not accept, and warnings."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from service.settings import start
from tests.api.conftest import Sgsst
from tests.api.service import ROOT
from tests.full_disk import full_disk
from tests.small_scenes import wall, write_files

pytestmark = pytest.mark.usefixtures("one_thread", "tiny_installed")

#: Audit event and start of the path at which Ctrl-C arrives. It is cleared when that happens.
INTERRUPTED_AT: list[tuple[str, str]] = []


def _interrupt(event: str, arguments: tuple[object, ...]) -> None:
    if INTERRUPTED_AT and event == INTERRUPTED_AT[0][0] and str(arguments[0]).startswith(INTERRUPTED_AT[0][1]):
        INTERRUPTED_AT.clear()
        signal.raise_signal(signal.SIGINT)


@pytest.fixture(scope="module", autouse=True)
def hook() -> None:
    """Deliver Ctrl-C at a chosen access to a file. Hooks cannot be removed, but this one does nothing by itself."""
    sys.addaudithook(_interrupt)


def arguments(command: str, folder: Path, out: Path) -> list[str]:
    """Return a command with small inputs in a folder, which writes to another folder."""
    scene, views, style = map(str, write_files(folder, wall()))
    seen, styled = ["--cameras", views], ["--cameras", views, "--style", style]
    short = ["--fps", "2", "--seconds", "1"]
    return {
        "check": ["check", scene, *styled],
        "bench": ["bench", "quality", scene, *styled, "--out", str(out)],
        "stylize": ["stylize", scene, *styled, "--out", str(out / "out.ply")],
        "convert": ["convert", scene, str(out / "scene.ply")],
        "usd": ["convert", scene, str(out / "scene.usdc")],
        "blend": ["blend", scene, scene, "--out", str(out / "scene.ply")],
        "render": ["render", scene, *seen, "--out", str(out)],
        "video": ["render", scene, *seen, "--video", str(out / "video.mp4"), *short],
        "frames": ["render", scene, *seen, "--video", str(out), *short],
        "plan": ["plan", scene, *styled, "--out", str(out / "plan.json")],
        "study": ["study", "make", f"a={scene}", f"b={scene}", *styled, "--out", str(out / "a.html")],
    }[command]


@pytest.mark.parametrize(
    ("event", "command"),
    [
        *(("open", command) for command in ("check", "bench", "stylize")),
        # the temporary file is complete, and not yet at its place
        *(("os.rename", command) for command in ("convert", "render", "study", "plan")),
    ],
)
def test_ctrl_c_is_announced_and_leaves_no_file(event: str, command: str, tmp_path: Path, sgsst: Sgsst) -> None:
    out = tmp_path / "out"
    words = arguments(command, tmp_path, out)
    INTERRUPTED_AT.append((event, str(tmp_path / "scene.ply") if event == "open" else str(out)))
    said = sgsst(words, 130)
    assert not INTERRUPTED_AT
    assert said.splitlines()[-1] == "Aborted. Output files are complete or were not written."
    assert event == "open" or not [path for path in out.rglob("*") if path.is_file()]


@pytest.mark.parametrize(
    "command",
    ["convert", "blend", "render", "video", "frames", "study", "plan", pytest.param("usd", marks=pytest.mark.slow)],
)
def test_full_disk_is_one_message_and_leaves_no_file(command: str, tmp_path: Path, sgsst: Sgsst) -> None:
    out = tmp_path / "new" / "out"
    words = arguments(command, tmp_path, out)
    with full_disk(1000):
        said = sgsst(words, 2)
    (error,) = (line for line in said.splitlines() if line.startswith("error: "))
    assert error.startswith(f"error: {out}")
    assert "cannot be written: File too large. Free some space" in error
    assert not [path for path in out.parent.rglob("*") if path.is_file()]


def test_ctrl_c_during_imports_is_announced(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("import signal\n\nsignal.raise_signal(signal.SIGINT)\n")
    ended = subprocess.run(
        [sys.executable, "-m", "api.cli", "--help"],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])},
        capture_output=True,
        text=True,
        check=False,
    )
    assert (ended.returncode, ended.stderr) == (130, "Aborted. Output files are complete or were not written.\n")


def test_full_standard_output_is_one_message() -> None:
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "api.cli", "--help"]
        ended = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert ended.returncode == 2
    assert ended.stderr == "error: The standard output or a temporary file: No space left on device. Free some space.\n"


@pytest.mark.parametrize(
    "option", ["--render-mode", "--preset", "--precision", "--up", "--spz-axes", "--style-loss", "--unseen"]
)
def test_unknown_words_are_refused_with_the_valid_ones(option: str, sgsst: Sgsst) -> None:
    command = ["stylize", "scene.ply", "--style", "style.png", "--out", "out.ply", option, "foo"]
    assert f"Invalid value for '{option}': 'foo' is not one of '" in sgsst(command, 2)


@pytest.mark.parametrize(
    ("name", "value", "wrong"),
    [
        ("DATABASE", "postgres://me:secret@127.0.0.1:9/db", "Can't load plugin"),
        ("DATABASE", "mysql://me:secret@127.0.0.1:9/db", "the driver 'mysqldb' is not supported"),
        ("DATABASE", "postgresql+psycopg://me:secret@127.0.0.1:9/db?foo=1", 'invalid connection option "foo"'),
        ("DATABASE", "not a url", "Could not parse"),
        ("ARTIFACTS", "gs://bucket/x", "Please install gcsfs"),
        ("ARTIFACTS", "nowhere://x", "Protocol not known: nowhere"),
        ("TRUSTED_PROXIES", "127.0.0.1, 10.0.0.1/8", "10.0.0.1/8 has host bits set"),
        ("LOG_FORMAT", "xml", "'text' or 'json'"),
        ("DATA", "~nobody-has-this-name/x", "its home folder is unknown"),
    ],
)
def test_settings_that_cannot_be_used_are_named(
    name: str, value: str, wrong: str, monkeypatch: pytest.MonkeyPatch, sgsst: Sgsst
) -> None:
    if "psycopg" in value:
        pytest.importorskip("psycopg")
    monkeypatch.setenv(f"SGSST_{name}", value)
    message = sgsst(["keys", "list"], 2)
    assert message.startswith(f"error: Environment variable SGSST_{name}"), message
    assert wrong in message
    assert "secret" not in message
    with pytest.raises(SystemExit, match=f"^error: Environment variable SGSST_{name}"):  # processes of the service
        start()
