"""Watchdog process that deletes the folder of a local Ray instance if its owner is killed.

The owner is the process that starts the watchdog. The watchdog reads from a pipe: if the pipe closes without a message,
the owner was killed. It imports little, so that it starts quickly and needs little memory.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import psutil

#: Message of an owner that has deleted the folder itself.
DONE = b"done"
#: Seconds until remaining processes are killed, and until the sweeper stops waiting for them.
_PATIENCE, _LIMIT = 1.0, 20.0


def beside(folder: Path) -> subprocess.Popen[bytes]:
    """Start a sweeper that sweeps a folder if this process is killed; `dismiss` ends it."""
    return subprocess.Popen(
        [sys.executable, "-I", __file__, str(folder)],
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
                with contextlib.suppress(psutil.Error):  # the process has ended meanwhile
                    process.kill()
        time.sleep(0.1)
    shutil.rmtree(folder, ignore_errors=True)


def _users(folder: Path) -> list[psutil.Process]:
    """Return the other processes of this user that use a folder."""
    return [process for process in psutil.process_iter() if process.pid != os.getpid() and _uses(process, str(folder))]


def _uses(process: psutil.Process, folder: str) -> bool:
    try:
        command = " ".join(process.cmdline())
        if folder in command:
            return "sweeper.py" not in command
        return any(file.path.startswith(folder + os.sep) for file in process.open_files())
    except (psutil.Error, OSError):  # the process has ended meanwhile, or belongs to another user
        return False


if __name__ == "__main__":
    if sys.stdin.buffer.read() != DONE:
        sweep(Path(sys.argv[1]))
