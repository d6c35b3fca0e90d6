"""Memory budget of all connections of a process: for bytes that are received but not processed, or read to be sent."""

from __future__ import annotations

from service import problems

#: Bytes of all connections together, and maximum and minimum bytes of each.
_TOTAL, _MOST, _LEAST = 8 << 20, 1 << 17, 1 << 13


class RequestMemory:
    """Memory of one process for the heads and bodies of requests.

    Each connection may hold an equal fraction of the total. It covers the head, the part of the body that the app has
    not read yet, and the block that is written to disk next. A JSON body must be complete before it can be parsed. It
    may exceed this fraction as long as all JSON bodies together stay within the total.
    """

    def __init__(self) -> None:
        self.connections = 0
        self._json_bytes = 0

    def share(self, most: int = _MOST) -> int:
        """Return the bytes that one connection may hold: `most`, less if there are many connections, at least 8 kB."""
        return max(_LEAST, min(most, _TOTAL // max(1, self.connections)))

    def take(self, size: int, held: int) -> None:
        """Count bytes of a JSON body.

        Args:
            size: Number of bytes to add.
            held: Number of bytes of this body that were counted before.

        Raises:
            BUSY: If all JSON bodies together exceed the total, and this one exceeds the limit of one connection.
        """
        if self._json_bytes + size > _TOTAL and held + size > self.share():
            raise problems.BUSY("Too many large requests are arriving. Try again later.", retry_after=5)
        self._json_bytes += size

    def give_back(self, size: int) -> None:
        """Stop counting bytes of a JSON body."""
        self._json_bytes -= size


#: Memory budget of this process.
memory = RequestMemory()
