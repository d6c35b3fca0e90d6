"""Webhooks: signed messages about finished jobs (Standard Webhooks, https://www.standardwebhooks.com).

Receivers are not trusted. Each message is sent over its own connection, to a verified address. One deadline covers
everything from the name lookup to the head of the response, and only the status of the response is read.
"""

from __future__ import annotations

import asyncio
import base64
import hashlib
import hmac
import ipaddress
import json
import logging
import re
import socket
import ssl
import threading
import time
from concurrent.futures import Future
from functools import cached_property

import httpx

from service.errors import InvalidWebhookError, WebhooksOffError
from service.settings import ServiceSettings
from service.store import Store
from service.store.operations import Delivery

#: Delays before further attempts in seconds: the schedule that Standard Webhooks suggests, up to a day.
_RETRY_SECONDS = (5.0, 300.0, 1800.0, 7200.0, 18_000.0, 36_000.0)
#: Time limit of one attempt in seconds: lookup, connection, TLS, request and the head of the response together.
_DEADLINE = 15.0
#: Time in seconds during which no other dispatcher takes a message that is being sent: several deadlines.
_HOLD_SECONDS = 4 * _DEADLINE
#: Maximum number of messages sent at the same time: in total, for the jobs of one key, and to one URL.
_MAX_TOTAL, _MAX_PER_OWNER, _MAX_PER_URL = 32, 8, 2
_ROUND_SECONDS = 2.0
_MAX_URL = 2000
#: Maximum length of a logged reason, which may contain text from a receiver.
_MAX_REASON = 300
#: Host name as in DNS; `_` is not allowed in host names but is in use.
_NAME = re.compile(r"(?=.{1,253}$)[a-z0-9_-]{1,63}(\.[a-z0-9_-]{1,63})*\.?", re.ASCII)
#: The only part of IPv6 that is assigned for global unicast.
_GLOBAL_UNICAST = ipaddress.IPv6Network("2000::/3")
#: IETF protocol assignments, including a cloud's metadata service; older versions of Python consider most of it public.
_PROTOCOL_ASSIGNMENTS = ipaddress.IPv4Network("192.0.0.0/24")
#: Prefix under which NAT64 translates to IPv4 (RFC 6052).
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")

_log = logging.getLogger(__name__)


