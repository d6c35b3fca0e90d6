"""What requests bring themselves, charged to their owner from the first byte until it is a job's, or gone."""

from __future__ import annotations

import asyncio
import logging
from types import TracebackType
from typing import Self

from service.errors import DatabaseUnavailableError
from service.files.blobs import Blobs
from service.store.inputs import GRACE_SECONDS, Inputs
from service.store.quotas import Quotas

#: Seconds between two renewals; receipts of a process that has died expire with its half files.
_RENEWAL_SECONDS = GRACE_SECONDS / 6

_log = logging.getLogger(__name__)


class Receipts:
    """The receipts of this process, which renews them until their requests have ended."""

    def __init__(self, inputs: Inputs, blobs: Blobs) -> None:
        self.inputs, self.blobs = inputs, blobs
        self.active: set[str] = set()
        self._renewing: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start to renew."""
        self._renewing = asyncio.create_task(self._renew())

    def close(self) -> None:
        """Stop renewing."""
        if self._renewing is not None:
            self._renewing.cancel()

    def of(self, owner: str, quotas: Quotas) -> Receipt:
        """Return a receipt for an owner's request, with no charge yet."""
        return Receipt(self, owner, quotas)

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(_RENEWAL_SECONDS)
            if self.active:
                try:
                    await asyncio.to_thread(self.inputs.renew_receipts, list(self.active))
                except DatabaseUnavailableError:  # they last for several renewals
                    _log.warning("receipts could not be renewed; retrying")


class Receipt:
    """The charge for one request, and the hold on the files that it brings.

    At the end of the `async with` block, files that no job has taken over are deleted, unless others use them.

    Attributes:
        owner: Owner of the request.
        id: Id in the store; None as long as nothing is charged.
    """

    def __init__(self, receipts: Receipts, owner: str, quotas: Quotas) -> None:
        self.id: str | None = None
        self._receipts, self.owner, self._quotas = receipts, owner, quotas
        self._charged = self._received = 0

    def charge(self, declared: int) -> None:
        """Charge the bytes that a request declares; 0 for one that does not.

        Raises:
            QuotaError: there would be too many.
        """
        self.id = self._receipts.inputs.open_receipt(self.owner, declared, self._quotas)
        self._receipts.active.add(self.id)
        self._charged = declared

    def take(self, size: int) -> None:
        """Count bytes that have come, and charge those that were not declared.

        Raises:
            QuotaError: there would be too many.
        """
        self._received += size
        more = self._received - self._charged
        if more > 0 and self.id is not None:
            self._receipts.inputs.grow_receipt(self.id, more, self.owner, self._quotas)
            self._charged = self._received

    def hand_over(self) -> None:
        """Note that a job has taken the files over, and with them the charge."""
        if self.id is not None:
            self._receipts.active.discard(self.id)
            self.id = None

    def end(self) -> None:
        """Delete what the request has brought, unless others use it, and stop charging for it."""
        receipt = self.id
        if receipt is not None:
            self.hand_over()
            self._receipts.blobs.remove(self._receipts.inputs.end_receipt(receipt))

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.id is not None:
            await asyncio.to_thread(self.end)
