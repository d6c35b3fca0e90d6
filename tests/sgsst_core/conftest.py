"""Fixtures of all tests of the core."""

import pytest
import torch


@pytest.fixture(autouse=True)
def without_matrix_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let plans choose the same precision on every CPU."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", dict[str, bool], raising=False)
