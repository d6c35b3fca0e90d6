"""Tests of hard cases of the GPU kernels, run on a GPU if there is one, otherwise in Triton's interpreter.

The interpreter is about a thousand times slower than a GPU. Cases have fewer Gaussians here, but more in a raster tile
than the kernels prepare at once; `make stability` runs them at full size on a GPU.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch

from benchmarks.stability import Case, case
from benchmarks.stability import gaussian_cases as gaussians
from benchmarks.stability import view_cases as views
from benchmarks.stability.case import among_ordinary, camera, compare_rasterizers, repeated
from sgsst_core.scene.gaussians import Scene
from tests.stability.hard_cases import check, parameters

pytest.importorskip("triton")
pytestmark = [
    pytest.mark.usefixtures("one_thread"),
    pytest.mark.filterwarnings("ignore::RuntimeWarning"),  # the cases contain non-finite values
    *([pytest.mark.gpu] if torch.cuda.is_available() else []),
]
#: Ordinary Gaussians beside the extreme ones, and the most Gaussians in an extreme view.
ORDINARY, MOST = 40, 60
#: Parts of the names of cases of many Gaussians, which `SCENES` has in a smaller size, or of many raster tiles.
LARGE = ("5000", "thousands", "4096 x 16")


def is_small(name: str) -> bool:
    return not any(part in name for part in LARGE)


def other_cases() -> list[Case]:
    """Return the cases that compare rasterizers on scenes of their own in memory."""
    cases = [case for case in gaussians.cases() if case.name.endswith("in memory") or case.name.startswith("near")]
    assert len(cases) > 5
    return cases


def needles() -> Scene:
    """Return Gaussians at 20 angles in the view, each a million times longer than wide."""
    half = torch.arange(20) * math.pi / 20 / 2
    quats = torch.stack([half.cos(), 0.05 * (3 * half).sin(), torch.zeros(20), half.sin()], dim=1)
    scales = torch.tensor([1e3, 1e-3, 1e-3]).log().repeat(20, 1)
    return replace(repeated(20, logit=-1.0), quats=quats, scales=scales)


def around_the_camera() -> Scene:
    """Return Gaussians that extend to the camera, with centers just behind the near plane and farther away."""
    means = torch.tensor([[0.0, 0.0, 0.21], [0.5, -0.5, 0.3], [-3.0, 2.0, 1.0], [0.0, 1.0, 2.0]])
    sizes = torch.tensor([0.5, 3.0, 30.0, 1e4]).log()
    return replace(repeated(4, logit=-1.0), means=means, scales=sizes[:, None].repeat(1, 3))


SCENES: dict[str, Callable[[], Scene]] = {
    **{name: make for name, make in gaussians._SCENES.items() if is_small(name)},
    "100 faint Gaussians on one pixel": partial(gaussians._stacked, 100, math.log(1.5 / 253.5)),
    "100 opaque Gaussians on one pixel": partial(gaussians._stacked, 100, 5.0),
    "100 Gaussians smaller than a pixel": lambda: gaussians._sub_pixel().subset(torch.arange(100)),
    "needles": needles,
    "camera inside of Gaussians": around_the_camera,
}


@pytest.fixture(autouse=True)
def triton_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(case, "fast_rasterizers", lambda: ("triton",))


@pytest.mark.parametrize("hard_case", parameters(other_cases()), ids=lambda hard_case: hard_case.name)
def test_stays_within_its_bound(hard_case: Case) -> None:
    check(hard_case)


@pytest.mark.parametrize("name", parameters(list(SCENES)))
def test_scene_stays_within_its_bound(name: str) -> None:
    result = compare_rasterizers(among_ordinary(SCENES[name](), count=ORDINARY), camera())
    assert result.passed, f"{result.error:.3g}, bound {result.bound:.3g}. {result.note}"


@pytest.mark.parametrize("name", parameters([name for name in views._VIEWS if is_small(name)]))
def test_view_stays_within_its_bound(name: str) -> None:
    scene, view = views._VIEWS[name]()
    result = compare_rasterizers(scene.subset(torch.arange(min(len(scene), MOST))), view)
    assert result.passed, f"{result.error:.3g}, bound {result.bound:.3g}. {result.note}"
