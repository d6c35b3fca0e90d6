"""Tests of the feature network's passes: features, PyTorch's flags, fusing, and precisions on a GPU."""

import contextlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.devices import Timer
from sgsst_core.features import vgg
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import FeatureNetwork, convolutions, has_bfloat16, has_tf32, use_whole_float32
from sgsst_core.quality.measure import difference
from tests.sgsst_core import synthetic_images

CUDA = torch.device("cuda")  # only a name: no test needs a GPU
CUDNN: Any = torch.backends.cudnn
SIZE = (50, 37)


def synthetic_image() -> Tensor:
    return torch.rand((*SIZE, 3), generator=torch.Generator().manual_seed(1))


def add(layer: str, features: Tensor, gradient: Tensor) -> None:
    """Add the gradient of the mean square of a layer's features, up to a factor."""
    gradient += features / features.numel()


def pixel_gradient(network: FeatureNetwork) -> Tensor:
    return network.backward(network.forward(synthetic_image()), add)


def test_pass_that_ends_early_returns_the_same_features(tiny_weights: BackboneWeights) -> None:
    network = FeatureNetwork(tiny_weights)
    whole = network.forward(synthetic_image(), cache=False).features
    some = network.forward(synthetic_image(), cache=False, until="relu4_2").features
    assert whole.keys() - some.keys() == {"relu5_1"}
    assert all(torch.equal(whole[layer], features) for layer, features in some.items())


class Watched(FeatureNetwork):
    """Network that records PyTorch's flags during its convolutions."""

    def __init__(self, *arguments: object, **options: object) -> None:
        self.flags: set[tuple[str, bool, bool]] = set()
        super().__init__(*arguments, **options)  # type: ignore[arg-type]

    def _convolve(self, x: Tensor, step: vgg._Convolution) -> Tensor:
        self.flags.add((CUDNN.conv.fp32_precision, CUDNN.benchmark, CUDNN.deterministic))
        return super()._convolve(x, step)

    def _convolve_back(self, gradient: Tensor, step: vgg._Convolution) -> Tensor:
        self.flags.add((CUDNN.conv.fp32_precision, CUDNN.benchmark, CUDNN.deterministic))
        return super()._convolve_back(gradient, step)


# --- flags of cuDNN on a GPU ---------------------------------------------------------------------------------------


@pytest.fixture(autouse=True)
def _flags() -> Iterator[None]:
    cudnn, matmul = CUDNN, torch.backends.cuda.matmul
    before = cudnn.benchmark, cudnn.deterministic, cudnn.allow_tf32, matmul.allow_tf32
    yield
    cudnn.benchmark, cudnn.deterministic, cudnn.allow_tf32, matmul.allow_tf32 = before


def on_a_gpu(device: torch.device, **flags: bool) -> contextlib.AbstractContextManager[None]:
    return convolutions(CUDA, **flags)


