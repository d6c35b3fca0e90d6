"""Commands for this machine: `doctor`, `weights`, and its service: `serve`, `keys` and `fsck`."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.table import Table

from api.cli.console import FAILURE, PlainConsole, counting_bar, error_console, leave_terminal, out_console
from api.cli.options import JsonOption
from sgsst_core.errors import SettingsError
from worker.processes import HANGUP, STOP_SIGNALS

if TYPE_CHECKING:
    from service.settings import ServiceSettings
    from service.store import Store

#: Exit code if jobs run, but slower than they could.
WARNING = 3
_MARKS = {"works": "ok", "warning": "WARNING", "problem": "PROBLEM"}

weights_app = typer.Typer(help="Weights of the feature network.", no_args_is_help=True)


def doctor(as_json: JsonOption = False) -> None:
    """Examine this machine: GPU, precision, memory, weights, caches, and correct results.

    It takes half a minute, and another one the first time, when it compiles the kernels of jobs.

    Exit code: 0 if everything works, 3 if jobs run but slower than they could, 1 if they fail or are wrong.
    """
    from sgsst_core.bench.doctor import examine

    findings = []
    for finding in examine():
        findings.append(finding)
        if not as_json:
            out_console.print(f"{_MARKS[finding.state]:<9}{finding.topic:<12}{finding.text}")
    if as_json:
        out_console.print(json.dumps([asdict(finding) for finding in findings], indent=2))
    states = {finding.state for finding in findings}
    if "problem" in states:
        raise typer.Exit(FAILURE)
    if "warning" in states:
        raise typer.Exit(WARNING)


@weights_app.command("list")
def list_weights() -> None:
    """Show installed weights, and the source of the others; exit with 1 if some are damaged."""
    from sgsst_core.features.network_weights import list_network_weights
    from sgsst_core.features.weight_files import damage_of

    damaged = []
    for entry in list_network_weights():
        if entry.path is not None and (damage := damage_of(entry.path, entry.name)):
            damaged.append(damage)
            state = f"DAMAGED     {entry.path}"
        else:
            state = f"installed   {entry.path}" if entry.path else f"to download from {entry.source}"
        out_console.print(f"{entry.name:<12}{entry.size / 1e6:>6.0f} MB  {state}")
    for damage in damaged:
        error_console.print(f"error: {damage}")
    if damaged:
        raise typer.Exit(FAILURE)


@weights_app.command()
def fetch(
    name: Annotated[Literal["vgg19", "vgg16"], typer.Argument(help="Network to install.")],
    from_: Annotated[
        Path | None,
        typer.Option("--from", help="Convert this file (.pth of torchvision or Gatys et al.) instead of downloading."),
    ] = None,
) -> None:
    """Download and convert weights into the cache folder; do nothing if they are installed."""
    from sgsst_core.features.network_weights import fetch_network_weights

    with counting_bar(name) as progress:
        path = fetch_network_weights(name, source=from_, progress=progress)
    out_console.print(f"{name}: {path}")


@weights_app.command("path")
def print_path() -> None:
    """Print the cache folder for weights; set SGSST_CACHE to change it."""
    from sgsst_core.features.weight_files import cache_folder

    out_console.print(str(cache_folder()))


#: Exit codes of `sgsst fsck` by kind of finding. The exit status is the sum over all kinds that were found.
_FSCK_CODES = {"missing": 4, "damaged": 8, "orphaned": 16}

keys_app = typer.Typer(help="API keys of the service on this machine.", no_args_is_help=True)

DataOption = Annotated[
    Path | None, typer.Option(help="Data folder of the service. [default: SGSST_DATA, else ./sgsst-data]")
]


def serve(
    host: Annotated[
        str | None, typer.Option(help="Address to listen on. [default: 127.0.0.1, this machine only]")
    ] = None,
    port: Annotated[int | None, typer.Option(min=0, max=65535, help="Port to listen on. [default: 8000]")] = None,
    data: DataOption = None,
) -> None:
    """Run the service on this machine: HTTP API and dispatcher. Environment variables SGSST_... configure it."""
    chosen = {"SGSST_HOST": host, "SGSST_PORT": port}
    os.environ.update({name: str(value) for name, value in chosen.items() if value is not None})
    run_service(_service_settings(data), error_console.print)


#: Least seconds between two starts of a process that dies.
_START_SECONDS = 3.0
_LOOK_SECONDS = 0.2
#: Seconds that processes have to stop, on top of the time that jobs have to save their state.
_LAST_SECONDS = 15.0
_BACKLOG = 1024


def run_service(settings: ServiceSettings, announce: Callable[[str], None]) -> None:
    """Run API and dispatcher until SIGTERM, Ctrl-C or the end of the terminal; running jobs then save their state.

    A second Ctrl-C or SIGTERM ends at once. Either process is started again when it dies.

    This process owns the listening socket, so that connections wait during a restart of the API instead of being
    refused.

    Raises:
        SettingsError: If the address is in use, other machines can reach the service and no API key exists, or no
            feature network is installed.
    """
    from service.states import missing_extras

    with _opened(settings) as store:
        if settings.keys_required and not any(key.revoked_at is None for key in store.keys.all()):
            raise SettingsError(
                f"{settings.host} can be reached from other machines, but there is no API key. Create one with "
                "`sgsst keys create NAME`, or serve only this machine with --host 127.0.0.1."
            )
    with _listen(settings) as listener:
        if subprocess.run([sys.executable, "-P", "-m", "service.prepare", "weights"], check=False).returncode:
            raise SettingsError(
                "No feature network is installed, so no job can run. `sgsst weights list` shows where to get one."
            )
        for line in missing_extras():
            announce(line)
        signals: list[int] = []
        for number in STOP_SIGNALS:
            if signal.getsignal(number) != signal.SIG_IGN:  # as by `nohup`
                signal.signal(number, lambda number, _: signals.append(number))
        descriptor = listener.fileno()
        api = [sys.executable, "-P", "-m", "api.http.server", "--fd", str(descriptor)]
        dispatcher = [sys.executable, "-P", "-m", "service.scheduling.dispatcher"]
        children = [_Child("API", api, descriptor), _Child("dispatcher", dispatcher)]
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        address = f"http://{host}:{listener.getsockname()[1]}"
        announce(
            f"Serving at {address}/ (API documentation: {address}/docs). Data: {settings.folder}. Press Ctrl-C to stop."
        )
        _run(children, signals, settings, announce)


def _listen(settings: ServiceSettings) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    address, both = (settings.host, settings.port), family == socket.AF_INET6 and socket.has_dualstack_ipv6()
    try:
        return socket.create_server(address, family=family, backlog=_BACKLOG, dualstack_ipv6=both)
    except OSError as error:
        reason = str(error.strerror).partition(" (")[0]  # Python adds the address
        raise SettingsError(
            f"Cannot listen on {settings.host}:{settings.port}: {reason}. Choose another port with --port."
        ) from error


class _Child:
    """Child process, which dies with this process and does not receive Ctrl-C from the terminal.

    Args:
        descriptors: File descriptors that it inherits.
    """

    def __init__(self, name: str, command: list[str], *descriptors: int) -> None:
        self._name, self._command, self._descriptors = name, command, descriptors
        self._start()

    def _start(self) -> None:
        self.process = subprocess.Popen(
            self._command,
            pass_fds=self._descriptors,
            env={**os.environ, "SGSST_DIE_WITH_PARENT": "1"},
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        self._started = time.monotonic()

    def restart_if_dead(self, announce: Callable[[str], None]) -> None:
        """Start the process again if it has died, unless it was started moments ago."""
        if self.process.poll() is not None and time.monotonic() >= self._started + _START_SECONDS:
            announce(f"The {self._name} exited with code {self.process.returncode}. Restarting it.")
            self._start()


def _run(
    children: list[_Child], signals: list[int], settings: ServiceSettings, announce: Callable[[str], None]
) -> None:
    """Restart children that die until a signal arrives, then end all."""
    while not signals:
        for child in children:
            child.restart_if_dead(announce)
        time.sleep(_LOOK_SECONDS)
    leave_terminal(signals[0])
    announce("Stopping; running jobs save their state. Press Ctrl-C again to stop immediately.")
    processes = [child.process for child in children]
    for process in processes:
        process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + settings.stop_seconds + _LAST_SECONDS
    while (
        any(process.poll() is None for process in processes)
        and set(signals[1:]) <= {HANGUP}
        and time.monotonic() < deadline
    ):
        time.sleep(0.05)
    for process in processes:
        if process.poll() is None:
            process.kill()
            process.wait()


def fsck(
    mend: Annotated[
        bool,
        typer.Option(
            "--mend",
            help="Move damaged files to the folder 'quarantine', delete rows whose files are missing, and delete files "
            "that no row has referred to for an hour (six hours in an object store).",
        ),
    ] = False,
    data: DataOption = None,
    as_json: JsonOption = False,
) -> None:
    """Check all files of the service against its database; the service may be running.

    Exit code: 0 if nothing was found, else the sum of 4 (missing files), 8 (damaged) and 16 (orphaned).
    """
    from service.scheduling.housekeeping import FileCheck

    settings, findings = _service_settings(data), []
    with _opened(settings, existing=True) as store:
        check = FileCheck(settings, store)
        for finding in check.findings(mend=mend):
            findings.append(finding)
            if not as_json:
                needed = f"  needed by {', '.join(finding.holders)}" if finding.holders else ""
                done = f"  {finding.mended}" if finding.mended else ""
                out_console.print(f"{finding.kind:<8}  {finding.what:<10}  {finding.name}{needed}{done}")
    if as_json:
        out_console.print(json.dumps([asdict(finding) for finding in findings]))
    kinds: list[str] = [finding.kind for finding in findings]
    counts = ", ".join(f"{kinds.count(kind)} {kind}" for kind in _FSCK_CODES)
    error_console.print(f"Checked {check.checked} files of the database: {counts}")
    raise typer.Exit(sum(_FSCK_CODES[kind] for kind in set(kinds)))


@keys_app.command("create")
def create_key(
    name: Annotated[str, typer.Argument(help="Name of its owner, for display.", show_default=False)],
    priority: Annotated[int, typer.Option(help="Priority; jobs with higher values run first.")] = 0,
    jobs_a_day: Annotated[
        int | None, typer.Option(min=0, help="Quota of jobs per day. [default: the service's]")
    ] = None,
    gpu_seconds_a_day: Annotated[
        float | None, typer.Option(min=0, help="Quota of GPU seconds per day. [default: the service's]")
    ] = None,
    stored_bytes: Annotated[
        int | None, typer.Option(min=0, help="Quota of stored bytes. [default: the service's]")
    ] = None,
    requests_a_second: Annotated[
        float | None, typer.Option(min=0.001, help="Quota of requests per second. [default: the service's]")
    ] = None,
    operator: Annotated[bool, typer.Option("--operator", help="Let the key see the usage of all keys.")] = False,
    data: DataOption = None,
) -> None:
    """Create an API key and print it. Only a digest is stored, so the key cannot be shown again."""
    from service.store.keys import Quotas

    quotas = Quotas(jobs_a_day, gpu_seconds_a_day, stored_bytes, requests_a_second)
    with _opened(_service_settings(data)) as store:
        row, text = store.keys.create(name, priority, quotas, operator=operator)
    error_console.print(f"Key {row.id} of {row.name!r}. Save it now; it cannot be shown again:")
    out_console.print(text)


@keys_app.command("list")
def list_keys(data: DataOption = None, as_json: JsonOption = False) -> None:
    """List API keys, without the keys themselves."""
    with _opened(_service_settings(data)) as store:
        rows = store.keys.all()
    if as_json:
        shown = [
            {name: getattr(row, name) for name in ("id", "name", "priority", "operator")}
            | {"revoked": bool(row.revoked_at)}
            for row in rows
        ]
        out_console.print(json.dumps(shown))
        return
    table = Table("id", "name", "priority", "state")
    for row in rows:
        state = "revoked" if row.revoked_at else "operator" if row.operator else "valid"
        table.add_row(row.id, row.name, str(row.priority), state)
    PlainConsole().print(table)


@keys_app.command("revoke")
def revoke_key(
    key_id: Annotated[
        str, typer.Argument(metavar="ID", help="ID of the key, as listed by `sgsst keys list`.", show_default=False)
    ],
    data: DataOption = None,
) -> None:
    """Revoke an API key."""
    with _opened(_service_settings(data)) as store:
        row = store.keys.revoke(key_id)
    error_console.print(f"Revoked key {row.id} of {row.name!r}.")


def usage_of_all(data: Path, since: date | None, until: date | None) -> list[dict[str, Any]]:
    """Return the usage of all keys in a service's data folder, as `GET /v1/usage` does.

    Raises:
        SettingsError: If there is no database.
    """
    with _opened(_service_settings(data), existing=True) as store:
        rows = store.keys.usage(since, until, None)
    return [row | {"day": row["day"].isoformat()} for row in rows]


def _service_settings(data: Path | None) -> ServiceSettings:
    """Return the settings from the environment, to which a data folder is added for other processes."""
    if os.name != "posix":
        raise SettingsError(
            "The service does not run on Windows itself. Run this command in WSL2 (`wsl --install`), or run the "
            "container image; `sgsst submit` and the page reach both from here."
        )
    from service.settings import read_settings

    if data is not None:
        os.environ["SGSST_DATA"] = str(data.absolute())
    return read_settings()


@contextmanager
def _opened(settings: ServiceSettings, *, existing: bool = False) -> Iterator[Store]:
    """Open the store of the service, and close it at the end of the block.

    Args:
        existing: Whether the service must have run before; otherwise, a missing database is created.

    Raises:
        SettingsError: If there is no database.
    """
    from sqlalchemy.engine import make_url

    from service.settings import keep_private
    from service.store import open_store

    url = make_url(settings.database_url)
    if existing and url.get_backend_name() == "sqlite" and not Path(url.database or "").is_file():
        raise SettingsError(f"{url.database}: no database of the service. Give its folder by --data or SGSST_DATA.")
    keep_private(settings)
    with closing(open_store(settings)) as store:
        yield store
