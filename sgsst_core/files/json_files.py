"""Atomic writing of JSON files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sgsst_core.files.atomic import atomic_path


def write_json(path: Path, values: dict[str, Any]) -> None:
    """Write values as JSON, atomically.

    Raises:
        OutputError: If the file cannot be written.
    """
    with atomic_path(path) as temporary:
        # File names that are not valid Unicode contain lone surrogates, which JSON can only represent as escapes.
        text = json.dumps(values, indent=1, ensure_ascii=False) + "\n"
        temporary.write_text(text, encoding="utf-8", errors="backslashreplace")
