"""How often somebody may try to sign in with a key that is no good."""

from __future__ import annotations

import time
from collections import OrderedDict, deque
from collections.abc import Callable

from service.errors import ServiceError

#: Tries that fail, within so many seconds, from one address.
MOST_FAILURES, WITHIN_SECONDS = 10, 60.0
#: Addresses that are remembered; of more, the one that failed longest ago is forgotten.
_MOST_ADDRESSES = 10_000


class TooManyTriesError(ServiceError):
    """Too many keys that are no good."""

    code, status = "too-many-tries", 429


class SignIns:
    """Counts failures by address, in this process alone: keys are not to be guessed (256 bits), and a row in the store
    for each try would be an attack of its own.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failures: OrderedDict[str, deque[float]] = OrderedDict()

    def check(self, address: str) -> None:
        """Raise TooManyTriesError where an address has failed too often of late."""
        found = self._failures.get(address)
        if found is not None and len(found) == MOST_FAILURES:
            left = found[0] + WITHIN_SECONDS - self._clock()
            if left > 0:
                message = "Too many invalid keys came from this address. Try again later."
                raise TooManyTriesError(message, retry_after=int(left) + 1)

    def failed(self, address: str) -> None:
        """Note a try that failed."""
        self._failures.setdefault(address, deque(maxlen=MOST_FAILURES)).append(self._clock())
        self._failures.move_to_end(address)
        if len(self._failures) > _MOST_ADDRESSES:
            self._failures.popitem(last=False)

    def succeeded(self, address: str) -> None:
        """Forget the failures of an address."""
        self._failures.pop(address, None)
