"""Tests of hard cases of style and content: no texture, extreme values, channels without variance."""

from __future__ import annotations

import pytest

from benchmarks.stability import Case
from benchmarks.stability import image_cases as images
from tests.stability.hard_cases import check, parameters

pytestmark = pytest.mark.usefixtures("one_thread", "vgg16_weights")


@pytest.mark.parametrize("case", parameters(images.cases()), ids=lambda case: case.name)
def test_stays_within_its_bound(case: Case) -> None:
    check(case)


def test_one_pass_variance_fails_on_a_hard_case() -> None:
    """Show that the case is hard: the usual one-pass formula gives NaN where ours stays within its bound."""
    result = images._ratio(4, False)
    assert result.passed
    lost = int(result.note.split("NaN in ")[1].split()[0])
    assert lost > 0
