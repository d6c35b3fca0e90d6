"""Tests of the sandbox around readers: attacks by a compromised reader fail, and other users' files still pass."""

import errno
import inspect as source
import json
import os
import secrets
import socket
import struct
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import sgsst_core
from service.deadlines import FileThreads
from service.files.blobs import BlobFolder
from service.inspection import inspector, sandbox
from service.inspection.inspector import Inspector
from service.inspection.process import MAX_REPORTS
from service.problems import ServiceError
from service.settings import ServiceSettings
from service.store import open_store
from tests.api.service import PATIENCE, ROOT, Service
from tests.service.inspection import attack
from tests.service.inspection.test_inspector import Inspect, inspecting
from tests.small_scenes import input_files

COMPROMISED = Path(__file__).with_name("compromised.py")
#: Variables set for the libraries and by `sgsst_core`; Python itself adds LC_CTYPE if there is no locale.
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS")
ADDED = {*THREADS, "CUDA_VISIBLE_DEVICES", "LC_CTYPE", "PYTORCH_ALLOC_CONF"}
pytestmark = pytest.mark.skipif(bool(sandbox.missing()), reason=f"the kernel lacks {sandbox.missing()}")


@pytest.fixture
def files(tmp_path: Path) -> dict[str, Path]:
    """Return files with a name of their own, so that findings about those of another test are not reused."""
    files = input_files(tmp_path)
    return files | {"scene": files["scene"].rename(tmp_path / f"{secrets.token_hex(4)}.ply")}


@contextmanager
def compromised(folder: Path, *lacking: str) -> Iterator[Inspect]:
    """Yield a function that inspects files in a compromised process, whose parent's environment has secrets."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(inspector, "COMMAND", (sys.executable, str(COMPROMISED), *lacking))
        for name in ("PGPASSWORD", "AWS_SECRET_ACCESS_KEY", "RAY_AUTH_TOKEN"):
            patch.setenv(name, "secret")
        with inspecting(folder) as inspect:
            yield inspect


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the process that several tests attack."""
    return tmp_path_factory.mktemp("shared")


@pytest.fixture(scope="module")
def inspect_shared(shared: Path) -> Iterator[Inspect]:
    """Yield a function that inspects files in a compromised process which survives the attacks of all tests."""
    with compromised(shared) as inspect:
        yield inspect


@pytest.fixture
def target(tmp_path: Path) -> Iterator[dict[str, Any]]:
    """Yield the description of an attack's targets, among them a listening socket on loopback."""
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
    inspect: Inspect, folder: Path, files: dict[str, Path], target: dict[str, Any], *, landlock: bool = True
) -> dict[str, Any]:
    """Run the attack in a reader, and return the outcomes that it reports."""
    code = f"# attack\n{source.getsource(attack)}\nreached = attack({target!r})\n".encode()
    scene = folder / "attack" / "scene.ply"
    scene.parent.mkdir()
    scene.write_bytes(code)
    with pytest.raises(ServiceError) as caught:
        inspect({**files, "scene": scene})
    reached: dict[str, Any] = json.loads(str(caught.value))
    assert scene.read_bytes() == code
    assert not landlock or (Path(target["outside"]) / "there").read_text() == "there"
    assert inspect(files)["gaussians"] == 616, "others' files are checked as before"
    return reached


def allowed(outcomes: dict[str, str]) -> set[str]:
    return {name for name, outcome in outcomes.items() if outcome == "done"}


def test_compromised_reader_reaches_nothing(
    inspect_shared: Inspect, shared: Path, tmp_path: Path, files: dict[str, Path], target: dict[str, Any]
) -> None:
    target["data"] = str(shared / "data")
    reached = attacked(inspect_shared, tmp_path, files, target)
    assert allowed(reached["files"]) == {"read own scene"}, reached["files"]
    assert allowed(reached["calls"]) == set(), reached["calls"]
    assert set(reached["files"].values()) | set(reached["calls"].values()) <= {"done", "EACCES", "EPERM", "EXDEV"}
    assert "secret" not in reached["environment"].values()
    assert reached["environment"].keys() <= {*inspector._ENVIRONMENT, *ADDED}
    assert reached["log"] == "/dev/null"
    assert len(reached["descriptors"]) == 4, "nothing, three times, and the pipe that its answer goes through"
    assert sorted(path.name for path in Path(target["outside"]).iterdir()) == ["there"]


