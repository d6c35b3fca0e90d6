"""Dependencies of the routes: the components of the service, the caller of a request, and limits.

Programs send an API key with each request. A browser sends its key once (`POST /v1/session`) and gets a cookie, which
it then also sends with images, downloads and event streams.

Browsers may attach a cookie to requests from pages of any site; `SameSite=Strict` prevents that. In addition, a request
that changes something must come from a page of this origin, according to the browser's headers (`Origin`,
`Sec-Fetch-Site`).
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Annotated

from fastapi import Depends, Request
from fastapi.security import APIKeyCookie, HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BeforeValidator

from api.http.problems import raises
from service import problems
from service.scheduling.capacity import Machine
from service.settings import ServiceSettings, is_loopback
from service.store.keys import NO_QUOTAS, Quotas
from service.store.tables import KeyRow

if TYPE_CHECKING:
    from api.http.jobs import Hub
    from api.http.monitoring import Metrics, Readiness
    from api.http.receiving import Fetcher, Receipts
    from service.deadlines import FileThreads, OwnerLimit
    from service.files.blobs import Blobs
    from service.files.objects import Artifacts
    from service.inspection.derived import DerivedFiles
    from service.inspection.inspector import Inspector
    from service.store import Store

#: Owner of everything that is created without a key, on services that require none.
LOCAL_OWNER = "local"
#: Name of the session cookie.
SESSION_COOKIE = "sgsst_session"
#: Methods that change nothing.
_READING = ("GET", "HEAD", "OPTIONS")
#: A Host header: an IPv6 address in brackets, or a name or IPv4 address, then optionally a port.
_HOST = re.compile(r"(?:\[([^\]]*)\]|([^:/?#@\[\]\\]*))(?::[0-9]*)?")
#: Time budgets in seconds that the page proposes, with a GPU and without one.
_GPU_BUDGET, _CPU_BUDGET = 60, 600


@dataclass(frozen=True)
class Context:
    """Components of the service, created once per process."""

    settings: ServiceSettings
    store: Store
    blobs: Blobs
    artifacts: Artifacts
    inspector: Inspector
    derived: DerivedFiles
    hub: Hub
    metrics: Metrics
    readiness: Readiness
    sign_ins: Rates
    rates: Rates
    receipts: Receipts
    threads: FileThreads
    readers: OwnerLimit
    fetcher: Fetcher

    @cached_property
    def usual_budget(self) -> int:
        """Time budget in seconds that the page proposes for jobs on this machine."""
        return _GPU_BUDGET if Machine.find(self.settings).gpus else _CPU_BUDGET


@dataclass(frozen=True)
class Caller:
    """Client that sends a request. It can only access what it has created itself.

    Attributes:
        operator: Whether it sees the usage of all keys too.
    """

    owner: str
    priority: int
    quotas: Quotas = NO_QUOTAS
    operator: bool = False


async def get_context(request: Request) -> Context:
    """Return the app's context. It is async because FastAPI runs plain functions in another thread."""
    context: Context = request.app.state.context
    return context


ContextDep = Annotated[Context, Depends(get_context)]
_bearer = HTTPBearer(
    auto_error=False, description="API key created by `sgsst keys create NAME` on the service's machine."
)
_cookie = APIKeyCookie(
    name=SESSION_COOKIE, auto_error=False, description="Session cookie of a browser, from `POST /v1/session`."
)


@raises(problems.RATE_LIMITED, problems.UNAUTHORIZED, problems.FOREIGN_SITE, problems.CROSS_ORIGIN)
async def get_caller(
    request: Request,
    context: ContextDep,
    given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)],
    cookie: Annotated[str | None, Depends(_cookie)],
) -> Caller:
    """Return the owner of the request's API key, or of its session if there is no key.

    If the service requires no keys, all requests have the same owner.

    Raises:
        UNAUTHORIZED: If a key is required and missing, or the key is not valid.
        CROSS_ORIGIN: If the session is valid, but the page that requests a change is not one of this service.
        FOREIGN_SITE: If there is no key, and the request comes from a web page that this service did not serve.
        RATE_LIMITED: If requests with this key arrive too fast.
    """
    if given is not None:
        key = await asyncio.to_thread(context.store.keys.find, given.credentials)
        if key is None:
            raise problems.UNKNOWN_KEY()
        return _caller(context, key)
    if request.headers.get("authorization") is not None:
        raise problems.UNAUTHORIZED("The Authorization header must have the form 'Bearer KEY'.")
    key = await asyncio.to_thread(context.store.sessions.find, cookie) if cookie else None
    if key is not None:
        if request.method not in _READING:
            check_origin(request)
        return _caller(context, key)
    if context.settings.keys_required:
        if cookie:
            raise problems.UNAUTHORIZED("The session has ended. Sign in again with an API key.")
        raise problems.UNAUTHORIZED()
    check_site(request, context.settings)
    return Caller(LOCAL_OWNER, 0, operator=True)


