"""Inputs of tests of the REST API."""

from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def files(paths: dict[str, Path]) -> dict[str, bytes]:
    """Return the contents of a small scene, its cameras and a style by their role."""
    return {role: path.read_bytes() for role, path in paths.items()}
