"""Log formats of the service: lines of text, or of JSON with the job's id as a separate field."""

from __future__ import annotations

import json
import logging
import re
import sys
import textwrap
import time

_FIELDS = ("job", "attempt", "method", "path", "status", "seconds", "request_id", "owner")


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
    for noisy in ("httpx", "httpcore", "alembic", "botocore", "uvicorn.access"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
