"""Fixtures that every test package shares."""

from __future__ import annotations

from pathlib import Path

import pytest

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder with the real scenes, photos and paintings; tests that need it are skipped where it is not."""
    if not DATA.is_dir():
        pytest.skip(f"no real scenes at {DATA}: see README, 'Real data'")
    return DATA
