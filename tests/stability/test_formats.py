"""Tests of hard cases of compressed scene files and of orbits."""

from __future__ import annotations

import pytest

from benchmarks.stability import Case
from benchmarks.stability import format_cases as formats
from tests.stability.hard_cases import check, parameters

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("case", parameters(formats.cases()), ids=lambda case: case.name)
def test_stays_within_its_bound(case: Case) -> None:
    check(case)
