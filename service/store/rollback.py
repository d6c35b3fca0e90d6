"""Whether an SQLite database has gone back in time: its write-ahead log was lost, or an old copy took its place.

Files of jobs that such a database does not know must not be deleted. A marker beside the database holds the number of
the newest event, which only grows; a database that is behind its marker has lost what was committed since.
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
    """The marker of an SQLite database.

    Attributes:
        note: File that is there once the database was found to be behind, until the operator deletes it.
    """

    def __init__(self, database: Path) -> None:
        self._database = database
        self._path = database.with_name(f"{database.name}.newest")
        self.note = database.with_name(f"{database.name}.rolled-back")
        self._reached = 0

    def read(self) -> int:
        """Return the number in the marker; 0 where there is none."""
        try:
            return int(self._path.read_text())
        except (FileNotFoundError, ValueError):
            return 0

    def reach(self, number: int) -> None:
        """Record a number that has been committed: never before, or a crash would look like a loss."""
        if number > self._reached:
            self._reached = number
            self._write(number)

    def compare(self, marked: int, number: int) -> None:
        """Leave a note where the database is behind.

        Args:
            marked: What `read` returned before the database was asked.
            number: Number of the database's newest event.
        """
        if number >= marked:
            return
        message = (
            f"{self._database} has lost what was committed last: its newest event is {number}, and was {marked}. Files "
            f"that it does not know are kept; `sgsst fsck` lists them. Restore a backup, or delete {self.note} to have "
            "them collected."
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
