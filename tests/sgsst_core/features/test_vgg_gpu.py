"""Tests of the feature network on a GPU against float64 on the CPU.

Their counterparts without a GPU are in test_vgg and test_devices.
"""

import pytest
import torch
from torch import Tensor

from sgsst_core.devices import Timer
from sgsst_core.features import vgg
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork, has_tf32, use_whole_float32
from sgsst_core.quality.measure import Difference
from tests.sgsst_core.synthetic_images import synthetic_image

HAS_GPU = torch.cuda.is_available()
pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not HAS_GPU, reason="no GPU that PyTorch can use")]
SIZE = (160, 240)


def add(layer: str, features: Tensor, gradient: Tensor) -> None:
    gradient += features / features.numel()


def difference(weights: BackboneWeights, dtype: torch.dtype = torch.float32, *, tf32: bool = False) -> Difference:
    """Compare the image gradient with that of a float64 network on the CPU."""
    use_whole_float32()
    image = synthetic_image(*SIZE)
    exact = FeatureNetwork(weights, dtype=torch.float64)
    tested = FeatureNetwork(weights, dtype=dtype, device="cuda", tf32=tf32)
    gradients = [network.backward(network.forward(image), add).cpu().double() for network in (tested, exact)]
    return Difference.of(*gradients)


def test_gpu_float32_is_not_rounded_to_tf32(vgg16_weights: BackboneWeights) -> None:
    assert difference(vgg16_weights).relative_error < 5e-3


@pytest.mark.parametrize("tf32", [True, False])
def test_lower_precisions_differ_by_their_rounding(vgg16_weights: BackboneWeights, tf32: bool) -> None:
    if tf32 and not has_tf32("cuda"):
        pytest.skip("this GPU has no TF32")
    error = difference(vgg16_weights, torch.float32 if tf32 else torch.bfloat16, tf32=tf32)
    print(error)
    assert 1e-3 < error.relative_error < (0.2 if tf32 else 0.8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_fused_convolutions_have_channels_last(vgg16_weights: BackboneWeights, dtype: torch.dtype) -> None:
    network = FeatureNetwork(vgg16_weights, dtype=dtype, device="cuda")
    activations = network.forward(synthetic_image(*SIZE))
    print({step.layer: step.fused for step in network._steps if isinstance(step, vgg._Convolution)})
    held = [output for output in activations.outputs if output.numel()]
    assert all(output.is_contiguous(memory_format=torch.channels_last) for output in held)


def test_events_time_the_work_of_the_device() -> None:
    timer = Timer("cuda")
    matrix = torch.randn(4096, 4096, device="cuda")
    with timer("whole"):
        for _ in range(8):
            with timer("part"):
                matrix = (matrix @ matrix).clamp_(-1, 1)
    torch.cuda.synchronize()
    assert timer.read().keys() == {"whole", "part"}
    assert all(seconds > 0 for seconds in timer.seconds.values())
