"""Tests of features that need an extra."""

from __future__ import annotations

import sys

import pytest

from service.settings import installed_extras, missing_extras


def test_missing_extra_is_not_offered_and_named_to_the_operator(monkeypatch: pytest.MonkeyPatch) -> None:
    assert installed_extras() == {"video": True, "heif": True}
    assert missing_extras() == []
    monkeypatch.setitem(sys.modules, "av", None)
    assert installed_extras() == {"video": False, "heif": True}
    assert missing_extras() == ["Videos are not offered. To add them: pip install 'sgsst-service[video]'"]
