"""Atomic writing of JSON files, and validation of numbers in JSON from other programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

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


def json_numbers(values: Any, count: int) -> NDArray[np.float64]:
    """Return `count` numbers of a parsed JSON list, or a single number, as float64. null becomes NaN.

    Raises:
        ValueError: If there are more or fewer, or any is a text, a truth value or a list.
        OverflowError: If an integer is too large.
    """
    numbers = values if isinstance(values, list) else [values]
    if len(numbers) != count or not all(type(value) in (int, float, type(None)) for value in numbers):
        raise ValueError(f"{len(numbers)} values in place of {count} numbers, or values that are not numbers")
    return np.array(numbers, np.float64)
