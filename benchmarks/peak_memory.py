"""Peak memory of one exact SOS gradient of a 5187x3361 view, the paper's largest.

python -m benchmarks.peak_memory
"""

from __future__ import annotations

import argparse

from benchmarks.common import grainy_photo, parse, write_result
from sgsst_core.budget import peak_memory
from sgsst_core.devices import Timer
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.features.vgg import FeatureNetwork, use_whole_float32
from sgsst_core.loss.sos import SosLoss
from sgsst_core.style import Style

#: Height and width of the view, and gigabytes for activations.
SIZE, MEMORY = (3361, 5187), 5.0


def main() -> None:
    """Measure, print and store. The gradient runs in this process, so the process's peak is that of the gradient."""
    parse(argparse.ArgumentParser(description=__doc__))
    use_whole_float32()
    network = FeatureNetwork(load_network_weights("auto"))
    loss = SosLoss(network, memory=int(MEMORY * 1e9))
    targets = loss.targets.of_style(Style.of(grainy_photo("immunohistochemistry", *SIZE)), SIZE)
    view = loss.targets.of_view(grainy_photo("coffee", *SIZE))
    timer = Timer(network.device)
    with timer("gradient"):
        loss.evaluate(grainy_photo("astronaut", *SIZE), targets, view)
    figures = {
        "width": SIZE[1],
        "height": SIZE[0],
        "backbone": network.name,
        "activation_budget_gb": MEMORY,
        "tiles": len(loss.tiling.tiles(SIZE)),
        "seconds": timer.read()["gradient"],
        "peak_gb": peak_memory() / 1e9,
    }
    print(figures)
    write_result("peak_memory", figures)


if __name__ == "__main__":
    main()
