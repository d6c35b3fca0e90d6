"""Every convolution of the network by direction, precision and memory layout, in TFLOP/s."""

from __future__ import annotations

import torch

from benchmarks.gpu.clock import seconds
from benchmarks.gpu.inputs import network_weights, small_weights
from benchmarks.gpu.part import QUICK, Findings, Sizes, device
from sgsst_core.features.vgg import convolutions, has_bfloat16, has_tf32, layer_stride

_LAYOUTS = {"channels_last": torch.channels_last, "planes": torch.contiguous_format}
#: Repetitions of each convolution.
_REPEATS = 3


def run(sizes: Sizes, findings: Findings) -> None:
    """Measure the layers from the largest to the smallest; layers of the same shape only once."""
    quick = sizes == QUICK
    weights, (width, height) = small_weights() if quick else network_weights(), sizes.view
    available = {"bfloat16": has_bfloat16(device()), "tf32": has_tf32(device()), "float32": True}
    measured: set[tuple[int, ...]] = set()
    for name, (weight, _) in weights.convolutions.items():
        stride = layer_stride(f"relu{name[4:]}")
        shape = (stride, *weight.shape[:2])
        if shape in measured:
            continue
        measured.add(shape)
        for precision in (precision for precision, there in available.items() if there):
            for direction in ("forward", "backward"):
                rates = _rates(weight, (height // stride, width // stride), precision, direction)
                findings.add(f"{name}/{precision}/{direction}", rates)


def _rates(weight: torch.Tensor, size: tuple[int, int], precision: str, direction: str) -> dict[str, float]:
    """Return TFLOP/s by layout."""
    dtype, rates = torch.bfloat16 if precision == "bfloat16" else torch.float32, {}
    kernel = weight if direction == "forward" else weight.transpose(0, 1).flip(2, 3)
    flop = 2 * weight.numel() * size[0] * size[1]
    for layout, memory_format in _LAYOUTS.items():
        x = (
            torch.rand((1, int(kernel.shape[1]), *size), device=device())
            .to(dtype)
            .contiguous(memory_format=memory_format)
        )
        own = kernel.to(device(), dtype).contiguous(memory_format=memory_format)
        with convolutions(device(), tf32=precision == "tf32"), torch.no_grad():
            taken = seconds(lambda x=x, own=own: torch.nn.functional.conv2d(x, own, padding=1), device(), _REPEATS)  # type: ignore[misc]
        rates[layout] = flop / taken / 1e12
    return rates
