"""Leaves nothing of a local Ray behind: ends what still uses its folder, then removes the folder.

Runs as a process of its own beside the one that owns Ray (`python sweeper.py FOLDER`, with a pipe as standard input),
so that it outlives it: when the pipe closes without a word, the owner was killed. Uses the standard library alone, so
that it starts in no time and takes next to no memory.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import time
from pathlib import Path

#: What the owner says when it has cleaned up itself.
DONE = b"done"
#: Seconds for processes to go by themselves, and in all.
_PATIENCE, _LIMIT = 1.0, 20.0


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
        sweep(Path(sys.argv[1]))
