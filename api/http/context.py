"""What routes need: the parts of the service, and who is asking."""

from __future__ import annotations

import asyncio
import re
from dataclasses import dataclass
from typing import Annotated
from urllib.parse import urlsplit

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from api.http.hub import Hub
from api.http.metrics import Metrics
from api.http.rates import Rates
from service.errors import ServiceError
from service.files.artifacts import Artifacts
from service.files.blobs import Blobs
from service.inspection.inspector import Inspector
from service.inspection.packer import Packer
from service.settings import ServiceSettings
from service.store import Store
from service.store.quotas import NO_QUOTAS, Quotas

#: Who owns what is created without a key, where no key is needed.
LOCAL_OWNER = "local"
_LOOPBACK_NAMES = {"localhost", "127.0.0.1", "::1"}


class NoKeyError(ServiceError):
    """No API key, or one that is unknown or revoked."""

    code, status = "unauthorized", 401


class ForeignSiteError(ServiceError):
    """A web page of another site tries to use a service that is open to this machine's programs."""

    code, status = "foreign-site", 403


@dataclass(frozen=True)
class Context:
    """The parts of the service, made once a process."""

    settings: ServiceSettings
    store: Store
    blobs: Blobs
    artifacts: Artifacts
    inspector: Inspector
    packer: Packer
    hub: Hub
    metrics: Metrics
    rates: Rates


@dataclass(frozen=True)
class Caller:
    """Who is asking: everything that is created belongs to `owner`, and nothing else can be seen."""

    owner: str
    priority: int
    quotas: Quotas = NO_QUOTAS


async def get_context(request: Request) -> Context:
    """The app's context; not a plain function, which would run on another thread."""
    found: Context = request.app.state.context
    return found


ContextDep = Annotated[Context, Depends(get_context)]
_bearer = HTTPBearer(auto_error=False, description="An API key: `sgsst keys create NAME` on the service's machine.")


async def get_caller(
    request: Request, context: ContextDep, given: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
) -> Caller:
    """The holder of the request's API key; everybody on this machine is the same one where no key is needed.

    Raises:
        NoKeyError: a key is needed and missing, or it is no good.
        ForeignSiteError: no key, and the request comes from a web page that this service did not serve.
        RateLimitError: requests with this key come too fast.
    """
    if given is not None:
        key = await asyncio.to_thread(context.store.keys.find, given.credentials)
        if key is None:
            raise NoKeyError("The API key is unknown or was revoked. `sgsst keys create NAME` makes one.")
        quotas = Quotas.of_settings(context.settings).with_own(key.quotas)
        context.rates.take(key.id, quotas.requests_a_second)
        return Caller(key.id, key.priority, quotas)
    if request.headers.get("authorization") is not None:
        raise NoKeyError("The Authorization header must have the form 'Bearer KEY'.")
    if context.settings.keys_required:
        raise NoKeyError("An API key is needed: send it as 'Authorization: Bearer KEY'.")
    _check_site(request, context.settings)
    return Caller(LOCAL_OWNER, 0)


CallerDep = Annotated[Caller, Depends(get_caller)]


def _check_site(request: Request, settings: ServiceSettings) -> None:
    """Keep web pages out that a browser on this machine shows: neither by their own name nor by a name of theirs that
    leads to this machine may they use a service that asks for no key.
    """
    host = _hostname(f"//{request.headers.get('host', '')}")
    if settings.on_loopback and host not in _LOOPBACK_NAMES and not host.startswith("127."):
        raise ForeignSiteError(f"The service is open to this machine only, and {host!r} is not one of its names.")
    origin = request.headers.get("origin")
    if origin is not None and urlsplit(origin).netloc != request.headers.get("host"):
        raise ForeignSiteError(f"Pages of {origin!r} may not use this service without an API key.")


def _hostname(text: str) -> str:
    try:
        return urlsplit(text).hostname or ""
    except ValueError:
        return ""


_ID = re.compile(r"[a-z]{3}_[0-9a-f]{8,36}")


def is_id(text: str) -> bool:
    """Whether it looks like an id; everything else is not worth a look into the store."""
    return _ID.fullmatch(text) is not None
