"""Run the examples in the docstrings of the library's public functions, on files in the current folder."""

import doctest
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

import sgsst_core
from sgsst_core import Camera, Stylizer
from sgsst_core.files.library import scene_of_splats
from sgsst_core.files.scene_file import write_stylized
from sgsst_core.orbit import orbit
from sgsst_core.rasterizer import make_rasterizer
from tests.small_scenes import wall, write_files

EXPORTED = {name: getattr(sgsst_core, name) for name in sgsst_core.__all__}
#: Exported names without an example: plain records, and classes whose factories have one.
PLAIN = ("Progress", "Settings", "Style", "Stylizer")
PUBLIC: list[Any] = [item for name, item in EXPORTED.items() if name not in PLAIN]
PUBLIC += [Camera.from_matrix, Stylizer.planned, make_rasterizer, orbit, scene_of_splats, write_stylized]


@pytest.mark.parametrize("item", PUBLIC, ids=lambda item: item.__qualname__)
def test_docstring_example_runs(item: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_files(tmp_path, wall())
    monkeypatch.chdir(tmp_path)
    names = {each.__name__: each for each in PUBLIC} | EXPORTED | {"Path": Path, "torch": torch}
    examples = doctest.DocTestFinder(recurse=False).find(item, item.__qualname__, globs=names)
    assert sum(len(each.examples) for each in examples) > 1
    for each in examples:
        results = doctest.DocTestRunner().run(each)
        assert results.failed == 0
