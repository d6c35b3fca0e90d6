"""Permissions of the service's files: only the OS user of the service can read them."""

from __future__ import annotations

import logging
import os
import stat
from pathlib import Path

from sqlalchemy.engine import make_url

from service.files.objects import ObjectStore
from service.settings import ServiceSettings

#: Suffixes of the files that SQLite creates for a database.
_BESIDE = ("", "-wal", "-shm")

_log = logging.getLogger(__name__)


def keep_private(settings: ServiceSettings) -> None:
    """Create the data folder, restrict it and the database to the owner, and set a umask for everything written later.

    Paths that belong to another user and cannot be restricted are logged.
    """
    os.umask(0o077)
    settings.folder.mkdir(parents=True, exist_ok=True)
    for path in [settings.folder, *_result_folder(settings), *_database_files(settings)]:
        mode = stat.S_IMODE(path.stat().st_mode)
        if mode & 0o077:
            try:
                path.chmod(mode & 0o700)
            except PermissionError:
                _log.warning("file readable by other users, and owned by another user: path=%s", path)


def _result_folder(settings: ServiceSettings) -> list[Path]:
    store = ObjectStore(settings.artifacts_url)
    folder = Path(store.root)
    return [folder] if store.local and folder.is_dir() else []


def _database_files(settings: ServiceSettings) -> list[Path]:
    url = make_url(settings.database_url)
    if url.get_backend_name() != "sqlite" or not url.database:
        return []
    return [path for ending in _BESIDE if (path := Path(url.database + ending)).exists()]
