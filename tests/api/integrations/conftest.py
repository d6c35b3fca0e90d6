"""Fixtures of the packages for other programs: they are built, installed and used with a live service."""

from pathlib import Path

import pytest

from tests.api.service import Service
from tests.small_scenes import wall, write_files


@pytest.fixture(scope="module")
def service(whole_service: Service) -> Service:
    return whole_service


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """Return paths of a scene, its cameras and a style."""
    return write_files(tmp_path_factory.mktemp("inputs"), wall(sh_degree=1))
