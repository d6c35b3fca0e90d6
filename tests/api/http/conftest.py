"""Inputs of tests of the REST API."""

from __future__ import annotations

import pytest

from tests.small_scenes import wall, write_files


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """Return the contents of a small scene, its cameras and a style by their role."""
    ply, cameras, style = write_files(tmp_path_factory.mktemp("inputs"), wall())
    return {"scene": ply.read_bytes(), "cameras": cameras.read_bytes(), "style": style.read_bytes()}
