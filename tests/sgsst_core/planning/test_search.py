"""Tests on a simulated GPU that cuDNN's search applies to the steps of a job, whatever has run before them."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

if torch.cuda.is_available():
    pytest.skip("there is a GPU, which does not pretend", allow_module_level=True)

from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.planning.choices import LEAST_PASSES
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.pretend_cuda.interpreter import leave_out_kernels
from tests.pretend_cuda.runtime import pretend_cuda
from tests.small_scenes import cameras, style, wall

pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread")

CUDNN: Any = torch.backends.cudnn


#: Shapes of input and weight, dtype, `deterministic`, and precision of float32.
Key = tuple[tuple[int, ...], tuple[int, ...], torch.dtype, bool, str]


class AlgorithmCache:
    """Stand-in for PyTorch's cache of cuDNN's algorithms, whose key lacks the `benchmark` flag.

    Attributes:
        searched: Whether the cached algorithm was found by a search, by key.
        used: Keys of the convolutions since the last `clear`.
    """

    def __init__(self, convolve: Callable[..., Tensor]) -> None:
        self.searched: dict[Key, bool] = {}
        self.used: set[Key] = set()
        self._convolve = convolve

    def __call__(self, x: Tensor, weight: Tensor, *rest: Any, **options: Any) -> Tensor:
        key = tuple(x.shape), tuple(weight.shape), x.dtype, CUDNN.deterministic, CUDNN.conv.fp32_precision
        self.searched.setdefault(key, CUDNN.benchmark)
        self.used.add(key)
        return self._convolve(x, weight, *rest, **options)


@pytest.fixture
def algorithms(monkeypatch: pytest.MonkeyPatch) -> AlgorithmCache:
    cache = AlgorithmCache(torch.nn.functional.conv2d)
    monkeypatch.setattr(torch.nn.functional, "conv2d", cache)
    leave_out_kernels(monkeypatch)
    return cache


@pytest.mark.parametrize("steps", [LEAST_PASSES, LEAST_PASSES - 1])
def test_steps_use_the_algorithms_that_the_plan_chose(
    algorithms: AlgorithmCache, tiny_weights: BackboneWeights, steps: int
) -> None:
    settings = make_settings(steps_coarse=0, steps_sos=steps, coarsest_side=16, position_weights="off")
    with pretend_cuda():
        stylizer = Stylizer.planned(
            wall(10, 8), cameras(1, 48, 32), style(), settings, weights=tiny_weights, rasterizer="cpu"
        )
        assert stylizer.job.plan.search is (steps == LEAST_PASSES)
        measured = dict(algorithms.searched)
        algorithms.used.clear()
        stylizer.run_step()
    assert {algorithms.searched[key] for key in algorithms.used} == {stylizer.job.plan.search}
    # Measurements at the size of the views have already used them, so that their times are those of the steps.
    assert max(algorithms.used, key=lambda key: math.prod(key[0])) in measured


def test_search_is_not_skipped_for_shapes_of_another_network(
    algorithms: AlgorithmCache, tiny_weights: BackboneWeights
) -> None:
    """Networks of one process share the cache, for example that of a refinement and that of its job."""
    image = torch.rand(32, 48, 3)
    with pretend_cuda():
        FeatureNetwork(tiny_weights, device="cuda").forward(image.to("cuda"))
        network = FeatureNetwork(tiny_weights, device="cuda")
        network.search = True
        algorithms.used.clear()
        network.forward(image.to("cuda"))
    assert {algorithms.searched[key] for key in algorithms.used} == {True}
