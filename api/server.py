"""The API's process: `python -m api.server [--fd N]`."""

from __future__ import annotations

import os
import sys

import uvicorn

from api.app import create_app
from api.connection import Connection
from service.logs import set_up
from service.settings import ServiceSettings

#: Seconds that open requests have to end at a shutdown.
_GRACE = 10


def main() -> None:
    """Serve until SIGTERM, on a socket that the parent process holds open, or on the settings' address."""
    if os.environ.get("SGSST_DIE_WITH_PARENT"):
        from worker.processes import die_with_parent

        die_with_parent()
    settings = ServiceSettings()
    set_up(settings.log_format)
    descriptor = int(sys.argv[2]) if sys.argv[1:2] == ["--fd"] else None
    Connection.head_seconds = settings.receive_seconds
    uvicorn.run(
        create_app(settings),
        http=Connection,
        ws="none",
        host=settings.host,
        port=settings.port,
        fd=descriptor,
        log_config=None,
        access_log=False,
        timeout_graceful_shutdown=_GRACE,
        timeout_keep_alive=75,
        server_header=False,
    )


if __name__ == "__main__":
    main()
