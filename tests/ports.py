"""Ports for servers that tests start."""

import contextlib
import secrets
import socket

#: Ports that the system assigns to nobody by itself, so that none is taken between the choice and the server's start.
#: Ray's workers use lower ones.
_FIRST, _LAST = 20_000, 32_000


def free_port() -> int:
    """Return an unused port of this machine."""
    while True:
        port = _FIRST + secrets.randbelow(_LAST - _FIRST)
        with contextlib.suppress(OSError), socket.socket() as listener:
            listener.bind(("127.0.0.1", port))
            return port
