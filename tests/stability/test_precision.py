"""Tests of hard cases of precision: long sums, half precision, the order of summation."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import get_args

import pytest

from benchmarks.stability import Case, CaseResult, Group, all_cases
from benchmarks.stability import precision_cases as precision
from benchmarks.stability.__main__ import main
from tests.stability.hard_cases import check, parameters

pytestmark = pytest.mark.usefixtures("one_thread", "vgg16_weights")


@pytest.mark.parametrize("case", parameters(precision.cases()), ids=lambda case: case.name)
def test_stays_within_its_bound(case: Case) -> None:
    check(case)


def test_non_finite_errors_do_not_pass() -> None:
    assert CaseResult(1e-6, 1e-6).passed
    for error in (math.nan, math.inf, 2e-6):
        assert not CaseResult(error, 1e-6).passed


def test_case_names_are_unique() -> None:
    names = [case.name for case in all_cases()]
    assert len(names) == len(set(names))
    assert {case.group for case in all_cases()} == set(get_args(Group))


def test_report_has_the_selected_cases(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "found.json"
    assert main(["--quick", "--only", "nan in", "--out", str(out)]) == 0
    cases = json.loads(out.read_text())["cases"]
    assert cases
    assert all("nan in" in case["case"] and case["passed"] for case in cases)
    assert "Numerical stability" in capsys.readouterr().out
    with pytest.raises(SystemExit):
        main(["--only", "no such case"])
    assert "no such case" in capsys.readouterr().err