@pytest.mark.parametrize("tf32", [False, True])
def test_flags_are_set_only_within_the_network(
    tiny_weights: BackboneWeights, tf32: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The network runs on the CPU, but sets the flags as on a GPU. Statistics are summed in full float32 meanwhile."""
    use_whole_float32()
    network, seen = Watched(tiny_weights, tf32=tf32), set[str]()
    monkeypatch.setattr(vgg, "convolutions", on_a_gpu)
    activations = network.forward(synthetic_image())
    network.backward(activations, lambda *_: seen.add(torch.backends.cuda.matmul.fp32_precision))
    assert seen == {"ieee"}
    assert network.flags == {("tf32" if tf32 else "ieee", False, True)}
    assert not CUDNN.allow_tf32
    assert not CUDNN.deterministic
    assert not torch.backends.cuda.matmul.allow_tf32
    assert network.precision == ("tf32" if tf32 else "float32")


@pytest.mark.parametrize("before", ["ieee", "tf32", "none"])
def test_flags_are_restored_after_an_error(before: str) -> None:
    CUDNN.conv.fp32_precision = before
    with contextlib.suppress(KeyError), convolutions(CUDA, tf32=True):
        assert CUDNN.deterministic
        assert CUDNN.conv.fp32_precision == "tf32"
        raise KeyError
    assert CUDNN.conv.fp32_precision == before
    assert not CUDNN.deterministic


def test_full_float32_overrides_a_global_tf32_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.backends, "fp32_precision", "tf32")
    use_whole_float32()
    assert CUDNN.conv.fp32_precision == torch.backends.cuda.matmul.fp32_precision == "ieee"


@pytest.mark.parametrize(
    ("device", "hip", "capability", "tf32", "bfloat16"),
    [
        ("cuda", None, (9, 0), True, True),
        ("cuda", None, (8, 0), True, True),
        ("cuda", None, (7, 5), False, False),
        ("cuda", "6.4", (9, 4), False, True),
        ("cpu", None, (9, 0), False, True),
    ],
)
def test_tf32_and_bfloat16_depend_on_the_device(
    device: str,
    hip: str | None,
    capability: tuple[int, int],
    tf32: bool,
    bfloat16: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch.version, "hip", hip)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device: capability)
    assert (has_tf32(device), has_bfloat16(device)) == (tf32, bfloat16)


def test_tf32_requires_float32(tiny_weights: BackboneWeights) -> None:
    with pytest.raises(ValueError, match="float32"):
        FeatureNetwork(tiny_weights, dtype=torch.bfloat16, tf32=True)


# --- the fused convolution -----------------------------------------------------------------------------------------


def fused(x: Tensor, weight: Tensor, bias: Tensor, *rest: Any) -> Tensor:
    stride, padding, dilation, groups = rest
    assert (list(stride), list(padding), list(dilation), groups) == ([1, 1], [1, 1], [1, 1], 1)
    return F.conv2d(x, weight, bias, stride, padding, dilation, groups).relu()


def without_bias(x: Tensor, weight: Tensor, bias: Tensor, *rest: Any) -> Tensor:
    return fused(x, weight, torch.zeros_like(bias), *rest)


def in_planes(*arguments: Any) -> Tensor:
    return fused(*arguments).contiguous()


@contextmanager
def operator_on_cpu(does: Callable[..., Tensor]) -> Iterator[list[int]]:
    """Replace cuDNN's operator by `does` on the CPU, and yield a list that gets one entry per call."""
    calls: list[int] = []

    def counted(*arguments: Any) -> Tensor:
        calls.append(1)
        return does(*arguments)

    library = torch.library.Library("aten", "IMPL")
    library.impl("cudnn_convolution_relu", counted, "CPU")
    try:
        yield calls
    finally:
        library._destroy()


def fuse(network: FeatureNetwork) -> set[bool]:
    """Fuse the convolutions that pass a trial, as the constructor of a network on a GPU does."""
    steps = [step for step in network._steps if isinstance(step, vgg._Convolution)]
    for step in steps:
        vgg._try_fusing(step)
    return {step.fused for step in steps}


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_fused_network_is_bit_identical(tiny_weights: BackboneWeights, dtype: torch.dtype) -> None:
    network = FeatureNetwork(tiny_weights, dtype=dtype)
    expected = pixel_gradient(network)
    with operator_on_cpu(fused) as calls:
        assert fuse(network) == {True}
        for _ in range(2):  # the first pass tries the convolutions again, because the image is larger
            calls.clear()
            assert torch.equal(pixel_gradient(network), expected)
            assert len(calls) == sum(isinstance(step, vgg._Convolution) for step in network._steps)


@pytest.mark.parametrize("does", [without_bias, in_planes])
def test_convolutions_with_different_results_are_not_fused(
    tiny_weights: BackboneWeights, does: Callable[..., Tensor]
) -> None:
    with operator_on_cpu(does):
        assert fuse(FeatureNetwork(tiny_weights)) == {False}


def test_tensors_beyond_32_bits_are_not_fused(tiny_weights: BackboneWeights, monkeypatch: pytest.MonkeyPatch) -> None:
    network = FeatureNetwork(tiny_weights)
    with operator_on_cpu(fused) as calls:
        fuse(network)
        calls.clear()
        monkeypatch.setattr(vgg, "_INDEXED_VALUES", SIZE[0] * SIZE[1] * 16)
        network.forward(synthetic_image())
        first_block = 2
        assert len(calls) == sum(isinstance(step, vgg._Convolution) for step in network._steps) - first_block


#: Tests of a GPU against float64 on the CPU.
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU that PyTorch can use")


def gradient_error(weights: BackboneWeights, dtype: torch.dtype = torch.float32, *, tf32: bool = False) -> float:
    """Return the relative error of the image gradient against that of a float64 network on the CPU."""
    use_whole_float32()
    image = synthetic_images.synthetic_image(160, 240)
    exact = FeatureNetwork(weights, dtype=torch.float64)
    tested = FeatureNetwork(weights, dtype=dtype, device="cuda", tf32=tf32)
    gradients = [network.backward(network.forward(image), add).cpu().double() for network in (tested, exact)]
    relative_error, _ = difference(*gradients)
    return relative_error


@pytest.mark.gpu
@needs_gpu
def test_gpu_float32_is_not_rounded_to_tf32(vgg16_weights: BackboneWeights) -> None:
    assert gradient_error(vgg16_weights) < 5e-3


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("tf32", [True, False])
def test_lower_precisions_differ_by_their_rounding(vgg16_weights: BackboneWeights, tf32: bool) -> None:
    if tf32 and not has_tf32("cuda"):
        pytest.skip("this GPU has no TF32")
    error = gradient_error(vgg16_weights, torch.float32 if tf32 else torch.bfloat16, tf32=tf32)
    print(error)
    assert 1e-3 < error < (0.2 if tf32 else 0.8)


@pytest.mark.gpu
@needs_gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
def test_fused_convolutions_have_channels_last(vgg16_weights: BackboneWeights, dtype: torch.dtype) -> None:
    network = FeatureNetwork(vgg16_weights, dtype=dtype, device="cuda")
    activations = network.forward(synthetic_images.synthetic_image(160, 240))
    print({step.layer: step.fused for step in network._steps if isinstance(step, vgg._Convolution)})
    held = [output for output in activations.outputs if output.numel()]
    assert all(output.is_contiguous(memory_format=torch.channels_last) for output in held)


@pytest.mark.gpu
@needs_gpu
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
