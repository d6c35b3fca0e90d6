"""Code of an attacker who controls a reader process. Tests send it as the content of a scene; it does no real harm."""

import ctypes
import errno
import fcntl
import os
import resource
import signal
import socket
import subprocess
from collections.abc import Callable
from typing import Any

ATTACH, IO_URING_SETUP, SET_SIGNAL = 16, 425, 10


def outcome(attempt: Callable[[], Any]) -> str:
    """Return "done" if the attempt succeeds, otherwise the name of the error that the kernel returned."""
    try:
        attempt()
        return "done"
    except OSError as error:
        return errno.errorcode.get(error.errno or 0, "unknown")


def read(path: str) -> bytes:
    with open(path, "rb") as file:
        return file.read(64)


def write(path: str, size: int = 1, mode: str = "wb") -> None:
    with open(path, mode) as file:
        file.write(bytes(size))


def library(name: str, *arguments: Any) -> None:
    libc = ctypes.CDLL(None, use_errno=True)
    if getattr(libc, name)(*arguments) < 0:
        raise OSError(ctypes.get_errno(), name)


def fork() -> None:
    for _ in range(3):
        child = os.fork()
        if child == 0:
            os._exit(0)
        os.waitpid(child, 0)


def connect(port: int) -> None:
    with socket.socket() as client:
        client.connect(("127.0.0.1", port))


def signal_by_pipe(process: int) -> None:
    """Make a process the owner of a pipe, whose input the kernel then reports by a signal of choice."""
    reading, writing = os.pipe()
    fcntl.fcntl(reading, fcntl.F_SETOWN, process)
    fcntl.fcntl(reading, SET_SIGNAL, signal.SIGCONT)
    fcntl.fcntl(reading, fcntl.F_SETFL, os.O_ASYNC)
    os.write(writing, b"x")


def fill(descriptor: int) -> None:
    os.write(descriptor, bytes(1 << 20))


def attack(target: dict[str, Any]) -> dict[str, Any]:
    """Try all attacks and return their outcomes.

    Args:
        target: Paths `data`, `blob`, `outside` (a folder) and `own` (this scene), a `port`, and the process id `api`.
    """
    data, outside, own, api, parent = target["data"], target["outside"], target["own"], target["api"], os.getppid()
    files = {
        "read own scene": lambda: read(own),
        "read database": lambda: read(f"{data}/sgsst.db"),
        "read another job's file": lambda: read(target["blob"]),
        "list data": lambda: os.listdir(data),
        "list jobs": lambda: os.listdir(f"{data}/inspections"),
        "read passwords": lambda: read("/etc/passwd"),
        "read environment of the API": lambda: read(f"/proc/{api}/environ"),
        "read environment of the parent": lambda: read(f"/proc/{parent}/environ"),
        "read memory of the API": lambda: read(f"/proc/{api}/mem"),
        "read through a link": lambda: read(f"/proc/self/root{data}/sgsst.db"),
        "write to database": lambda: write(f"{data}/sgsst.db", mode="ab"),
        "write to own scene": lambda: write(own, mode="ab"),
        "write beside own scene": lambda: write("new"),
        "write outside": lambda: write(f"{outside}/new"),
        "write a huge file": lambda: write(f"{outside}/huge", 1 << 30),
        "write to shared memory": lambda: write("/dev/shm/sgsst-attack"),
        "remove database": lambda: os.unlink(f"{outside}/there"),
        "make a link": lambda: os.symlink("/etc/passwd", "link"),
        "make a folder": lambda: os.mkdir(f"{outside}/folder"),
        "truncate": lambda: os.truncate(f"{outside}/there", 0),
    }
    calls = {
        "change permissions": lambda: os.chmod(f"{outside}/there", 0o777),
        "change times": lambda: os.utime(f"{outside}/there"),
        "connect": lambda: connect(target["port"]),
        "open a TCP socket": lambda: socket.socket().close(),
        "open a UDP socket": lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM).close(),
        "open a local socket": lambda: socket.socket(socket.AF_UNIX).close(),
        "use io_uring": lambda: library("syscall", IO_URING_SETUP, 4, None),
        "fork": fork,
        "run a program": lambda: subprocess.run(["/bin/true"], check=True),
        "trace the parent": lambda: library("ptrace", ATTACH, parent, None, None),
        "trace the API": lambda: library("ptrace", ATTACH, api, None, None),
        "signal the parent": lambda: os.kill(parent, signal.SIGCONT),
        "signal the API": lambda: os.kill(api, signal.SIGCONT),
        "signal the API by a pipe": lambda: signal_by_pipe(api),
        "signal the group": lambda: os.kill(0, signal.SIGCONT),
        "limit the API": lambda: resource.prlimit(api, resource.RLIMIT_CORE, (0, 0)),
        "memory that is a file": lambda: fill(os.memfd_create("x")),
        "new namespaces": lambda: library("unshare", 0x40000000),
    }
    return {
        "environment": dict(os.environ),
        "descriptors": sorted(name for name in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{name}")),
        "log": os.readlink("/proc/self/fd/2"),
        "files": {name: outcome(attempt) for name, attempt in files.items()},
        "calls": {name: outcome(attempt) for name, attempt in calls.items()},
    }
