"""Webhooks: signed messages about jobs (Standard Webhooks, https://www.standardwebhooks.com).

Receivers are not trusted. Each message is sent over its own connection, to a verified address. One deadline covers
everything from the name lookup to the head of the response, and only the status of the response is read.
"""

import asyncio
import base64
import hashlib
import hmac
import json
import logging
import ssl
import time
from functools import cached_property

from service import problems
from service.outgoing import parse_url, send
from service.settings import ServiceSettings
from service.store import Store
from service.store.jobs import PROGRESS_MESSAGE
from service.store.tables import DeliveryRow

#: Delays before further attempts in seconds: the schedule that Standard Webhooks suggests, up to a day.
_RETRY_SECONDS = (5.0, 300.0, 1800.0, 7200.0, 18_000.0, 36_000.0)
#: Time limit of one attempt in seconds: lookup, connection, TLS, request and the head of the response together.
_DEADLINE = 15.0
#: Time in seconds during which no other dispatcher takes a message that is being sent: several deadlines.
_HOLD_SECONDS = 4 * _DEADLINE
#: Maximum number of messages sent at the same time: in total, for the jobs of one key, and to one URL.
_MAX_TOTAL, _MAX_PER_OWNER, _MAX_PER_URL = 32, 8, 2
_ROUND_SECONDS = 2.0
#: Maximum length of a logged reason, which may contain text from a receiver.
_MAX_REASON = 300

_log = logging.getLogger(__name__)


def signature(secret: str, message_id: str, timestamp: int, body: bytes) -> str:
    """Return `v1,` and the base64 of HMAC-SHA256 over id, timestamp and body, joined by dots."""
    key = base64.b64decode(secret.removeprefix("whsec_"))
    signed = b".".join((message_id.encode(), str(timestamp).encode(), body))
    return "v1," + base64.b64encode(hmac.new(key, signed, hashlib.sha256).digest()).decode()


def check_url(url: str, settings: ServiceSettings) -> None:
    """Check that a URL may be used as a webhook; the addresses of its host are checked at each delivery.

    Raises:
        WEBHOOKS_OFF: If the service sends no webhooks.
        INVALID_WEBHOOK: If the URL cannot be called.
    """
    if not settings.webhooks:
        raise problems.WEBHOOKS_OFF(input="webhook")
    try:
        parse_url(url)
    except ValueError as error:
        raise problems.INVALID_WEBHOOK(url=url[:100], reason=error, input="webhook") from error


class Deliverer:
    """Sender of due messages.

    Args:
        tls: SSL context for verifying receivers; None for the public certificate authorities.
    """

    def __init__(self, settings: ServiceSettings, store: Store, tls: ssl.SSLContext | None = None) -> None:
        self._settings, self._store = settings, store
        self._tls = tls

    def deliver_due(self) -> None:
        """Send due messages until none is due or being sent."""
        asyncio.run(self._deliver_due())

    async def _deliver_due(self) -> None:
        sending: dict[asyncio.Task[None], tuple[DeliveryRow, str]] = {}
        while True:
            limits = {"total": _MAX_TOTAL, "per_owner": _MAX_PER_OWNER, "per_url": _MAX_PER_URL}
            due = self._store.operations.due_deliveries
            for claimed in await asyncio.to_thread(due, _HOLD_SECONDS, list(sending.values()), **limits):
                sending[asyncio.create_task(self._deliver(claimed[0]))] = claimed
            if not sending:
                return
            done, _ = await asyncio.wait(sending, timeout=_ROUND_SECONDS, return_when=asyncio.FIRST_COMPLETED)
            for task in done:
                del sending[task]

    async def _deliver(self, delivery: DeliveryRow) -> None:
        """Send one message and record the outcome; errors do not affect other messages."""
        try:
            async with asyncio.timeout(_DEADLINE):
                error = await self._send(delivery)
        except TimeoutError:
            error = f"no answer within {_DEADLINE:g} s"
        except Exception as failure:
            error = f"{type(failure).__name__}: {failure}"[:_MAX_REASON]
        is_last = delivery.body.get("type") == PROGRESS_MESSAGE or delivery.tries > len(_RETRY_SECONDS)
        wait = None if error is None or is_last else _RETRY_SECONDS[delivery.tries - 1]
        if error is not None:
            outcome = "given up" if wait is None else f"retrying in {wait:g} s"
            _log.warning(
                "webhook failed, %s: try=%d error=%s", outcome, delivery.tries, error, extra={"job": delivery.job_id}
            )
        # if this fails, asyncio logs the error, and the message is due again when the hold expires
        await asyncio.to_thread(self._store.operations.settle_delivery, delivery.id, wait)

    async def _send(self, delivery: DeliveryRow) -> str | None:
        """Send one message and return the error; None for success."""
        url = parse_url(delivery.url)
        body = json.dumps(delivery.body, separators=(",", ":")).encode()
        timestamp = int(time.time())
        headers = {
            "content-type": "application/json",
            "webhook-id": delivery.id,
            "webhook-timestamp": str(timestamp),
            "webhook-signature": signature(await asyncio.to_thread(lambda: self._secret), delivery.id, timestamp, body),
        }
        private_allowed = self._settings.webhook_private_addresses
        async with send("POST", url, headers, private_allowed=private_allowed, content=body, tls=self._tls) as answer:
            return None if answer.is_success else f"answered {answer.status_code}"

    @cached_property
    def _secret(self) -> str:
        return self._store.operations.webhook_secret()
