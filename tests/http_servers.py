"""HTTP servers that tests run in a thread."""

from __future__ import annotations

import threading
from socketserver import BaseServer

#: Interval at which a server looks whether it should stop; with the default, every `shutdown` takes half a second.
_POLL_SECONDS = 0.02


def serve(server: BaseServer) -> None:
    """Answer requests in a separate thread until the server is shut down."""
    threading.Thread(target=server.serve_forever, args=(_POLL_SECONDS,), daemon=True).start()
