from __future__ import annotations

import json
from pathlib import Path

import pytest

from sgsst_core.errors import OutputError
from sgsst_core.files.json_files import write_json


def test_a_name_that_is_not_unicode_is_json_all_the_same(tmp_path: Path) -> None:
    write_json(tmp_path / "r.json", {"path": "caf\udce9.ply"})
    assert json.loads((tmp_path / "r.json").read_text(encoding="utf-8")) == {"path": "caf\udce9.ply"}


def test_a_folder_that_is_not_there_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError):
        write_json(tmp_path / "missing" / "r.json", {})
    assert list(tmp_path.iterdir()) == []
