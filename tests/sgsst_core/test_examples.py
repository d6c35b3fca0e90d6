"""Run the examples in the docstrings of the library's public functions, on files in the current folder."""

from __future__ import annotations

import doctest
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from sgsst_core import Callbacks, Camera, Scene, Stylizer, make_settings, run, stylize
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.orbit.cameras import orbit
from sgsst_core.rasterizer import make_rasterizer
from tests.small_scenes import wall, write_files

PUBLIC: list[Any] = [
    Callbacks,
    Camera,
    Camera.from_matrix,
    Scene,
    Stylizer.planned,
    load_image,
    make_rasterizer,
    make_settings,
    orbit,
]
PUBLIC += [read_cameras, read_scene, run, stylize, write_stylized]


@pytest.mark.parametrize("item", PUBLIC, ids=lambda item: item.__qualname__)
def test_example(item: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_files(tmp_path, wall())
    monkeypatch.chdir(tmp_path)
    names = {each.__name__: each for each in PUBLIC if "." not in each.__qualname__}
    names |= {"Stylizer": Stylizer, "Path": Path, "torch": torch}
    examples = doctest.DocTestFinder(recurse=False).find(item, item.__qualname__, globs=names)
    assert sum(len(each.examples) for each in examples) > 1
    for each in examples:
        results = doctest.DocTestRunner().run(each)
        assert results.failed == 0
