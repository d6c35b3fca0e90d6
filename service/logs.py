"""Logs of the service: a line of text, or of JSON with the job's id as a field of its own."""

from __future__ import annotations

import json
import logging
import re
import sys
import textwrap
import time

_OWN = ("job", "attempt", "method", "path", "status", "seconds", "owner")


class JsonFormatter(logging.Formatter):
    """One JSON object a line."""

    def format(self, record: logging.LogRecord) -> str:
        """As the base class."""
        entry = {
            "time": time.strftime("%Y-%m-%dT%H:%M:%S", time.gmtime(record.created)) + f".{int(record.msecs):03d}Z",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
        }
        entry |= {name: getattr(record, name) for name in _OWN if hasattr(record, name)}
        if record.exc_info:
            entry["exception"] = self.formatException(record.exc_info)
        return json.dumps(entry)


class TextFormatter(logging.Formatter):
    """Time, level, message, and the job where there is one.

    A record starts at the beginning of a line and nothing else does, whatever text of a request it repeats.
    """

    def format(self, record: logging.LogRecord) -> str:
        """As the base class."""
        own = " ".join(f"{name}={_value(getattr(record, name))}" for name in _OWN if hasattr(record, name))
        line = f"{self.formatTime(record, '%H:%M:%S')} {record.levelname.lower():<7} {record.getMessage()}"
        line = _printable(f"{line}  {own}" if own else line)
        if record.exc_info:
            trace = "\n".join(_printable(part) for part in self.formatException(record.exc_info).split("\n"))
            line += "\n" + textwrap.indent(trace, "  ")
        return line


def _value(value: object) -> str:
    """Return a value as one word, in quotes unless it is one of letters alone."""
    text = str(value)
    return text if text.isprintable() and re.fullmatch(r'[^\s"\\]+', text) else json.dumps(text)


def _printable(text: str) -> str:
    """Return a text with escapes for what would end its line, steer a terminal, or change the order of its letters."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text)


def set_up(form: str) -> None:
    """Send everything from INFO on to stderr, in the form "json" or "text"."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonFormatter() if form == "json" else TextFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler], force=True)
    for noisy in ("httpx", "httpcore", "alembic", "botocore", "uvicorn.access"):
        logging.getLogger(noisy).setLevel(logging.WARNING)
