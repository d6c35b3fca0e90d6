"""A reader that has been taken over: what it tries fails, and the files of others are checked as before."""

from __future__ import annotations

import inspect as source
import json
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from service.errors import RefusedInputError
from service.inspection import inspector, sandbox
from tests.service.inspection import attack
from tests.service.inspection.test_limits import inspect
from tests.small_scenes import wall, write_files

COMPROMISED = Path(__file__).with_name("compromised.py")
pytestmark = pytest.mark.skipif(bool(sandbox.missing()), reason=f"the kernel lacks {sandbox.missing()}")


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    scene, cameras, style = write_files(tmp_path, wall())
    return {"scene": scene, "cameras": cameras, "style": style}


@pytest.fixture
def target(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[str, Any]]:
    """What an attacker is after. The listener is on loopback, and would take a connection."""
    for name in ("PGPASSWORD", "AWS_SECRET_ACCESS_KEY", "RAY_AUTH_TOKEN"):
        monkeypatch.setenv(name, "secret")
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "there").write_text("there")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield {
            "data": str(tmp_path / "data"),
            "blob": str(outside / "there"),
            "outside": str(outside),
            "port": listener.getsockname()[1],
            "api": os.getpid(),
            "own": "scene/scene.ply",
        }


def attacked(
    monkeypatch: pytest.MonkeyPatch, folder: Path, files: dict[str, Path], target: dict[str, Any], *lacking: str
) -> dict[str, Any]:
    """What an attack reports of itself."""
    monkeypatch.setattr(inspector, "COMMAND", (sys.executable, str(COMPROMISED), *lacking))
    code = f"# attack\n{source.getsource(attack)}\ntold = attack({target!r})\n".encode()
    scene = folder / "attack" / "scene.ply"
    scene.parent.mkdir()
    scene.write_bytes(code)
    with pytest.raises(RefusedInputError) as caught:
        inspect(folder, {**files, "scene": scene})
    found: dict[str, Any] = json.loads(str(caught.value))
    assert scene.read_bytes() == code
    assert "landlock" in lacking or (Path(target["outside"]) / "there").read_text() == "there"
    assert inspect(folder, files)["gaussians"] == 616, "others' files are checked as before"
    return found


def allowed(outcomes: dict[str, str]) -> set[str]:
    return {name for name, outcome in outcomes.items() if outcome == "done"}


def test_a_reader_that_is_taken_over_reaches_nothing(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, files: dict[str, Path], target: dict[str, Any]
) -> None:
    found = attacked(monkeypatch, tmp_path, files, target)
    assert allowed(found["files"]) == {"read own scene"}, found["files"]
    assert allowed(found["calls"]) == set(), found["calls"]
    assert set(found["files"].values()) | set(found["calls"].values()) <= {"done", "EACCES", "EPERM", "EXDEV"}
    assert "secret" not in found["environment"].values()
    assert found["environment"].keys() <= {*inspector._ENVIRONMENT, *THREADS}
    assert found["log"] == "/dev/null"
    assert len(found["descriptors"]) == 4, "nothing, thrice, and the pipe that its answer goes through"
    assert sorted(path.name for path in Path(target["outside"]).iterdir()) == ["there"]


THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "CUDA_VISIBLE_DEVICES")
THREADS += ("LC_CTYPE",)  # of Python's own making, where there is no locale


def test_without_landlock_network_and_processes_are_out_of_reach(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, files: dict[str, Path], target: dict[str, Any]
) -> None:
    target["data"] = target["outside"]  # what can be written to is at most one byte of nobody's
    found = attacked(monkeypatch, tmp_path, files, target, "landlock")
    assert allowed(found["calls"]) == set(), found["calls"]
    for name in ("write a huge file", "write outside", "write to own scene"):
        assert found["files"][name] == "EFBIG", found["files"]
    assert "secret" not in found["environment"].values()


def test_without_seccomp_files_and_signals_are_out_of_reach(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, files: dict[str, Path], target: dict[str, Any]
) -> None:
    found = attacked(monkeypatch, tmp_path, files, target, "seccomp")
    assert allowed(found["files"]) == {"read own scene"}, found["files"]
    refused = {"trace the parent", "trace the API", "memory that is a file"}
    refused |= {"connect"} if sandbox._landlock_version() >= 4 else set()
    refused |= {"signal the parent", "signal the API"} if sandbox._landlock_version() >= 6 else set()
    assert not allowed(found["calls"]) & refused, found["calls"]
    assert "secret" not in found["environment"].values()


@pytest.mark.parametrize(
    "answer",
    [
        "x" * 10_000,
        "[" * 100_000,
        "[]",
        "{}",
        '{"error": {}}',
        '{"error": {"code": 1, "message": [], "input": {}}}',
        '{"found": 7}',
        '{"found": {}}\n{"found": {"gaussians": 7}}',
    ],
)
def test_forged_answers_reach_nobody_else(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, files: dict[str, Path], answer: str
) -> None:
    monkeypatch.setattr(inspector, "COMMAND", (sys.executable, str(COMPROMISED)))
    scene = tmp_path / "attack" / "scene.ply"
    scene.parent.mkdir()
    write = f"os.write(descriptor, {answer.encode()!r} + bytes([10]))"
    code = f"import os\nfor descriptor in range(16):\n    try: {write}\n    except OSError: pass\nos._exit(0)\n"
    scene.write_text(f"# attack\n{code}")
    if answer.startswith('{"found": {}}'):  # about its own files it may say what it likes
        assert inspect(tmp_path, {**files, "scene": scene}) == {}
    else:
        with pytest.raises(RefusedInputError, match="breaks their reader"):
            inspect(tmp_path, {**files, "scene": scene})
    assert inspect(tmp_path, files)["gaussians"] == 616