def signature(secret: str, message_id: str, timestamp: int, body: bytes) -> str:
    """Return `v1,` and the base64 of HMAC-SHA256 over id, timestamp and body, joined by dots."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signed = b".".join((message_id.encode(), str(timestamp).encode(), body))
    return "v1," + base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()


def check_url(url: str, settings: ServiceSettings) -> None:
    """Check that a URL may be used as a webhook; the addresses of its host are checked at each delivery.

    Raises:
        WebhooksOffError: If the service sends no webhooks.
        InvalidWebhookError: If the URL cannot be called.
    """
    if not settings.webhooks:
        raise WebhooksOffError
    try:
        parse_url(url)
    except ValueError as error:
        raise InvalidWebhookError(url, error) from error


def parse_url(url: str) -> httpx.URL:
    """Parse the URL of a webhook in the same way as the client that sends the message.

    Raises:
        ValueError: If the URL cannot be called; the message is the reason.
    """
    if len(url) > _MAX_URL:
        raise ValueError(f"it has {len(url):,} characters, at most {_MAX_URL:,} are allowed")
    try:
        parsed = httpx.URL(url)
        host, port = parsed.raw_host.decode(), parsed.port
        _ = parsed.host  # decodes IDNA
    except (httpx.InvalidURL, UnicodeError) as error:
        raise ValueError(f"it is not a valid URL ({error})") from error
    if parsed.scheme not in ("http", "https"):
        raise ValueError("its scheme is neither http nor https")
    if parsed.userinfo:
        raise ValueError("it holds a user name or password")
    if port is not None and not 0 < port < 65536:
        raise ValueError("its port must be between 1 and 65535")
    if "%" in host or not (_NAME.fullmatch(host) or ":" in host):  # httpx has checked bracketed hosts
        raise ValueError("it has no valid host name")
    return parsed


def is_public(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    """Return whether an address is public; an IPv6 address with an embedded IPv4 address counts as the latter."""
    if isinstance(address, ipaddress.IPv6Address):
        embedded = address.ipv4_mapped or address.sixtofour
        if address in _NAT64:
            embedded = ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
        if embedded is not None:
            return is_public(embedded)
        if address not in _GLOBAL_UNICAST or address.teredo is not None:
            return False
    return address.is_global and not address.is_multicast and address not in _PROTOCOL_ASSIGNMENTS


def _look_up(host: str, port: int) -> Future[list[str]]:
    """Look up the addresses of a host on a daemon thread.

    The resolver cannot be interrupted, and the thread of an executor would delay the exit of the process. A thread that
    outlives its delivery ends with the resolver's own timeout.
    """
    future: Future[list[str]] = Future()
    future.set_running_or_notify_cancel()

    def run() -> None:
        try:
            entries = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
        except (OSError, UnicodeError) as error:
            future.set_exception(OSError(f"{host} is not known ({error})"))
        else:
            future.set_result([str(entry[4][0]) for entry in entries])

    threading.Thread(target=run, name="webhook-lookup", daemon=True).start()
    return future


async def checked_address(host: str, port: int, *, private_allowed: bool) -> str:
    """Return an address of a host that may be called; callers connect to this address, not to the name.

    Raises:
        PermissionError: If any address of the host is not public.
        OSError: If the name is unknown.
    """
    addresses = [address.partition("%")[0] for address in await asyncio.wrap_future(_look_up(host, port))]
    if not private_allowed:
        for address in addresses:
            if not is_public(ipaddress.ip_address(address)):
                raise PermissionError(f"{host} leads to {address}, which is not public")
    return addresses[0]


class Deliverer:
    """Sender of due messages, with its own thread.

    Args:
        tls: SSL context for verifying receivers; None for the public certificate authorities.
    """

    def __init__(self, settings: ServiceSettings, store: Store, tls: ssl.SSLContext | None = None) -> None:
        self._settings, self._store = settings, store
        self._given_tls = tls
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="webhooks", daemon=True)

    def start(self) -> None:
        """Start the thread if webhooks are switched on."""
        if self._settings.webhooks:
            self._thread.start()

    def stop(self) -> None:
        """Stop soon; undelivered messages stay due."""
        self._stop.set()

    def _run(self) -> None:
        while not self._stop.wait(_ROUND_SECONDS):
            try:
                self.deliver_due()
            except Exception:  # the database may be down; the thread must continue
                _log.exception("delivery of webhooks failed, retrying")

    def deliver_due(self) -> None:
        """Send due messages until none is due or being sent."""
        asyncio.run(self._deliver_due())

    async def _deliver_due(self) -> None:
        sending: dict[asyncio.Task[None], Delivery] = {}
        while not self._stop.is_set():
            for delivery in await asyncio.to_thread(self._take, list(sending.values())):
                sending[asyncio.create_task(self._deliver(delivery))] = delivery
            if not sending:
                return
            done, _ = await asyncio.wait(sending, timeout=_ROUND_SECONDS, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                del sending[task]

    def _take(self, sending: list[Delivery]) -> list[Delivery]:
        return self._store.operations.due_deliveries(
            _HOLD_SECONDS, sending, total=_MAX_TOTAL, per_owner=_MAX_PER_OWNER, per_url=_MAX_PER_URL
        )

    async def _deliver(self, delivery: Delivery) -> None:
        """Send one message and record the outcome; errors do not affect other messages."""
        try:
            async with asyncio.timeout(_DEADLINE):
                error = await self._send(delivery)
        except TimeoutError:
            error = f"no answer within {_DEADLINE:g} s"
        except Exception as failure:
            error = f"{type(failure).__name__}: {failure}"[:_MAX_REASON]
        wait = None if error is None or delivery.tries > len(_RETRY_SECONDS) else _RETRY_SECONDS[delivery.tries - 1]
        if error is not None:
            outcome = "given up" if wait is None else f"retrying in {wait:g} s"
            _log.warning(
                "webhook failed, %s: try=%d error=%s", outcome, delivery.tries, error, extra={"job": delivery.job_id}
            )
        try:
            await asyncio.to_thread(self._store.operations.settle_delivery, delivery.id, wait)
        except Exception:  # due again when the hold expires
            _log.exception("webhook outcome not stored", extra={"job": delivery.job_id})

    async def _send(self, delivery: Delivery) -> str | None:
        """Send one message and return the error; None for success."""
        url = parse_url(delivery.url)
        host, port = url.raw_host.decode(), url.port or (443 if url.scheme == "https" else 80)
        address = await checked_address(host, port, private_allowed=self._settings.webhook_private_addresses)
        body = json.dumps(delivery.body, separators=(",", ":")).encode()
        timestamp = int(time.time())
        headers = {
            "content-type": "application/json",
            "host": url.netloc.decode(),
            "webhook-id": delivery.id,
            "webhook-timestamp": str(timestamp),
            "webhook-signature": signature(await asyncio.to_thread(lambda: self._secret), delivery.id, timestamp, body),
        }
        async with (
            # one client per message: a pooled connection to an address would be reused for other names
            httpx.AsyncClient(verify=self._tls, timeout=None, follow_redirects=False, trust_env=False) as client,
            client.stream(
                "POST",
                url.copy_with(host=address, port=port),
                content=body,
                headers=headers,
                extensions={"sni_hostname": host},
            ) as answer,
        ):
            return None if answer.is_success else f"answered {answer.status_code}"

    @cached_property
    def _tls(self) -> ssl.SSLContext:
        return self._given_tls or httpx.create_ssl_context(trust_env=False)

    @cached_property
    def _secret(self) -> str:
        return self._store.operations.webhook_secret()
