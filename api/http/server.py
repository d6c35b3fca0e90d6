"""Server process of the API: `python -m api.http.server [--fd N]`."""

from __future__ import annotations

import contextlib
import logging
import os
import resource
import socket
import sys

import uvicorn

from api.http.app import create_app
from api.http.connection import Connection, Reader
from service.settings import start

#: Seconds that open requests have to finish at a shutdown.
_GRACE = 10


class _Server(uvicorn.Server):
    """Server that ends event streams before it waits for open requests: their watchers reconnect."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop serving."""
        await self.config.app.state.context.hub.close()  # type: ignore[union-attr]
        await super().shutdown(sockets)


def main() -> None:
    """Serve until SIGTERM, on a socket inherited from the parent process (`--fd`) or on the configured address."""
    if os.environ.get("SGSST_DIE_WITH_PARENT"):
        from worker.processes import die_with_parent

        die_with_parent()
    settings = start()
    # uvicorn gets a socket object rather than a descriptor. It would take a descriptor for a Unix socket and leave
    # Nagle's algorithm on, so that every response waits 40 ms until the client acknowledges its head.
    listeners = [socket.socket(fileno=int(sys.argv[2]))] if sys.argv[1:2] == ["--fd"] else None
    Connection.head_seconds = settings.receive_seconds
    Connection.most = min(settings.max_connections, _affordable_connections())
    config = uvicorn.Config(
        create_app(settings),
        http=Reader,  # type: ignore[arg-type]  # a BufferedProtocol will do, too
        ws="none",
        host=settings.host,
        port=settings.port,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=_GRACE,
        timeout_keep_alive=75,
        server_header=False,
        proxy_headers=False,  # `api.http.middleware` reads them
    )
    server = _Server(config)
    with contextlib.suppress(KeyboardInterrupt):
        server.run(listeners)
    if not server.started:
        sys.exit("The API could not be started.")
    logging.shutdown()
    os._exit(0)  # threads that wait for a hanging file store would be waited for


def _affordable_connections() -> int:
    """Raise the limit of open files as far as the system allows; return the number of connections it suffices for.

    A quarter of the limit is reserved for files, the database, and connections that are being refused.
    """
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    with contextlib.suppress(ValueError, OSError):  # the limit on macOS is not the one that getrlimit reports
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return sys.maxsize if soft == resource.RLIM_INFINITY else max(1, soft - soft // 4)


if __name__ == "__main__":
    main()
