"""Tells other servers that jobs have ended: Standard Webhooks (https://www.standardwebhooks.com), off by default."""

from __future__ import annotations

import base64
import hashlib
import hmac
import ipaddress
import json
import logging
import socket
import threading
import time
from urllib.parse import urlsplit

import httpx

from service.errors import RefusedInputError
from service.settings import ServiceSettings
from service.store import Store
from service.store.tables import DeliveryRow

#: Waits before further tries, seconds: the schedule that the convention suggests, up to a day.
_WAITS = (5.0, 300.0, 1800.0, 7200.0, 18_000.0, 36_000.0)
_TIMEOUT = 15.0
_ROUND_SECONDS = 2.0

_log = logging.getLogger(__name__)


def signature(secret: str, message_id: str, timestamp: int, body: bytes) -> str:
    """`v1,` and the base64 of HMAC-SHA256 over id, timestamp and body, joined by dots."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signed = b".".join((message_id.encode(), str(timestamp).encode(), body))
    return "v1," + base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()


def check_url(url: str, settings: ServiceSettings) -> str:
    """The URL of a webhook, if it may be called.

    Raises:
        RefusedInputError: webhooks are off, or it is not an http(s) URL.
    """
    if not settings.webhooks:
        raise RefusedInputError("Webhooks are switched off on this service.", "webhooks-off", input="webhook")
    parts = urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.hostname or parts.username or len(url) > 2000:
        raise RefusedInputError(f"{url!r} is no http or https URL.", "invalid-webhook", input="webhook")
    return url


def public_address(host: str, port: int, *, private_allowed: bool) -> str:
    """An address of a host that may be called; it is looked up once, so that it cannot change after the check.

    Raises:
        PermissionError: every one of its addresses is private, or one is: a name that leads to both is a trick.
    """
    found = {entry[4][0] for entry in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    addresses = [ipaddress.ip_address(str(address).partition("%")[0]) for address in found]
    if not private_allowed:
        for address in addresses:
            mapped = getattr(address, "ipv4_mapped", None) or address
            if not mapped.is_global or mapped.is_multicast:
                raise PermissionError(f"{host} leads to {address}, which is not public")
    return str(addresses[0])


class Deliverer:
    """Sends what is due, in a thread of its own."""

    def __init__(self, settings: ServiceSettings, store: Store) -> None:
        self._settings, self._store = settings, store
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="webhooks", daemon=True)

    def start(self) -> None:
        """Begin, where webhooks are switched on."""
        if self._settings.webhooks:
            self._thread.start()

    def stop(self) -> None:
        """End after the message in hand."""
        self._stop.set()

    def _run(self) -> None:
        while not self._stop.wait(_ROUND_SECONDS):
            try:
                self.deliver_due()
            except Exception:  # the thread must go on
                _log.exception("webhooks could not be delivered")

    def deliver_due(self) -> None:
        """Send all messages that are due."""
        for delivery in self._store.operations.due_deliveries(hold_seconds=4 * _TIMEOUT):
            error = self._send(delivery)
            wait = None if error is None or delivery.tries > len(_WAITS) else _WAITS[delivery.tries - 1]
            self._store.operations.settle_delivery(
                delivery.id, None if wait is None else self._store.database.clock() + wait
            )
            if error is not None:
                _log.warning(
                    "webhook to %s: %s", urlsplit(delivery.url).hostname, error, extra={"job": delivery.job_id}
                )

    def _send(self, delivery: DeliveryRow) -> str | None:
        """Send one message; returns what went wrong."""
        parts = urlsplit(delivery.url)
        host, port = parts.hostname or "", parts.port or (443 if parts.scheme == "https" else 80)
        try:
            address = public_address(host, port, private_allowed=self._settings.webhook_private_addresses)
        except (OSError, ValueError) as error:
            return str(error)
        body = json.dumps(delivery.body, separators=(",", ":")).encode()
        timestamp = int(time.time())
        headers = {
            "content-type": "application/json",
            "host": parts.netloc,
            "webhook-id": delivery.id,
            "webhook-timestamp": str(timestamp),
            "webhook-signature": signature(self._store.operations.webhook_secret(), delivery.id, timestamp, body),
        }
        literal = f"[{address}]" if ":" in address else address
        target = parts._replace(netloc=f"{literal}:{port}").geturl()
        try:
            with httpx.Client(timeout=_TIMEOUT, follow_redirects=False, trust_env=False) as client:
                answer = client.post(target, content=body, headers=headers, extensions={"sni_hostname": host})
        except httpx.HTTPError as error:
            return f"{type(error).__name__}: {error}"
        return None if answer.is_success else f"answered {answer.status_code}"
