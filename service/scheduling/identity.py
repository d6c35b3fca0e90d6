"""Names of dispatchers, which reveal to other processes whether a dispatcher still runs."""

from __future__ import annotations

import hashlib
import socket

from worker.processes import ProcessId, home


def own_name() -> str:
    """Return the unique name of this process: its host, its process id, and its start time."""
    own = ProcessId.of_this()
    return f"{socket.gethostname()[:40]}-{_home_digest()}-{own.number}-{int(own.started)}"


def is_dead(name: str) -> bool:
    """Return whether the dispatcher ran in this process' process namespace and has exited."""
    parts = name.rsplit("-", 3)
    if not is_of_this_machine(name) or not (parts[2] + parts[3]).isdigit():
        return False
    return ProcessId(home(), int(parts[2]), float(parts[3]) + 0.5).find() is None


def is_of_this_machine(name: str) -> bool:
    """Return whether the dispatcher runs or ran in this process' process namespace."""
    parts = name.rsplit("-", 3)
    return len(parts) == 4 and parts[1] == _home_digest()


def _home_digest() -> str:
    return hashlib.sha256(repr(home()).encode()).hexdigest()[:8]
