"""Protocols for the files of a job whose ranks run on machines without a shared folder.

The caller that starts the job implements them: only it knows where the files come from and where results are stored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

#: Callback for each file that was stored outside this machine. It receives the implementation's description of the
#: file, and the step if the file is a checkpoint (else None).
Stored = Callable[[Any, int | None], None]


class OpenWorkplace(Protocol):
    """Open folder on this machine that holds the files of a job."""

    folder: Path

    def finish(self, *, done: bool) -> None:
        """Store the files that have not been stored yet. Only rank 0 stores files.

        Args:
            done: Whether the job has written its results.

        Raises:
            InfrastructureError: If they cannot be stored.
        """

    def close(self) -> None:
        """Delete the folder."""


class Workplace(Protocol):
    """Factory of such folders. It is pickled and sent to every rank."""

    @property
    def scene_bytes(self) -> int:
        """Return the bytes of the job's scene in memory, estimated from its file."""

    def open(self, rank: int, stored: Stored) -> OpenWorkplace:
        """Create the folder with the job's files. On rank 0, store new output files from then on.

        Args:
            rank: Rank that opens the folder.
            stored: Callback for each stored file.

        Raises:
            InfrastructureError: If the files cannot be fetched, or the disk is full.
        """

    def after(self, stored: Sequence[Any]) -> Workplace:
        """Return the workplace of the next attempt, which resumes from the stored files."""

    def tidy(self) -> None:
        """Delete folders of this machine whose ranks were killed."""
