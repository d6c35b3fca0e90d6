"""JSON files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sgsst_core.files.atomic import atomic_path


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write values as JSON; the file appears whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    with atomic_path(path) as temporary:
        # A file name that is no valid Unicode holds lone surrogates: as escapes they are what JSON means by them.
        text = json.dumps(values, indent=1, ensure_ascii=False) + "\n"
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