def test_seccomp_alone_blocks_network_and_processes(
    tmp_path: Path, files: dict[str, Path], target: dict[str, Any]
) -> None:
    target["data"] = target["outside"]  # whatever can be written to is worthless and grows by at most one byte
    with compromised(tmp_path, "landlock") as inspect:
        reached = attacked(inspect, tmp_path, files, target, landlock=False)
    assert allowed(reached["calls"]) == set(), reached["calls"]
    for name in ("write a huge file", "write outside", "write to own scene"):
        assert reached["files"][name] == "EFBIG", reached["files"]
    assert "secret" not in reached["environment"].values()


def test_landlock_alone_blocks_files_and_signals(
    tmp_path: Path, files: dict[str, Path], target: dict[str, Any]
) -> None:
    with compromised(tmp_path, "seccomp") as inspect:
        reached = attacked(inspect, tmp_path, files, target)
    assert allowed(reached["files"]) == {"read own scene"}, reached["files"]
    refused = {"trace the parent", "trace the API", "memory that is a file"}
    refused |= {"connect"} if sandbox._landlock_version() >= 4 else set()
    refused |= {"signal the parent", "signal the API"} if sandbox._landlock_version() >= 6 else set()
    assert not allowed(reached["calls"]) & refused, reached["calls"]
    assert "secret" not in reached["environment"].values()


def forger(folder: Path, answer: str) -> Path:
    """Write a scene that takes over its reader, sends an answer in the reader's place, and ends it."""
    scene = folder / "attack" / "scene.ply"
    scene.parent.mkdir()
    write = f"os.write(descriptor, {answer.encode()!r} + bytes([10]))"
    code = f"import os\nfor descriptor in range(16):\n    try: {write}\n    except OSError: pass\nos._exit(0)\n"
    scene.write_text(f"# attack\n{code}")
    return scene


@pytest.mark.parametrize(
    "answer",
    [
        "x" * 10_000,
        pytest.param("[" * 100_000, marks=pytest.mark.slow),
        pytest.param("[]", marks=pytest.mark.slow),
        pytest.param("{}", marks=pytest.mark.slow),
        pytest.param('{"error": {}}', marks=pytest.mark.slow),
        pytest.param('{"error": {"code": 1, "message": [], "input": {}}}', marks=pytest.mark.slow),
        '{"findings": 7}',
        '{"planning": {"stage": "planning", "step": "x", "total": [], "fraction": {}, "eta_s": 0}}\n{"findings": {}}',
        '{"findings": {}}\n{"findings": {"gaussians": 7}}',
    ],
)
def test_forged_response_affects_only_its_own_request(
    inspect_shared: Inspect, tmp_path: Path, files: dict[str, Path], answer: str
) -> None:
    scene = forger(tmp_path, answer)
    if answer.startswith('{"findings": {}}'):  # it may falsify the answer about its own files
        assert inspect_shared({**files, "scene": scene}) == {}
    else:
        with pytest.raises(ServiceError, match="crashes their reader"):
            inspect_shared({**files, "scene": scene})
    assert inspect_shared(files)["gaussians"] == 616


def test_flood_of_progress_is_bounded(inspect_shared: Inspect, tmp_path: Path, files: dict[str, Path]) -> None:
    progress = {"stage": "planning", "step": 1, "total": 2, "fraction": 0.5, "eta_s": None}
    flood = (json.dumps({"planning": progress}) + "\n") * (2 * MAX_REPORTS)
    scene = forger(tmp_path, flood + '{"findings": {}}')
    shown: list[dict[str, Any]] = []
    assert inspect_shared({**files, "scene": scene}, shown.append) == {}
    assert shown == [progress] * MAX_REPORTS


def test_modules_with_kernels_are_imported_before_confinement(
    inspect_shared: Inspect, tmp_path: Path, files: dict[str, Path]
) -> None:
    package = Path(sgsst_core.__file__).parent
    with_kernels = {
        ".".join(path.relative_to(package.parent).with_suffix("").parts)
        for path in package.rglob("*.py")
        if "@compiled(" in path.read_text(encoding="utf-8")
    }
    scene = tmp_path / "attack.ply"
    scene.write_text("# attack\nimport sys\nreached = sorted(sys.modules)\n")
    with pytest.raises(ServiceError) as caught:
        inspect_shared({**files, "scene": scene})
    assert with_kernels
    assert with_kernels - set(json.loads(str(caught.value))) == set()


