"""Tests of hard cases of the GPU kernels, run on a GPU if there is one, otherwise in Triton's interpreter.

The interpreter is about a thousand times slower than a GPU. Cases with thousands of Gaussians are therefore reduced to
hundreds here, and those of extreme views to a hundred; `sgsst bench stability` runs them at full size on a GPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch

from sgsst_core.bench.stability import Case, case
from sgsst_core.bench.stability import gaussian_cases as gaussians
from sgsst_core.bench.stability import view_cases as views
from sgsst_core.bench.stability.case import among_ordinary, camera, compare_rasterizers, repeated
from sgsst_core.scene.gaussians import Scene
from tests.stability.hard_cases import check

pytest.importorskip("triton")
pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # the cases contain non-finite values
    *([pytest.mark.gpu] if torch.cuda.is_available() else []),
]
#: Parts of the names of cases that run in a smaller size below, or that test file readers rather than rasterizers.
SMALLER = ("5000", "thousands", "needles", "4096 x 16", "in the file")


def rendered_cases() -> list[Case]:
    """Return the cases that compare rasterizers, except the large ones."""
    cases = [
        case
        for module in (gaussians, views)
        for case in module.cases()
        if case.measure == gaussians._IMAGE and not any(part in case.name for part in (*SMALLER, *views._VIEWS))
    ]
    assert len(cases) > 20
    return cases


def needles() -> Scene:
    """Return Gaussians at 36 angles in the view, each a million times longer than wide."""
    half = torch.arange(36) * math.pi / 36 / 2
    quats = torch.stack([half.cos(), 0.05 * (3 * half).sin(), torch.zeros(36), half.sin()], dim=1)
    scales = torch.tensor([1e3, 1e-3, 1e-3]).log().repeat(36, 1)
    return replace(repeated(36, logit=-1.0), quats=quats, scales=scales)


def around_the_camera() -> Scene:
    """Return Gaussians that extend to the camera, with centers just behind the near plane and farther away."""
    means = torch.tensor([[0.0, 0.0, 0.21], [0.5, -0.5, 0.3], [-3.0, 2.0, 1.0], [0.0, 1.0, 2.0]])
    sizes = torch.tensor([0.5, 3.0, 30.0, 1e4]).log()
    return replace(repeated(4, logit=-1.0), means=means, scales=sizes[:, None].repeat(1, 3))


SCENES: dict[str, Callable[[], Scene]] = {
    "200 faint Gaussians on one pixel": partial(gaussians._stacked, 200, math.log(1.5 / 253.5)),
    "200 opaque Gaussians on one pixel": partial(gaussians._stacked, 200, 5.0),
    "hundreds of Gaussians smaller than a pixel": lambda: gaussians._sub_pixel().subset(torch.arange(200)),
    "needles": needles,
    "camera inside of Gaussians": around_the_camera,
}


@pytest.fixture(autouse=True)
def triton_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(case, "fast_rasterizers", lambda: ("triton",))


@pytest.mark.parametrize("hard_case", rendered_cases(), ids=lambda hard_case: hard_case.name)
def test_stays_within_its_bound(hard_case: Case) -> None:
    check(hard_case)


@pytest.mark.parametrize("name", SCENES)
def test_smaller_case_stays_within_its_bound(name: str) -> None:
    result = compare_rasterizers(among_ordinary(SCENES[name]()), camera())
    assert result.passed, f"{result.error:.3g}, bound {result.bound:.3g}. {result.note}"


@pytest.mark.parametrize("name", views._VIEWS)
def test_extreme_view_of_a_hundred_gaussians_stays_within_its_bound(name: str) -> None:
    scene, view = views._VIEWS[name]()
    result = compare_rasterizers(scene.subset(torch.arange(min(len(scene), 100))), view)
    assert result.passed, f"{result.error:.3g}, bound {result.bound:.3g}. {result.note}"
