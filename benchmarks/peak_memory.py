"""Peak memory of one exact SOS gradient of a 5187x3361 view, the paper's largest.

python -m benchmarks.peak_memory [--memory 5] [--width 5187] [--height 3361] [--device cuda]
"""

from __future__ import annotations

import argparse

from benchmarks.common import grainy_photo, parse, write_result
from sgsst_core.budget import device_peak, forget_device_peak, peak_memory
from sgsst_core.devices import Timer
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.features.vgg import FeatureNetwork, use_whole_float32
from sgsst_core.loss.sos import SosLoss
from sgsst_core.style import Style


def main() -> None:
    """Measure, print and store. The gradient runs in this process, so the process's peak is that of the gradient."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--memory", type=float, default=5.0, help="GB for activations")
    parser.add_argument("--width", type=int, default=5187)
    parser.add_argument("--height", type=int, default=3361)
    parser.add_argument("--device", default="cpu", choices=("cpu", "cuda"))
    arguments = parse(parser)
    use_whole_float32()
    size = (arguments.height, arguments.width)
    network = FeatureNetwork(load_network_weights("auto"), device=arguments.device)
    loss = SosLoss(network, memory=int(arguments.memory * 1e9))
    targets = loss.targets.of_style(Style.of(grainy_photo("immunohistochemistry", *size)), size)
    view = loss.targets.of_view(grainy_photo("coffee", *size))
    forget_device_peak(network.device)
    timer = Timer(network.device)
    with timer("gradient"):
        result = loss.evaluate(grainy_photo("astronaut", *size), targets, view)
    seconds = timer.read()["gradient"]
    peak = peak_memory() / 1e9
    on_device = device_peak(network.device)
    gpu = f" and {on_device / 1e9:.2f} GB of the GPU's memory" if on_device is not None else ""
    tiles = len(loss.divider.tiles(size))
    print(f"{size[1]}x{size[0]}: {tiles} tiles at full size, {seconds:.3g} s, loss {result.loss:.4g}")
    print(f"peak {peak:.2f} GB{gpu}")
    write_result(
        "peak_memory" if arguments.device == "cpu" else "peak_memory_gpu",
        {
            "width": size[1],
            "height": size[0],
            "backbone": network.name,
            "activation_budget_gb": arguments.memory,
            "tiles": tiles,
            "seconds": seconds,
            "peak_gb": peak,
            "device_peak_gb": on_device / 1e9 if on_device is not None else None,
        },
    )


if __name__ == "__main__":
    main()
