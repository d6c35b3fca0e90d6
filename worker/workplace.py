"""Where the ranks of a job find its files and leave what they make, on machines that share no folder.

What the files are and where they come from is the business of whoever starts the job; this is what ranks ask of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

#: Told of a file that was stored where others find it: what whoever starts the job wants to know of it, and the step of
#: a checkpoint (None for other files).
Stored = Callable[[Any, int | None], None]


class OpenWorkplace(Protocol):
    """A folder of this machine with a job's files in it."""

    folder: Path

    def finish(self, *, done: bool) -> None:
        """Store what has not been stored yet; the first rank does.

        Args:
            done: the results are there.

        Raises:
            InfrastructureError: that is impossible.
        """

    def close(self) -> None:
        """Remove the folder."""


class Workplace(Protocol):
    """What a machine needs to make such a folder. It is pickled, and travels to every rank."""

    @property
    def scene_bytes(self) -> int:
        """Bytes of the job's scene once it is read, as its file tells."""

    def open(self, rank: int, stored: Stored) -> OpenWorkplace:
        """Lay out the job's files; on the first rank, store what the job makes from then on.

        Raises:
            InfrastructureError: the files cannot be had, or the disk is full.
        """

    def after(self, stored: Sequence[Any]) -> Workplace:
        """The workplace of the next attempt, which goes on from what has been stored."""

    def tidy(self) -> None:
        """Remove what ranks of this machine have left that were killed."""
