"""Identification and reliable termination of processes, and sockets bound to one address."""

from __future__ import annotations

import ctypes
import os
import signal
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

_PR_SET_PDEATHSIG = 1
#: Signals that ask a program to stop: Ctrl-C, the usual one, and that of a closed terminal, which Windows lacks.
STOP_SIGNALS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]


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
    def of_this() -> ProcessId:
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
        try:
            process.kill()
        except psutil.Error:
            continue
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
