"""Detection of an SQLite database that was rolled back: its write-ahead log was lost, or an old copy replaced it.

Files of jobs that are missing from such a database must not be deleted. A marker file beside the database holds the
number of the newest event, which only grows. A database that is behind its marker has lost later commits.
"""

from __future__ import annotations

import logging
import os
import time
from pathlib import Path

from sqlalchemy import text

_log = logging.getLogger(__name__)

#: Query for the number of the newest event that a database has ever had.
NEWEST_EVENT = text("SELECT coalesce(max(seq), 0) FROM sqlite_sequence WHERE name = 'events'")


class Marker:
    """Marker file of an SQLite database.

    Attributes:
        note: File that exists from the time a rollback was detected until the operator deletes it.
    """

    def __init__(self, database: Path) -> None:
        self._database = database
        self._path = database.with_name(f"{database.name}.newest")
        self.note = database.with_name(f"{database.name}.rolled-back")
        self._reached = 0

    def read(self) -> int:
        """Return the number in the marker; 0 if there is none."""
        try:
            return int(self._path.read_text())
        except (FileNotFoundError, ValueError):
            return 0

    def reach(self, number: int) -> None:
        """Record the number of a committed event; before the commit, a crash would look like a rollback."""
        if number > self._reached:
            self._reached = number
            self._write(number)

    def compare(self, marked: int, number: int) -> None:
        """Write a message to `note` if the database is behind its marker.

        Args:
            marked: Result of `read` from before the database was queried.
            number: Number of the database's newest event.
        """
        if number >= marked:
            return
        message = (
            f"database was rolled back: path={self._database} newest_event={number} expected={marked}. Files without "
            f"rows are not deleted; `sgsst fsck` lists them. Restore a backup, or delete {self.note} to have them "
            "deleted."
        )
        _log.error("%s", message)
        with self.note.open("a") as file:
            file.write(f"{time.strftime('%Y-%m-%dT%H:%M:%SZ', time.gmtime())} {message}\n")
        self._write(number)

    def _write(self, number: int) -> None:
        descriptor = os.open(self._path, os.O_WRONLY | os.O_CREAT, 0o600)
        try:
            os.pwrite(descriptor, f"{number:020d}\n".encode(), 0)
        finally:
            os.close(descriptor)
