"""Tests of hard cases of whole jobs: the smallest jobs that use all features."""

from __future__ import annotations

import pytest

from benchmarks.stability import Case
from benchmarks.stability import job_cases as jobs
from tests.stability.hard_cases import check, parameters

pytestmark = pytest.mark.usefixtures("one_thread", "vgg16_weights")


@pytest.mark.parametrize("case", parameters(jobs.cases()), ids=lambda case: case.name)
def test_stays_within_its_bound(case: Case) -> None:
    check(case)
