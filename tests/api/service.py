"""Service for tests, started as a user starts it: real processes, a separate data folder, and a free port."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import httpx2
import psutil

from api.http.app import create_app
from service.files.objects import Artifacts
from service.settings import ServiceSettings
from service.store import Store, open_store
from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[2]
#: Seconds that a test waits for anything before it fails. No test measures time.
PATIENCE = 600.0
#: Command that runs another one, and stops it if this process is killed.
_WITH_PARENT = ["setpriv", "--pdeathsig", "TERM"] if shutil.which("setpriv") else []
#: Short intervals, so that tests see within seconds what otherwise takes minutes.
SETTINGS = {
    "SGSST_MIN_FREE_BYTES": "0",
    "SGSST_LEASE_SECONDS": "20",
    "SGSST_RETRY_SECONDS": "0.2",
    "SGSST_POLL_SECONDS": "0.1",
    "SGSST_CHECKPOINT_SECONDS": "1",
    "SGSST_PREVIEW_SECONDS": "0.5",
    "OMP_NUM_THREADS": "1",
    "NUMBA_NUM_THREADS": "1",
    "GOMP_SPINCOUNT": "0",
}


class Service:
    """Service started by `sgsst serve`, or the API process alone."""

    def __init__(self, data: Path, *, alone: bool = False, **settings: str) -> None:
        self.data = data
        self.environment = {**os.environ, **SETTINGS, "PYTHONPATH": str(ROOT), "SGSST_DATA": str(data), **settings}
        self._command = (
            [sys.executable, "-m", "api.http.server"] if alone else [sys.executable, "-m", "api.cli", "serve"]
        )
        self._alone = alone
        self.log = data.with_name(data.name + ".log")
        self.url = ""
        self._process: subprocess.Popen[bytes] | None = None

    def start(self) -> Service:
        """Start the service, and wait until it is ready."""
        self.environment["SGSST_PORT"] = self.environment.get("SGSST_PORT") or str(free_port())
        self.url = f"http://127.0.0.1:{self.environment['SGSST_PORT']}"
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [*_WITH_PARENT, *self._command],
                env=self.environment,
                stdout=log,
                stderr=log,
                cwd=ROOT,
                start_new_session=True,
            )
        wait_for(self.ready, "the service to be ready", self.said)
        return self

    def said(self) -> str:
        """Return the end of the service's log."""
        return self.log.read_text(errors="replace")[-3000:]

    def ready(self) -> bool:
        """Return whether the service is ready."""
        assert self._process is not None
        assert self._process.poll() is None, f"the service has ended:\n{self.said()}"
        try:
            return httpx2.get(f"{self.url}/readyz", timeout=5, verify=False).status_code == 200
        except httpx2.TransportError:
            return False

    def client(self, key: str | None = None) -> httpx2.Client:
        """Return an HTTP client of the service, without certificates: there is no TLS, and they take time to load."""
        headers = {"Authorization": f"Bearer {key}"} if key else {}
        return httpx2.Client(base_url=self.url, headers=headers, timeout=60, verify=False)

    def processes(self, module: str) -> list[psutil.Process]:
        """Return the service's processes that run `module` or have it as their title."""
        assert self._process is not None
        try:
            family = [psutil.Process(self._process.pid), *psutil.Process(self._process.pid).children(recursive=True)]
        except psutil.Error:
            return []
        matching = []
        for process in family:
            try:
                named = any(part.startswith(module) for part in process.cmdline())
                if named and process.status() != psutil.STATUS_ZOMBIE:
                    matching.append(process)
            except psutil.Error:
                continue
        return matching

    def process(self, module: str) -> psutil.Process | None:
        """Return the first of `processes(module)`, or None if there is none."""
        return next(iter(self.processes(module)), None)

    def kill(self, module: str) -> None:
        """Send SIGKILL to the process that runs `module`."""
        process = wait_for(lambda: self.process(module), f"a process {module}", self.said)
        process.send_signal(signal.SIGKILL)

    @contextlib.contextmanager
    def killed(self, module: str) -> Iterator[None]:
        """Kill the process that runs `module`, and have it restarted only after the `with` block."""
        assert self._process is not None
        supervisor = psutil.Process(self._process.pid)
        supervisor.suspend()
        try:
            self.kill(module)
            yield
        finally:
            supervisor.resume()

    @contextlib.contextmanager
    def store(self) -> Iterator[Store]:
        """Yield the service's database."""
        settings = ServiceSettings(data=self.data, database=self.environment.get("SGSST_DATABASE"))
        with contextlib.closing(open_store(settings)) as opened:
            yield opened

    def key(self, name: str = "me") -> str:
        """Create an API key."""
        with self.store() as store:
            return store.keys.create(name)[1]

    def finish(self, job_id: str, contents: Mapping[str, bytes], **result: Any) -> None:
        """Finish a queued job, and those before it, with these artifacts by name, in place of a dispatcher."""
        artifacts, source = Artifacts(ServiceSettings(data=self.data).artifacts_url), self.data.with_name("artifact")
        with self.store() as store:
            finished = ""
            while finished != job_id:
                lease = store.leases.take("test")
                assert lease is not None, f"{job_id} is not in the queue"
                put = []
                for name, content in contents.items():
                    source.write_bytes(content)
                    put.append(artifacts.put(lease.job_id, lease.epoch, name, source))
                store.leases.start(lease)
                store.leases.succeed(lease, put, {"steps": 1, "loss_before": 2.0, "loss_after": 1.0, **result})
                finished = lease.job_id

    def succeeded(self, job_id: str) -> dict[str, Any]:
        """Wait until a job has ended, and return it; fail if it has not succeeded."""

        def ended() -> dict[str, Any] | None:
            try:
                job: dict[str, Any] = httpx2.get(f"{self.url}/v1/jobs/{job_id}", timeout=60, verify=False).json()
            except httpx2.TransportError:  # a test has killed the API, which is started again
                return None
            return job if job["status"] in ("succeeded", "failed", "canceled") else None

        job: dict[str, Any] = wait_for(ended, f"the end of {job_id}", self.said)
        assert job["status"] == "succeeded", f"{job['error']}\n{self.said()}"
        return job

    def survivors(self) -> list[psutil.Process]:
        """Return all running processes that the service has started, including those in other sessions."""
        alive = []
        for process in psutil.process_iter():
            try:
                mine = process.environ().get("SGSST_DATA") == str(self.data)
                if mine and process.status() != psutil.STATUS_ZOMBIE:
                    alive.append(process)
            except psutil.Error:
                continue
        return alive

    def stored(self) -> dict[Path, os.stat_result]:
        """Return the status of every file and folder in the data folder; entries that vanish meanwhile are left out."""
        entries = {}
        for folder, folders, files in os.walk(self.data):
            for path in (Path(folder, name) for name in folders + files):
                with contextlib.suppress(FileNotFoundError):
                    entries[path] = path.lstat()
        return entries

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Stop the service with a signal, as a user or the system would."""
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(number)
            self._process.wait(PATIENCE)

    def __enter__(self) -> Service:
        return self.start()

    def __exit__(self, *ignored: object) -> None:
        self.stop()


class Unready(Service):
    """Service whose `start` waits until it responds, even if it is not ready."""

    def ready(self) -> bool:
        """Return whether the service responds."""
        try:
            return httpx2.get(f"{self.url}/livez", timeout=5).status_code == 200
        except httpx2.TransportError:
            return False


def undisturbed(files: Mapping[str, Path], parameters: Mapping[str, Any], folder: Path) -> Path:
    """Stylize the files with `sgsst stylize` on one rank, and return the path of the resulting PLY."""
    out = folder / "stylized.ply"
    command = [sys.executable, "-m", "api.cli", "stylize", str(files["scene"]), "--style", str(files["style"])]
    command += ["--cameras", str(files["cameras"]), "--out", str(out)]
    for name, value in parameters.items():
        option = name.replace("_", "-")
        command += (
            [f"--{option}" if value else f"--no-{option}"] if isinstance(value, bool) else [f"--{option}", str(value)]
        )
    environment = {**os.environ, **SETTINGS, "PYTHONPATH": str(ROOT)}
    subprocess.run(command, check=True, env=environment, cwd=ROOT, stdout=subprocess.DEVNULL)
    return out


def submit(client: httpx2.Client, files: Mapping[str, Path], **parameters: Any) -> str:
    """Submit a job with files by their role, and return its id."""
    body = {role: (path.name, path.read_bytes()) for role, path in files.items()}
    answer = client.post("/v1/jobs", files=body, data={"parameters": json.dumps(parameters)})
    assert answer.status_code == 202, answer.text
    assert answer.headers["location"] == f"/v1/jobs/{answer.json()['id']}"
    return str(answer.json()["id"])


@cache
def _document() -> dict[str, Any]:
    return create_app(ServiceSettings()).openapi()


def check_documented(answer: httpx2.Response) -> None:
    """Fail unless the OpenAPI document lists the problem's status and code for the operation that returned it."""
    path, method = answer.request.url.path, answer.request.method.lower()
    for template, operations in _document()["paths"].items():
        pattern = re.sub(r"\{[a-z_]+\}", "[^/]+", template.replace("{name}", "(?s:.+)"))
        if not re.fullmatch(pattern, path) or method not in operations:
            continue
        documented = operations[method]["responses"].get(str(answer.status_code))
        assert documented, f"{method} {template}: {answer.status_code} is not documented"
        examples = documented["content"][answer.headers["content-type"]]["examples"]
        code = answer.json()["code"]
        assert code in examples, f"{method} {template}: {answer.status_code} {code} is not documented"


def wait_for(
    condition: Callable[[], Any], what: str, said: Callable[[], str] = lambda: "", *, every: float = 0.1
) -> Any:
    """Return the first true value of a condition; fail after `PATIENCE` seconds."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        value = condition()
        if value:
            return value
        time.sleep(every)
    raise AssertionError(f"waited in vain for {what}\n{said()}")
