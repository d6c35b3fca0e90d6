"""Limit of failed sign-ins per address."""

from __future__ import annotations

import time
from collections import OrderedDict, deque
from collections.abc import Callable

from service import problems

#: Maximum number of failed attempts from one address, and the seconds within which they count.
MOST_FAILURES, WITHIN_SECONDS = 10, 60.0
#: Maximum number of remembered addresses. Beyond it, the address with the oldest last failure is forgotten.
_MOST_ADDRESSES = 10_000


class SignIns:
    """Counter of failed sign-ins by address, in the memory of this process.

    Failures are not stored in the database. Keys of 256 bits cannot be guessed anyway, and attackers could fill the
    database with rows of failed attempts.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()

    def attempt(self, address: str) -> None:
        """Count an attempt as failed until its outcome is known, so that parallel attempts cannot pass the limit.

        Raises:
            TOO_MANY_TRIES: If the address has failed too often recently.
        """
        failures = self._failures.setdefault(address, deque(maxlen=MOST_FAILURES))
        if len(failures) == MOST_FAILURES:
            left = failures[0] + WITHIN_SECONDS - self._clock()
            if left > 0:
                raise problems.TOO_MANY_TRIES(retry_after=int(left) + 1)
        failures.append(self._clock())
        self._failures.move_to_end(address)
        if len(self._failures) > _MOST_ADDRESSES:
            self._failures.popitem(last=False)

    def withdraw(self, address: str) -> None:
        """Forget the newest attempt of an address, whose key could not be looked up."""
        failures = self._failures.get(address)
        if failures:
            failures.pop()

    def succeeded(self, address: str) -> None:
        """Forget the failures of an address."""
        self._failures.pop(address, None)
