"""Throughput of the feature network compared with its convolutions alone, and time of a gradient by part.

python -m benchmarks.network_rate [--size 1024] [--precisions float32 bfloat16] [--repeats 3]

The benchmark uses one scale of a square view. First it runs each convolution separately on an input of the same size,
then the whole gradient including statistics. In both cases, rates count only the convolutions' multiplications and
additions.
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from benchmarks.machine import write_result
from benchmarks.pictures import picture
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.features.vgg import FeatureNetwork, layer_stride
from sgsst_core.loss.sos import SosLoss
from sgsst_core.style import Style

#: Last convolution that the loss needs.
_DEEPEST = "conv5_1"


def main() -> None:
    """Measure, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=1024)
    parser.add_argument("--precisions", nargs="+", default=["float32", "bfloat16"])
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    weights = load_network_weights("auto")
    results = {name: _measure(weights, name, arguments.size, arguments.repeats) for name in arguments.precisions}
    for name, row in results.items():
        alone, network = row["convolutions_gflops"], row["network_gflops"]
        print(
            f"{name}: {network:.0f} of {alone:.0f} GFLOP/s ({row['share']:.0%}), {row['page_faults']} page faults;",
            end=" ",
        )
        print(", ".join(f"{part} {seconds:.3f} s" for part, seconds in row["seconds"].items()))
    write_result("network_rate", {"size": arguments.size, "backbone": weights.name, "precisions": results})


def _measure(weights: BackboneWeights, precision: str, size: int, repeats: int) -> dict[str, Any]:
    dtype = getattr(torch, precision)
    operations, alone = _convolutions_alone(weights, dtype, size, repeats)
    loss = SosLoss(FeatureNetwork(weights, dtype=dtype), memory=1 << 40, coarsest=size)
    style = loss.targets.of_style(Style.of(picture("immunohistochemistry", size, size)), (size, size))
    view, image = loss.targets.of_view(picture("coffee", size, size)), picture("astronaut", size, size)
    best: dict[str, Any] = {}
    for _ in range(repeats):
        loss.timer.clear()
        before, started = resource.getrusage(resource.RUSAGE_SELF), time.perf_counter()
        loss.evaluate(image, style, view)
        seconds = {"gradient": time.perf_counter() - started, **loss.timer.read()}
        faults = resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before.ru_minflt
        if not best or seconds["gradient"] < best["seconds"]["gradient"]:
            best = {"seconds": seconds, "page_faults": faults}
    passes = best["seconds"]["vgg_forward"] + best["seconds"]["vgg_backward"]
    return {
        **best,
        "convolutions_seconds": alone,
        "convolutions_gflops": operations / alone / 1e9,
        "network_gflops": operations / passes / 1e9,
        "share": alone / passes,
    }


@torch.no_grad()
def _convolutions_alone(weights: BackboneWeights, dtype: torch.dtype, size: int, repeats: int) -> tuple[float, float]:
    """Return operations and seconds of a gradient's convolutions, forward and backward, each after a warm-up."""
    operations = seconds = 0.0
    for name, (weight, bias) in weights.convolutions.items():
        out, into = int(weight.shape[0]), int(weight.shape[1])
        side = size // layer_stride(f"relu{name[4:]}")
        forward = weight.to(dtype).contiguous(memory_format=torch.channels_last)
        backward = weight.to(dtype).transpose(0, 1).flip(2, 3).contiguous(memory_format=torch.channels_last)
        x, gradient = _random(into, side, dtype), _random(out, side, dtype)
        seconds += _best(partial(F.conv2d, x, forward, bias.to(dtype), padding=1), repeats)
        seconds += _best(partial(F.conv2d, gradient, backward, padding=1), repeats)
        operations += 2 * 2 * 9 * into * out * side**2
        if name == _DEEPEST:
            break
    return operations, seconds


def _random(channels: int, side: int, dtype: torch.dtype) -> Tensor:
    return torch.randn((1, channels, side, side)).to(dtype).contiguous(memory_format=torch.channels_last)


def _best(action: Callable[[], object], repeats: int) -> float:
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        action()
        times.append(time.perf_counter() - started)
    return min(times)


if __name__ == "__main__":
    main()
