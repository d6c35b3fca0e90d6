"""The API's process: `python -m api.http.server [--fd N]`."""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import sys

import uvicorn

from api.http.app import create_app
from api.http.connection import Connection
from service.logs import set_up
from service.private import keep_private
from service.settings import ServiceSettings

#: Seconds that open requests have to end at a shutdown.
_GRACE = 10


def main() -> None:
    """Serve until SIGTERM, on a socket that the parent process holds open, or on the settings' address."""
    if os.environ.get("SGSST_DIE_WITH_PARENT"):
        from worker.processes import die_with_parent

        die_with_parent()
    _allow_many_connections()
    settings = ServiceSettings()
    set_up(settings.log_format)
    keep_private(settings)
    # as a socket, of which the family is known: uvicorn takes a bare descriptor for a Unix socket's and leaves Nagle's
    # algorithm on, by which every answer waits 40 ms for the client's acknowledgment of its head
    listeners = [socket.socket(fileno=int(sys.argv[2]))] if sys.argv[1:2] == ["--fd"] else None
    Connection.head_seconds = settings.receive_seconds
    Connection.most = settings.max_connections
    config = uvicorn.Config(
        create_app(settings),
        http=Connection,
        ws="none",
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=_GRACE,
        timeout_keep_alive=75,
        server_header=False,
    )
    server = uvicorn.Server(config)
    with contextlib.suppress(KeyboardInterrupt):
        server.run(listeners)
    if not server.started:
        sys.exit("The API could not be started.")


def _allow_many_connections() -> None:
    """Take all open files that the system grants: each watcher is one, and without asking there are often 1024."""
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # macOS has a limit that it does not tell
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))


if __name__ == "__main__":
    main()
