"""Quota charges for the bytes of running requests, called receipts.

The owner is charged from the first byte until a job takes over the files, or until the files are deleted.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from functools import partial
from types import TracebackType
from typing import Self

from service.deadlines import FileThreads
from service.files.blobs import Blobs
from service.problems import DatabaseUnavailableError, StoreError
from service.store.files import GRACE_SECONDS, InputRows
from service.store.keys import Quotas

#: Seconds between two renewals. If a process dies, its receipts and partial files expire.
_RENEWAL_SECONDS = GRACE_SECONDS / 6

_log = logging.getLogger(__name__)


class Receipts:
    """Receipts of this process. A background task renews each one until its request has ended."""

    def __init__(self, inputs: InputRows, blobs: Blobs, threads: FileThreads) -> None:
        self.inputs, self._blobs, self._threads = inputs, blobs, threads
        self.active: set[str] = set()
        self._renewing: asyncio.Task[None] | None = None

    def start(self) -> None:
        """Start the renewal task."""
        self._renewing = asyncio.create_task(self._renew())

    def close(self) -> None:
        """Stop the renewal task."""
        if self._renewing is not None:
            self._renewing.cancel()

    async def end(self, owner: str, receipt: str) -> None:
        """Release the charge of a receipt, and delete the request's files unless other jobs or uploads use them."""
        self.active.discard(receipt)
        await self._threads.clean_up(self._end(owner, receipt))

    async def _end(self, owner: str, receipt: str) -> None:
        unused = await asyncio.to_thread(self.inputs.end_receipt, receipt)
        if unused:
            await self.remove(owner, partial(self._blobs.remove, unused))

    async def remove(self, owner: str, files: Callable[[], None]) -> None:
        """Remove files that no database row refers to any longer; housekeeping removes those that remain."""
        try:
            await self._threads.clean_up(self._threads.run(owner, files))
        except (StoreError, OSError) as error:
            _log.warning("unused files not deleted yet: %s", error.__cause__ or error)

    async def _renew(self) -> None:
        while True:
            await asyncio.sleep(_RENEWAL_SECONDS)
            if self.active:
                try:
                    await asyncio.to_thread(self.inputs.renew_receipts, list(self.active))
                except DatabaseUnavailableError:  # receipts survive several missed renewals
                    _log.warning("cannot renew receipts; retrying")


class Receipt:
    """Quota charge of one request, nothing at first, which also protects the request's files from deletion.

    At the end of the `async with` block, files that no job has taken over are deleted, unless other jobs or uploads use
    them.

    Attributes:
        id: Id in the database; None until something is charged.
    """

    def __init__(self, receipts: Receipts, owner: str, quotas: Quotas) -> None:
        self.id: str | None = None
        self._receipts, self.owner, self._quotas = receipts, owner, quotas
        self._charged = self._received = 0

    def charge(self, declared: int) -> None:
        """Charge bytes that the request, or a server it names, declares; 0 if it declares none.

        Raises:
            QUOTA_EXCEEDED: If the owner would exceed the quota.
        """
        if self.id is None:
            self.id = self._receipts.inputs.open_receipt(self.owner, declared, self._quotas)
            self._receipts.active.add(self.id)
        elif declared:
            self._receipts.inputs.grow_receipt(self.id, declared, self.owner, self._quotas)
        self._charged += declared

    def take(self, size: int) -> None:
        """Count received bytes, and charge those that were not declared.

        Raises:
            QUOTA_EXCEEDED: If the owner would exceed the quota.
        """
        self._received += size
        more = self._received - self._charged
        if more > 0 and self.id is not None:
            self._receipts.inputs.grow_receipt(self.id, more, self.owner, self._quotas)
            self._charged = self._received

    def hand_over(self) -> None:
        """Record that a job has taken over the files and their charge."""
        if self.id is not None:
            self._receipts.active.discard(self.id)
            self.id = None

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        receipt, self.id = self.id, None
        if receipt is not None:
            await self._receipts.end(self.owner, receipt)
