"""Start of a process of the service: its log, as lines of text or of JSON, and the permissions of its files."""

from __future__ import annotations

import json
import logging
import os
import re
import stat
import sys
import textwrap
import time
from pathlib import Path

from sqlalchemy.engine import make_url

from service.files.objects import ObjectStore
from service.settings import ServiceSettings, read_settings
from sgsst_core.errors import SettingsError

#: Suffixes of the files that SQLite creates for a database.
_BESIDE = ("", "-wal", "-shm")
_FIELDS = ("job", "attempt", "method", "path", "status", "seconds", "request_id", "owner")

_log = logging.getLogger(__name__)


class JsonFormatter(logging.Formatter):
    """Formatter that writes one JSON object per line."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as a JSON object."""
        entry = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry |= {name: getattr(record, name) for name in _FIELDS if hasattr(record, name)}
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry)


class TextFormatter(logging.Formatter):
    """Formatter that writes time, level, message, and the job if there is one.

    Every record starts on a new line, and all its further lines are indented. Text from a request therefore cannot
    forge a record.
    """

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as a line of text, followed by the indented traceback if there is one."""
        own = " ".join(f"{name}={_value(getattr(record, name))}" for name in _FIELDS if hasattr(record, name))
        line = f"{self.formatTime(record, '%H:%M:%S')} {record.levelname.lower():<7} {record.getMessage()}"
        line = _printable(f"{line}  {own}" if own else line)
        if record.exc_info:
            trace = "\n".join(_printable(part) for part in self.formatException(record.exc_info).split("\n"))
            line += "\n" + textwrap.indent(trace, "  ")
        return line


def _value(value: object) -> str:
    """Return a value as a single word, quoted if it contains spaces, quotes, backslashes or unprintable characters."""
    text = str(value)
    return text if text.isprintable() and re.fullmatch(r'[^\s"\\]+', text) else json.dumps(text)


def _printable(text: str) -> str:
    """Escape characters that would end the line, control a terminal, or change the text direction."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def set_up(log_format: str) -> None:
    """Log records of level INFO and above to stderr in the format "json" or "text"."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if log_format == "json" else TextFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    for noisy in ("httpx2", "httpcore", "alembic", "botocore", "uvicorn.access"):
        logging.getLogger(noisy).setLevel(logging.WARNING)


def start() -> ServiceSettings:
    """Return the settings of this process, once its log and its files are set up; end it if they cannot be used."""
    try:
        settings = read_settings()
    except SettingsError as error:
        sys.exit(f"error: {error}")
    set_up(settings.log_format)
    keep_private(settings)
    return settings


def keep_private(settings: ServiceSettings) -> None:
    """Create the data folder, restrict it and the database to the owner, and set a umask for everything written later.

    Paths that belong to another user and cannot be restricted are logged.
    """
    os.umask(0o077)
    settings.folder.mkdir(parents=True, exist_ok=True)
    store, url = ObjectStore(settings.artifacts_url), make_url(settings.database_url)
    paths = [settings.folder, *([Path(store.root)] if store.local else [])]
    if url.get_backend_name() == "sqlite" and url.database:
        paths += [Path(url.database + ending) for ending in _BESIDE]
    for path in filter(Path.exists, paths):
        mode = stat.S_IMODE(path.stat().st_mode)
        if mode & 0o077:
            try:
                path.chmod(mode & 0o700)
            except PermissionError:
                _log.warning("file readable by other users, and owned by another user: path=%s", path)
