"""Limits of requests in the memory of this process: of requests per API key, and of failed sign-ins per address."""

from __future__ import annotations

import math
import time
from collections import OrderedDict, deque
from collections.abc import Callable

from service import problems

#: Capacity of the token bucket, as the number of seconds of requests at the average rate that may arrive at once.
_BURST_SECONDS = 10.0
#: Maximum number of remembered owners. A forgotten owner starts again with a full bucket.
_REMEMBERED = 10_000
#: Maximum number of failed attempts from one address, and the seconds within which they count.
MOST_FAILURES, WITHIN_SECONDS = 10, 60.0
#: Maximum number of remembered addresses. Beyond it, the address with the oldest last failure is forgotten.
_MOST_ADDRESSES = 10_000


class Rates:
    """Token bucket of requests for each owner."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left: dict[str, tuple[float, float]] = {}

    def take(self, owner: str, rate: float | None) -> None:
        """Take one token from the owner's bucket.

        Args:
            owner: Owner of the request's key.
            rate: Requests per second that the owner may send on average; None for no limit.

        Raises:
            RATE_LIMITED: If the owner's bucket is empty.
        """
        if rate is None:
            return
        most = max(1.0, rate * _BURST_SECONDS)
        now = self._clock()
        left, seen = self._left.pop(owner, (most, now))
        left = min(most, left + (now - seen) * rate)
        allowed = left >= 1
        self._left[owner] = (left - 1 if allowed else left), now
        if len(self._left) > _REMEMBERED:
            del self._left[next(iter(self._left))]  # the owner with the oldest last request
        if not allowed:
            raise problems.RATE_LIMITED(limit=rate, retry_after=math.ceil((1 - left) / rate))


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