def test_missing_kernel_features_are_logged(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    settings = ServiceSettings(data=tmp_path)
    store = open_store(settings)
    blobs = BlobFolder(settings.folder, store.inputs, 0)
    try:
        Inspector(settings, store, blobs, FileThreads(PATIENCE))
        assert not caplog.records
        monkeypatch.setattr(sandbox, "_landlock_version", lambda: 0)
        monkeypatch.setattr(sandbox, "_has_seccomp", lambda: False)
        Inspector(settings, store, blobs, FileThreads(PATIENCE))
    finally:
        store.close()
    first, second = (record.getMessage() for record in caplog.records)
    assert "missing Landlock (Linux 5.13)" in first
    assert "missing seccomp" in second


def verdict(program: bytes, architecture: int, number: int, argument: int = 0, second: int = 0) -> int:
    """Interpret a classic BPF filter as the kernel does, and return its verdict on a system call."""
    call = {0: number, 4: architecture, 16: argument, 24: second}
    code = list(struct.iter_unpack("=HBBI", program))
    at = value = 0
    while True:
        operation, true, false, operand = code[at]
        match operation:
            case 0x06:
                return operand
            case 0x20:
                value, jump = call[operand], 0
            case 0x15:
                jump = true if value == operand else false
            case 0x25:
                jump = true if value > operand else false
            case 0x45:
                jump = true if value & operand else false
        at += 1 + jump


@pytest.mark.parametrize(
    ("machine", "architecture", "numbers"),
    [
        (
            "x86_64",
            0xC000003E,
            {"read": 0, "socket": 41, "execve": 59, "clone": 56, "kill": 62, "prlimit64": 302, "fcntl": 72},
        ),
        (
            "aarch64",
            0xC00000B7,
            {"read": 63, "socket": 198, "execve": 221, "clone": 220, "kill": 129, "prlimit64": 261, "fcntl": 25},
        ),
    ],
)
def test_filter_of_each_architecture(machine: str, architecture: int, numbers: dict[str, int]) -> None:
    program, own, other = sandbox.seccomp_program(machine, 4711), 4711, 4712
    allow, refuse, absent = 0x7FFF0000, 0x50000 | errno.EPERM, 0x50000 | errno.ENOSYS

    def ask(name: str, argument: int = 0, second: int = 0) -> int:
        return verdict(program, architecture, numbers[name], argument, second)

    assert (
        ask("read") == ask("clone", 0x10F00) == ask("kill", own) == ask("prlimit64", own) == ask("prlimit64") == allow
    )
    assert ask("socket") == ask("execve") == ask("clone", 17) == ask("kill", other) == ask("kill") == refuse
    assert {ask("fcntl", 3, second) for second in range(20) if second not in (8, 15)} == {allow}
    assert ask("fcntl", 3, 8) == ask("fcntl", 3, 15) == refuse
    assert ask("kill", 2**32 - 1) == ask("prlimit64", other) == refuse
    assert verdict(program, architecture, 435) == verdict(program, architecture, 463) == absent
    assert verdict(program, architecture, 0x40000000 + numbers["socket"]) == absent
    assert verdict(program, 0x40000003, numbers["read"]) == refuse


@pytest.mark.slow
def test_compromised_reader_does_not_affect_service(tmp_path: Path, target: dict[str, Any]) -> None:
    paths = input_files(tmp_path)
    service = Service(tmp_path / "data", alone=True, AWS_SECRET_ACCESS_KEY="for nobody")
    service._command = [sys.executable, str(ROOT / "tests/service/inspection/compromised_api.py")]
    with service, service.client() as client:
        assert service._process is not None
        files = {role: (path.name, path.read_bytes()) for role, path in paths.items()}
        assert client.post("/v1/jobs", files=files).status_code == 202
        blob = max((service.data / "blobs").rglob("*"), key=lambda path: path.is_file() and path.stat().st_size)
        before = blob.read_bytes()
        target |= {"data": str(service.data), "blob": str(blob), "api": service._process.pid}
        attacking = f"# attack\n{source.getsource(attack)}\nreached = attack({target!r})\n".encode()
        code = ("scene.ply", files["scene"][1] + attacking)
        answer = client.post("/v1/jobs", files={**files, "scene": code})
        assert (answer.status_code, answer.json()["code"]) == (422, "invalid-scene")
        detail = answer.json()["detail"]
        assert detail.startswith("{"), detail
        content = json.loads(detail)
        outcomes = {**content["files"], **content["calls"]}
        assert {name for name, outcome in outcomes.items() if outcome == "done"} == {"read own scene"}, outcomes
        assert "for nobody" not in str(content["environment"])
        assert client.post("/v1/jobs", files={**files, "style": ("t.png", files["style"][1])}).status_code == 202
        assert service._process.poll() is None
        assert blob.read_bytes() == before
