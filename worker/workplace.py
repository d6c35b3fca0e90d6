"""Protocols for the files of a job whose ranks run on machines without a shared folder.

The program that starts the job implements them: only it knows where the files come from and where results are stored.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

#: Callback for each file that was stored outside this machine. It receives a description of the file, whose type the
#: implementation chooses, and the step if the file is a checkpoint (else None).
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
    """Factory of folders with the files of a job. It is pickled and sent to every rank."""

    @property
    def scene_bytes(self) -> int:
        """Return the bytes that the job's scene needs in memory, estimated from its file."""

    def open(self, rank: int, stored: Stored) -> OpenWorkplace:
        """Create the folder with the job's files. On rank 0, also start to store new output files.

        Args:
            rank: Rank that opens the folder.
            stored: Callback for each stored file.

        Raises:
            InfrastructureError: If the files cannot be fetched, or the disk is full.
        """

    def after(self, stored: Sequence[Any]) -> Workplace:
        """Return the workplace of the next attempt, which resumes from the stored files."""

    def tidy(self) -> None:
        """Delete folders that killed ranks have left on this machine."""
