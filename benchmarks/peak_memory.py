"""Peak memory of one exact SOS gradient of a 5187x3361 view: the largest of the paper.

python -m benchmarks.peak_memory [--memory 5] [--width 5187] [--height 3361]
"""

from __future__ import annotations

import argparse
import resource
import time

from benchmarks.machine import write_result
from benchmarks.pictures import picture
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.loss.sos import SosLoss


def main() -> None:
    """Measure, print and store; one process, so that the peak is this gradient's."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--memory", type=float, default=5.0, help="GB for activations")
    parser.add_argument("--width", type=int, default=5187)
    parser.add_argument("--height", type=int, default=3361)
    arguments = parser.parse_args()
    size = (arguments.height, arguments.width)
    network = FeatureNetwork(load_network_weights("auto"))
    loss = SosLoss(network, memory=int(arguments.memory * 1e9))
    targets = loss.style_targets(picture("immunohistochemistry", *size), size)
    view = loss.view_target(picture("coffee", *size))
    started = time.perf_counter()
    result = loss.evaluate(picture("astronaut", *size), targets, view)
    seconds = time.perf_counter() - started
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9  # Linux counts in KiB
    tiles = len(loss.tiles(*size))
    print(
        f"{size[1]}x{size[0]}: {tiles} tiles at full size, {seconds:.0f} s, peak {peak:.2f} GB, loss {result.loss:.4g}"
    )
    write_result(
        "peak_memory",
        {
            "width": size[1],
            "height": size[0],
            "backbone": network.name,
            "activation_budget_gb": arguments.memory,
            "tiles": tiles,
            "seconds": seconds,
            "peak_gb": peak,
        },
    )


if __name__ == "__main__":
    main()
