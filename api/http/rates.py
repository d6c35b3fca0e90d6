"""Rate limit of requests per API key, in this process."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from service import problems

#: Capacity of the token bucket, as the number of seconds of requests at the average rate that may arrive at once.
_BURST_SECONDS = 10.0
#: Maximum number of remembered owners. A forgotten owner starts again with a full bucket.
_REMEMBERED = 10_000


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
