"""Time and relative error of one SOS gradient of a 2048x2048 view, compared with the published block method.

python -m benchmarks.sos_gradient [--size 2048] [--repeats 3]
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.block_method import block_gradient
from benchmarks.machine import write_result
from benchmarks.pictures import grainy_photo
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.style import Style

#: Memory limit in bytes: enough to cache the activations of a 2048x2048 view, 1.3 KB per pixel in float32.
MEMORY = 12 << 30


def main() -> None:
    """Measure, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=2048)
    parser.add_argument("--repeats", type=int, default=3)
    arguments = parser.parse_args()
    size = arguments.size
    image, content = grainy_photo("astronaut", size, size), grainy_photo("coffee", size, size)
    style_image = grainy_photo("immunohistochemistry", size, size)
    weights = load_network_weights("auto")
    methods: dict[str, Callable[[], Tensor]] = {}

    exact = FeatureNetwork(weights)
    targets = SosLoss(exact, memory=MEMORY).targets.of_style(Style.of(style_image), (size, size))
    methods["blocks, float32"] = lambda: block_gradient(exact, image, targets, content)
    for precision in ("float32", "bfloat16"):
        loss = SosLoss(FeatureNetwork(weights, dtype=getattr(torch, precision)), memory=MEMORY)
        own_targets = loss.targets.of_style(Style.of(style_image), (size, size))
        view = loss.targets.of_view(content)

        def ours(loss=loss, own_targets=own_targets, view=view) -> Tensor:
            gradient = loss.evaluate(image, own_targets, view).image_gradient
            assert gradient is not None
            return gradient

        methods[f"ours, {precision}"] = ours

    gradients: dict[str, Tensor] = {}
    seconds: dict[str, list[float]] = {name: [] for name in methods}
    for _ in range(arguments.repeats):  # in turn, so that a slow phase of the machine affects all methods
        for name, method in methods.items():
            started = time.perf_counter()
            gradients[name] = method()
            seconds[name].append(time.perf_counter() - started)
    reference = gradients["ours, float32"].double()
    rows = {}
    for name, times in seconds.items():
        difference = gradients[name].double() - reference
        ratios = [base / own for base, own in zip(seconds["blocks, float32"], times, strict=True)]
        rows[name] = {
            "seconds": times,
            "times_faster_than_blocks": statistics.median(ratios),
            "relative_error_to_ours_float32": float(difference.norm() / reference.norm()),
        }
        print(
            f"{name:18s} {statistics.median(times):8.2f} s  {rows[name]['times_faster_than_blocks']:6.2f} x  "
            f"relative error {rows[name]['relative_error_to_ours_float32']:.2e}"
        )
    write_result("sos_gradient", {"size": size, "backbone": weights.name, "methods": rows})


if __name__ == "__main__":
    main()
