"""Leaves nothing of a killed process behind: of a local Ray, or of a rank.

Runs as a process of its own beside the owner of a folder, with a pipe as standard input, so that it outlives it: when
the pipe closes without a word, the owner was killed. Uses the standard library alone, so that it starts in no time and
takes next to no memory.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

#: What the owner says when it has cleaned up itself.
DONE = b"done"
#: Seconds for processes to go by themselves, and in all.
_PATIENCE, _LIMIT = 1.0, 20.0


def beside(folder: Path, *, users: bool = False) -> subprocess.Popen[bytes]:
    """Start one that removes a folder when this process is killed; `dismiss` ends it.

    Args:
        users: processes that still use the folder are ended first.
    """
    return subprocess.Popen(
        [sys.executable, "-I", "-S", __file__, str(folder), *(["users"] if users else [])],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,  # Ctrl-C is for the owner
    )


def dismiss(process: subprocess.Popen[bytes]) -> None:
    """The owner has removed the folder itself; once is enough."""
    if process.stdin and not process.stdin.closed:
        process.communicate(DONE)


def sweep(folder: Path) -> None:
    """Kill every other process that has a file of the folder open, or names it in its command; remove the folder."""
    started = time.monotonic()
    while users := _users(folder):
        if time.monotonic() - started > _LIMIT:
            break
        if time.monotonic() - started > _PATIENCE:
            for process in users:
                try:
                    os.kill(process, signal.SIGKILL)
                except OSError:  # gone meanwhile
                    continue
        time.sleep(0.1)
    shutil.rmtree(folder, ignore_errors=True)


def _users(folder: Path) -> list[int]:
    """Processes of this user, apart from this one, that use a folder."""
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
    except OSError:  # gone meanwhile, or another user's
        return False


if __name__ == "__main__":
    if sys.stdin.buffer.read() != DONE:
        if sys.argv[2:] == ["users"]:
            sweep(Path(sys.argv[1]))
        shutil.rmtree(sys.argv[1], ignore_errors=True)
