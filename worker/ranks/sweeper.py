"""Watchdog process that deletes the folder of a local Ray instance if its owner is killed.

The owner is the process that starts the watchdog. The watchdog reads from a pipe: if the pipe closes without a message,
the owner was killed. It imports the standard library only, so that it starts quickly and needs little memory.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

#: Message of an owner that has deleted the folder itself.
DONE = b"done"
#: Seconds until remaining processes are killed, and until the sweeper stops waiting for them.
_PATIENCE, _LIMIT = 1.0, 20.0


def beside(folder: Path) -> subprocess.Popen[bytes]:
    """Start a sweeper that sweeps a folder if this process is killed; `dismiss` ends it."""
    return subprocess.Popen(
        [sys.executable, "-I", "-S", __file__, str(folder)],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # only the owner handles Ctrl-C
    )


def dismiss(process: subprocess.Popen[bytes]) -> None:
    """End a sweeper after the owner has deleted the folder itself. Further calls have no effect."""
    if process.stdin and not process.stdin.closed:
        process.communicate(DONE)


def sweep(folder: Path) -> None:
    """Delete a folder once no other process uses it. Processes that use it for too long are killed.

    A process uses the folder if it has a file of the folder open, or if its command line contains the folder's path.
    """
    started = time.monotonic()
    while users := _users(folder):
        if time.monotonic() - started > _LIMIT:
            break
        if time.monotonic() - started > _PATIENCE:
            for process in users:
                try:
                    os.kill(process, signal.SIGKILL)
                except OSError:  # the process has ended meanwhile
                    continue
        time.sleep(0.1)
    shutil.rmtree(folder, ignore_errors=True)


def _users(folder: Path) -> list[int]:
    """Return the other processes of this user that use a folder."""
    processes = Path("/proc")
    if not processes.is_dir():  # not Linux
        return []
    return [
        int(entry.name)
        for entry in processes.iterdir()
        if entry.name.isdigit() and int(entry.name) != os.getpid() and _uses(entry, str(folder))
    ]


def _uses(process: Path, folder: str) -> bool:
    try:
        if process.joinpath("stat").read_text().rpartition(")")[2].split()[0] == "Z":
            return False
        if folder.encode() in process.joinpath("cmdline").read_bytes():
            return "sweeper.py" not in process.joinpath("cmdline").read_text(errors="replace")
        return any(str(link.readlink()).startswith(folder + "/") for link in process.joinpath("fd").iterdir())
    except OSError:  # the process has ended meanwhile, or belongs to another user
        return False


if __name__ == "__main__":
    if sys.stdin.buffer.read() != DONE:
        sweep(Path(sys.argv[1]))
