"""Tests of hard cases of Gaussians: values that can cause overflow, cancellation or division by zero."""

from __future__ import annotations

import pytest
import torch

from benchmarks.stability import Case
from benchmarks.stability import gaussian_cases as gaussians
from benchmarks.stability.case import camera
from sgsst_core.rasterizer.projection import project
from sgsst_core.rasterizer.reference import splat
from tests.stability.hard_cases import check, parameters

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("case", parameters(gaussians.cases()), ids=lambda case: case.name)
def test_stays_within_its_bound(case: Case) -> None:
    check(case)


def test_opacity_cutoff_is_exact_to_one_ulp() -> None:
    """The fast projection and the reference both skip an opacity one ulp below 1/255, and draw one an ulp above."""
    scene = gaussians._opacities_at_the_cutoff()
    for index, visible in ((0, 0), (2, 1), (3, 1)):
        one = scene.subset(torch.tensor([index]))
        assert len(project(one, camera()).gaussians) == visible
        assert len(splat(one, camera()).gaussians) == visible


def test_gaussians_without_projection_are_dropped() -> None:
    scene = gaussians._scales()
    assert len(project(scene, camera()).gaussians) == len(scene) - 3 == 5
