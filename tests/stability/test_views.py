"""Tests of hard cases of views: sizes, fields of view, empty views, and views with too many intersections."""

from __future__ import annotations

import pytest

from benchmarks.stability import Case
from benchmarks.stability import view_cases as views
from tests.stability.hard_cases import check, parameters

pytestmark = pytest.mark.usefixtures("one_thread", "vgg16_weights")


@pytest.mark.parametrize("case", parameters(views.cases()), ids=lambda case: case.name)
def test_stays_within_its_bound(case: Case) -> None:
    check(case)


def test_too_many_intersections_error_names_view_and_remedy() -> None:
    result = next(case for case in views.cases() if "2^31" in case.name).run(False)
    for expected in ("'hard case' (16384x16384)", "2,202,009,600 times", "lower resolution"):
        assert expected in result.note
