"""`sgsst serve`: API and dispatcher on one machine, in two processes that are restarted when they die."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

from api.cli.console import leave_terminal
from service.settings import ServiceSettings, keep_private, missing_extras
from service.store import open_store
from sgsst_core.errors import InvalidInputError
from worker.processes import STOP_SIGNALS

#: Seconds of life below which a dead process is restarted only after a wait, and maximum wait in seconds. The wait
#: doubles each time.
_SHORT_LIFE, _LONGEST_WAIT = 5.0, 10.0
_LOOK_SECONDS = 0.2
#: Seconds that processes have to stop, on top of the time that jobs have to save their state.
_LAST_SECONDS = 15.0
_BACKLOG = 1024


class ServeError(InvalidInputError):
    """A configuration with which the service cannot start."""

    code = "cannot-serve"


@dataclass
class _Child:
    """Child process that is restarted for as long as the service runs."""

    name: str
    command: list[str]
    descriptors: tuple[int, ...] = ()
    process: subprocess.Popen[bytes] | None = None
    started: float = 0.0
    wait: float = 0.0
    not_before: float = 0.0

    def start(self) -> None:
        """Start the process. It dies with this process, and does not receive Ctrl-C from the terminal."""
        self.process = subprocess.Popen(
            self.command,
            pass_fds=self.descriptors,
            env={**os.environ, "SGSST_DIE_WITH_PARENT": "1"},
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
        self.started = time.monotonic()

    def restart_if_dead(self, announce: Callable[[str], None]) -> None:
        """Restart the process if it has died, after a wait if it ran only briefly."""
        now = time.monotonic()
        if self.process is not None and self.process.poll() is not None:
            lived = now - self.started
            self.wait = 0.0 if lived > _SHORT_LIFE else min(_LONGEST_WAIT, max(0.5, 2 * self.wait))
            self.not_before = now + self.wait
            announce(f"The {self.name} exited with code {self.process.returncode}. Restarting it.")
            self.process = None
        if self.process is None and now >= self.not_before:
            self.start()


def serve(settings: ServiceSettings, announce: Callable[[str], None]) -> None:
    """Run API and dispatcher until SIGTERM, Ctrl-C or the end of the terminal; running jobs then save their state.

    A second signal ends at once.

    This process owns the listening socket, so that connections wait during a restart of the API instead of being
    refused.

    Raises:
        ServeError: If the address is in use, or if other machines can reach the service and no API key exists.
    """
    keep_private(settings)
    store = open_store(settings)
    if settings.keys_required and not any(key.revoked_at is None for key in store.keys.all()):
        raise ServeError(
            f"{settings.host} can be reached from other machines, but there is no API key. Create one with "
            "`sgsst keys create NAME`, or serve only this machine with --host 127.0.0.1."
        )
    store.close()
    with _listen(settings) as listener:
        api = _Child(
            "API", [sys.executable, "-P", "-m", "api.http.server", "--fd", str(listener.fileno())], (listener.fileno(),)
        )
        dispatcher = _Child("dispatcher", [sys.executable, "-P", "-m", "service.scheduling.dispatcher"])
        if subprocess.run([sys.executable, "-P", "-m", "service.prepare", "weights"], check=False).returncode:
            raise ServeError(
                "No feature network is installed, so no job can run. `sgsst weights list` shows where to get one."
            )
        for line in missing_extras():
            announce(line)
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        _run([api, dispatcher], settings, announce, f"http://{host}:{listener.getsockname()[1]}")


def _listen(settings: ServiceSettings) -> socket.socket:
    family = socket.AF_INET6 if ":" in settings.host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((settings.host, settings.port))
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        raise ServeError(
            f"Cannot listen on {settings.host}:{settings.port}: {error.strerror}. Choose another port with --port."
        ) from error
    return listener


def _run(children: list[_Child], settings: ServiceSettings, announce: Callable[[str], None], address: str) -> None:
    signals: list[int] = []
    for number in STOP_SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:  # as by `nohup`
            signal.signal(number, lambda number, _: signals.append(number))
    for child in children:
        child.start()
    announce(
        f"Serving at {address}/ (API documentation: {address}/docs). Data: {settings.folder}. Press Ctrl-C to stop."
    )
    while not signals:
        for child in children:
            child.restart_if_dead(announce)
        time.sleep(_LOOK_SECONDS)
    leave_terminal(signals[0])
    announce("Stopping; running jobs save their state. Press Ctrl-C again to stop immediately.")
    processes = [child.process for child in children if child.process is not None]
    for process in processes:
        process.send_signal(signal.SIGTERM)
    deadline = time.monotonic() + settings.stop_seconds + _LAST_SECONDS
    while any(process.poll() is None for process in processes) and len(signals) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    for process in processes:
        if process.poll() is None:
            process.kill()
            process.wait()
