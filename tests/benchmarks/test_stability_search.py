"""Tests of the random search for unstable jobs: it draws the same jobs on all machines, and reports violated bounds."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from benchmarks.stability import situations
from benchmarks.stability_search import drawn, outcome, search

pytestmark = pytest.mark.usefixtures("one_thread")


def test_job_number_determines_job() -> None:
    first, second = drawn(7), drawn(7)
    assert first.settings == second.settings
    assert torch.equal(first.style, second.style)
    assert torch.equal(first.scene.sh_dc, second.scene.sh_dc)
    assert drawn(8).settings != first.settings


def test_search_counts_outcomes() -> None:
    ended, failures = search(0.0, 3)
    assert sum(ended.values()) == 1
    assert not failures


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "how"),
    [
        (248, "ImageError"),  # feature matching at half size only, with a style one pixel wide
        (3278, "within its bounds"),  # a nearly tied maximum at half size
        (452, "within its bounds"),  # blend weights of some views cached in half precision
        (468, "within its bounds"),  # features that equal their matches except for rounding
        (1262, "within its bounds"),  # content that changed by 500 times its rounding error
        (2768, "within its bounds"),  # content that changed by less than its rounding error
        (691, "within its bounds"),  # pixels that differ by less than the rounding error of the network's input
        (737, "within its bounds"),  # pixels that differ by little more than the rounding error of their mean
        (667, "within its bounds"),  # pixels that differ in their last bit
        (4237, "within its bounds"),  # an image whose features differ from the style's by at most 1 %
        (5810, "within its bounds"),  # a layer whose standard deviation is 1e-4 of its mean
        (7447, "within its bounds"),  # content that changed by 1e4 rounding errors, with a weight of 1e12
        (12096, "within its bounds"),  # all pixels within a range of 4e-7
        (7963, "within its bounds"),  # pixels whose means at half size are rounded by a tenth of their deviation
        (6575, "within its bounds"),  # a black image and a black style
    ],
)
def test_earlier_findings_stay_fixed(number: int, how: str) -> None:
    assert outcome(drawn(number)) == (how, None)


def test_violated_bounds_and_unexpected_errors_are_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"steps_coarse": 0, "steps_sos": 1, "content_weight": 0}  # content has a bound of its own
    style = torch.rand(30, 26, 3, generator=torch.Generator().manual_seed(1))
    job = situations.Situation(situations.crowd(20), style, settings)
    assert outcome(job) == ("within its bounds", None)
    with monkeypatch.context() as patch:
        patch.setattr(situations, "REFERENCE_BOUND", 0.0)
        patch.setattr(situations, "_SAFETY", 0.0)
        how, problem = outcome(job)
        assert how == "broken"
        assert "bound 0" in str(problem)
    how, problem = outcome(replace(job, scene=None))  # type: ignore[arg-type]
    assert how == "broken"
    assert "Error" in str(problem)
