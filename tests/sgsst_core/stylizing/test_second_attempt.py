"""Tests on a simulated GPU of a job that runs out of memory: it continues with smaller partition tiles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch import Tensor

if torch.cuda.is_available():
    pytest.skip("there is a GPU, which does not pretend", allow_module_level=True)

from sgsst_core.errors import DeviceMemoryError
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.settings import make_settings
from sgsst_core.stylizing.stylizer import Stylizer
from tests.pretend_cuda.interpreter import leave_out_kernels
from tests.pretend_cuda.runtime import pretend_cuda
from tests.small_scenes import cameras, style, wall

pytest.importorskip("triton")
pytestmark = pytest.mark.usefixtures("one_thread")

#: A view has 64 x 320 pixels; the largest of its tiles has 64 x 192, including halos.
WIDTH, HEIGHT, TILE = 320, 64, 192


class Memory:
    """Memory of the simulated GPU, with space for the activations of this many pixels."""

    def __init__(self) -> None:
        self.pixels = 1 << 30
        self.failures = 0

    def check(self, x: Tensor) -> None:
        if x.shape[2] * x.shape[3] > self.pixels:
            self.failures += 1
            raise torch.OutOfMemoryError("CUDA out of memory.")


@pytest.fixture
def memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[Memory]:
    simulated, convolve = Memory(), FeatureNetwork._convolve

    def convolve_within(network: FeatureNetwork, x: Tensor, step: Any) -> Tensor:
        simulated.check(x)
        return convolve(network, x, step)

    leave_out_kernels(monkeypatch)
    monkeypatch.setattr(FeatureNetwork, "_convolve", convolve_within)
    with pretend_cuda():
        yield simulated


def planned(weights: BackboneWeights, **values: Any) -> Stylizer:
    values = {"coarsest_side": 16, "position_weights": "off", "scale_sampling": 1, "precision": "float32", **values}
    settings = make_settings(steps_coarse=0, steps_sos=3, **values)
    return Stylizer.planned(
        wall(10, 8), cameras(1, WIDTH, HEIGHT), style(), settings, weights=weights, rasterizer="cpu"
    )


def test_job_continues_with_half_of_its_activations(memory: Memory, tiny_weights: BackboneWeights) -> None:
    expected, actual = planned(tiny_weights), planned(tiny_weights)
    assert len(expected.job.loss.tiling.tiles((HEIGHT, WIDTH))) == 1
    for step in range(3):
        memory.pixels = 1 << 30
        loss = expected.run_step().loss
        if step:
            memory.pixels = TILE * HEIGHT
        assert actual.run_step().loss == pytest.approx(loss, rel=1e-4)
    assert memory.failures == 1
    assert len(actual.job.loss.tiling.tiles((HEIGHT, WIDTH))) > 1
    assert actual.step == 3
    torch.testing.assert_close(actual.sh_dc.cpu(), expected.sh_dc.cpu(), rtol=1e-3, atol=1e-4)


def test_too_little_memory_is_a_clear_error(memory: Memory, tiny_weights: BackboneWeights) -> None:
    stylizer = planned(tiny_weights)
    before, memory.pixels = stylizer.sh_dc.cpu().clone(), 100
    with pytest.raises(DeviceMemoryError, match=r"not even with half .* smaller --memory-limit than 105\.2 GB"):
        stylizer.run_step()
    assert memory.failures == 2
    assert stylizer.step == 0
    assert torch.equal(stylizer.sh_dc.cpu(), before)
