"""Memory for requests: what all connections of a process may hold together of what has come and is not used yet."""

from __future__ import annotations

from service.errors import BusyError

#: Bytes for all connections together, and bytes that each may hold at most and at least.
_TOTAL, _MOST, _LEAST = 8 << 20, 1 << 17, 1 << 13


class RequestMemory:
    """The memory of one process for heads and bodies of requests.

    Each connection may hold an equal share: of a head, of a body that nobody has read yet, and of a block that is about
    to be written. JSON bodies, which have to be whole before they can be read, may have more than that as long as all
    of them together do not.

    Attributes:
        connections: Number of open connections.
    """

    def __init__(self) -> None:
        self.connections = 0
        self._json_bytes = 0

    def share(self) -> int:
        """Return the bytes that one connection may hold: 128 kB, or less among many connections, but at least 8 kB."""
        return max(_LEAST, min(_MOST, _TOTAL // max(1, self.connections)))

    def take(self, size: int, held: int) -> None:
        """Count bytes of a JSON body.

        Args:
            size: Number of bytes that are added.
            held: Number of bytes that this body has already.

        Raises:
            BusyError: All JSON bodies together have too much, and this one more than its share.
        """
        if self._json_bytes + size > _TOTAL and held + size > self.share():
            raise BusyError("Too many large requests are arriving. Try again later.", retry_after=5)
        self._json_bytes += size

    def give_back(self, size: int) -> None:
        """Stop counting bytes of a JSON body."""
        self._json_bytes -= size


#: The memory of this process.
memory = RequestMemory()