def _caller(context: Context, key: KeyRow) -> Caller:
    """Count a request against the key's rate limit, and return its caller."""
    quotas = Quotas.of_settings(context.settings).with_own(key.quotas)
    context.rates.take(key.id, quotas.requests_a_second)
    return Caller(key.id, key.priority, quotas, operator=key.operator)


CallerDep = Annotated[Caller, Depends(get_caller)]


def check_origin(request: Request, *, required: bool = True) -> None:
    """Check that a request comes from a page of this service, according to the browser's headers.

    Args:
        required: Whether to refuse requests without such headers, which only browsers send.

    Raises:
        CROSS_ORIGIN: If the request comes from another origin, or lacks required headers.
    """
    origin, site = request.headers.get("origin"), request.headers.get("sec-fetch-site")
    if origin is not None and origin.partition("://")[2] != request.headers.get("host"):
        raise problems.CROSS_ORIGIN(f"Pages of {origin[:100]!r} may not use the sessions of this service.")
    if site is not None and site != "same-origin":
        raise problems.CROSS_ORIGIN("Pages of other sites may not use the sessions of this service.")
    if required and origin is None and site is None:
        raise problems.CROSS_ORIGIN(
            "A request with a session cookie that changes something must state its page (Origin). "
            "Programs send an API key instead: 'Authorization: Bearer KEY'."
        )


def check_site(request: Request, settings: ServiceSettings) -> None:
    """Refuse requests of other sites' pages to a service that requires no key.

    A malicious page that is open in a browser on this machine could call the service across origins, or through a DNS
    name that resolves to this machine (DNS rebinding). Both are refused.

    Raises:
        FOREIGN_SITE: If the Host or Origin header is not this service's.
    """
    match = _HOST.fullmatch(request.headers.get("host", ""))
    host = (match[1] or match[2] or "").lower() if match else ""
    if settings.on_loopback and not is_loopback(host):
        raise problems.FOREIGN_SITE(
            f"The service accepts requests from this machine only, and {host[:100]!r} is not one of its names."
        )
    origin = request.headers.get("origin")
    if origin is not None and origin.partition("://")[2] != request.headers.get("host"):
        raise problems.FOREIGN_SITE(f"Pages of {origin!r} may not use this service without an API key.")


_ID = re.compile(r"[a-z]{3}_[0-9a-f]{8,36}")


def is_id(text: str) -> bool:
    """Return whether a text has the format of an id. Other texts need no database query."""
    return _ID.fullmatch(text) is not None


def _digits(text: object) -> object:
    """Check that a text has decimal digits only, and return it.

    Raises:
        ValueError: If the text contains anything else, such as a sign, spaces, underscores, or digits of another
            script. `int` accepts all of these, but a proxy in front of the service may read them as another number.
    """
    if isinstance(text, str) and not re.fullmatch("[0-9]+", text):
        raise ValueError("Input should be decimal digits")
    return text


#: A whole number, written in decimal digits only.
Digits = Annotated[int, BeforeValidator(_digits)]

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

#: Capacity of the token bucket, as the number of seconds of requests at the average rate that may arrive at once.
_BURST_SECONDS = 10.0
#: Maximum number of remembered owners. A forgotten owner starts again with a full bucket.
_REMEMBERED = 10_000


class Rates:
    """Token bucket of requests for each owner."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._left: dict[str, tuple[float, float]] = {}

    def take(self, owner: str, rate: float | None, most: float | None = None) -> None:
        """Take one token from the owner's bucket.

        Args:
            owner: Owner of the request's key.
            rate: Requests per second that the owner may send on average; None for no limit.
            most: Capacity of the bucket; None for the requests of ten seconds.

        Raises:
            RATE_LIMITED: If the owner's bucket is empty.
        """
        if rate is None:
            return
        most = most or max(1.0, rate * _BURST_SECONDS)
        now = self._clock()
        left, seen = self._left.pop(owner, (most, now))
        left = min(most, left + (now - seen) * rate)
        allowed = left >= 1
        self._left[owner] = (left - 1 if allowed else left), now
        if len(self._left) > _REMEMBERED:
            del self._left[next(iter(self._left))]  # the owner with the oldest last request
        if not allowed:
            raise problems.RATE_LIMITED(limit=rate, retry_after=math.ceil((1 - left) / rate))

    def give_back(self, owner: str) -> None:
        """Return the token of a request that does not count."""
        if owner in self._left:
            left, seen = self._left[owner]
            self._left[owner] = left + 1, seen
