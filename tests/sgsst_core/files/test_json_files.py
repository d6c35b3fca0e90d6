from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import write_json
from sgsst_core.files.formats.scene_format import json_numbers


def test_non_unicode_names_are_written_as_json(tmp_path: Path) -> None:
    write_json(tmp_path / "r.json", {"path": "caf\udce9.ply"})
    assert json.loads((tmp_path / "r.json").read_text(encoding="utf-8")) == {"path": "caf\udce9.ply"}


def test_missing_folder_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        write_json(tmp_path / "missing" / "r.json", {})
    assert list(tmp_path.iterdir()) == []


def test_numbers_are_accepted() -> None:
    assert json_numbers([1, 2.5, 10**30], 3).tolist() == [1, 2.5, 1e30]
    assert json_numbers(7, 1).tolist() == [7]
    assert math.isnan(json_numbers([None], 1)[0])


@pytest.mark.parametrize(
    "values", [[], [1], [1, 2, 3], ["1_0", 2], [True, 2], [[1], [2]], [{}, 2], "12", {"a": 1, "b": 2}]
)
def test_other_values_are_refused(values: Any) -> None:
    with pytest.raises(ValueError, match="in place of 2 numbers"):
        json_numbers(values, 2)
