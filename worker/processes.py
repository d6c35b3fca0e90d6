"""Identification and reliable termination of processes, and sockets bound to one address.

Run as a script with a folder, this module is the sweeper of that folder (`start_sweeper`); it therefore imports little.
"""

import contextlib
import ctypes
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

_PR_SET_PDEATHSIG = 1
#: Signal of a closed terminal; None on Windows, which lacks it.
HANGUP = getattr(signal, "SIGHUP", None)
#: Signals that ask a program to stop: Ctrl-C, the usual one, and that of a closed terminal.
STOP_SIGNALS = [number for number in (signal.SIGINT, signal.SIGTERM, HANGUP) if number is not None]

#: Message to a sweeper whose owner has deleted the folder itself.
_DONE = b"done"
#: Seconds until remaining processes are killed, and until the sweeper stops waiting for them.
_PATIENCE, _LIMIT = 1.0, 20.0


@dataclass(frozen=True)
class ProcessId:
    """Unique identifier of a process. A process ID alone is not unique, because the system reuses it.

    Attributes:
        home: Machine, process namespace and user; see the function `home`.
        number: Process ID (PID).
        started: Start time in seconds since the epoch, as psutil returns it.
    """

    home: tuple[str, ...]
    number: int
    started: float

    @staticmethod
    def of_this() -> "ProcessId":
        """Return the identifier of the current process."""
        return ProcessId(home(), os.getpid(), psutil.Process().create_time())

    def find(self) -> psutil.Process | None:
        """Return the process, or None if it has ended. Must be called on the machine that the process runs on."""
        try:
            process = psutil.Process(self.number)
            return process if abs(process.create_time() - self.started) < 1 else None
        except psutil.Error:
            return None


def process_start() -> float:
    """Return when this process was started, in seconds since the epoch."""
    if sys.platform != "linux":
        return float(psutil.Process().create_time())
    # psutil knows the time of the machine's start to a second
    ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
    return time.time() - time.clock_gettime(time.CLOCK_BOOTTIME) + ticks / os.sysconf("SC_CLK_TCK")


def home() -> tuple[str, ...]:
    """Return an identifier of the running kernel, process namespace and user.

    Processes that can see each other have the same one.
    """
    if not sys.platform.startswith("linux"):
        return socket.gethostname(), psutil.Process().username()
    boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return boot, str(Path("/proc/self/ns/pid").readlink()), str(os.geteuid())


def kill(processes: Sequence[ProcessId], timeout: float = 10.0) -> None:
    """Kill processes of this machine, including suspended ones, and wait until they have ended."""
    alive = [process for identity in processes if (process := identity.find()) is not None]
    for process in alive:
        with contextlib.suppress(psutil.Error):
            process.kill()
    psutil.wait_procs(alive, timeout)


def die_with_parent() -> None:
    """Make the system kill this process when its parent ends, even while it is suspended. Linux only."""
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def interface_towards(address: str) -> str | None:
    """Return the network interface through which this machine reaches an address; None if it is unknown."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    with socket.socket(family, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((address, 9))  # a UDP socket sends nothing here; it only looks up the route
        except OSError:
            return None
        own = probe.getsockname()[0]
    for name, addresses in psutil.net_if_addrs().items():
        if any(entry.address.partition("%")[0] == own for entry in addresses):
            return str(name)
    return None


def split_address(address: str) -> tuple[str, int]:
    """Return host and port of a "host:port"."""
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def listen(host: str, port: int = 0) -> socket.socket:
    """Return a socket that listens on one address of this machine only; port 0 chooses a free port."""
    return socket.create_server((host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET)


def start_sweeper(folder: Path) -> subprocess.Popen[bytes]:
    """Start a process that sweeps a folder if this process is killed; `dismiss_sweeper` ends it.

    It reads from a pipe: if the pipe closes without a message, this process was killed.
    """
    return subprocess.Popen(
        [sys.executable, "-I", __file__, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # only the owner handles Ctrl-C
    )


def dismiss_sweeper(process: subprocess.Popen[bytes]) -> None:
    """End a sweeper after the owner has deleted the folder itself. Further calls have no effect."""
    if process.stdin and not process.stdin.closed:
        process.communicate(_DONE)


def sweep(folder: Path) -> None:
    """Delete a folder once no other process uses it. Processes that use it for too long are killed.

    A process uses the folder if it has a file of the folder open, or if its command line contains the folder's path.
    """
    started = time.monotonic()
    while users := [each for each in psutil.process_iter() if each.pid != os.getpid() and _uses(each, str(folder))]:
        if time.monotonic() - started > _LIMIT:
            break
        if time.monotonic() - started > _PATIENCE:
            for process in users:
                with contextlib.suppress(psutil.Error):  # the process has ended meanwhile
                    process.kill()
        time.sleep(0.1)
    shutil.rmtree(folder, ignore_errors=True)


def _uses(process: psutil.Process, folder: str) -> bool:
    """Return whether a process of this user uses a folder."""
    try:
        command = " ".join(process.cmdline())
        if folder in command:
            return __file__ not in command
        return any(file.path.startswith(folder + os.sep) for file in process.open_files())
    except (psutil.Error, OSError):  # the process has ended meanwhile, or belongs to another user
        return False


if __name__ == "__main__":
    if sys.stdin.buffer.read() != _DONE:
        sweep(Path(sys.argv[1]))
