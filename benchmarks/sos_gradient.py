"""Time and relative error of one SOS gradient of a 2048x2048 view, compared with the published block method.

python -m benchmarks.sos_gradient

The published block method (SPST as released with SGSST) is reimplemented here as a baseline. Blocks of 512 px with a
margin of 256 px go through the network twice: once for statistics, once for back-propagation. The loss acts on all
features of a block and its margin; the gradient of the margin is discarded afterwards. Content features are recomputed
in every iteration. The baseline uses this project's network code, so that only the method differs.
"""

import argparse
import time
from collections.abc import Callable
from functools import reduce

import torch
from torch import Tensor

from benchmarks.common import grainy_photo, parse, write_result
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.features.partition import PartitionTile, Rectangle
from sgsst_core.features.statistics import layer_statistics, merge
from sgsst_core.features.vgg import CONTENT_LAYER, STYLE_LAYERS, FeatureNetwork
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import StyleTarget, StyleTargets, content_factor, content_gradient, style_loss
from sgsst_core.scales import scale_count
from sgsst_core.scene.colors import add_upscaled_, downscale
from sgsst_core.style import Style

#: Memory limit in bytes: enough to cache the activations of a 2048x2048 view, 1.3 KB per pixel in float32.
MEMORY = 12 << 30
SIZE = 2048


def main() -> None:
    """Measure, then print and store the figures."""
    parse(argparse.ArgumentParser(description=__doc__))
    image, content, style_image = (
        grainy_photo(name, SIZE, SIZE) for name in ("astronaut", "coffee", "immunohistochemistry")
    )
    weights = load_network_weights("auto")
    methods: dict[str, Callable[[], Tensor]] = {}

    exact = FeatureNetwork(weights)
    targets = SosLoss(exact, memory=MEMORY).targets.of_style(Style.of(style_image), (SIZE, SIZE))
    methods["blocks, float32"] = lambda: block_gradient(exact, image, targets, content)
    for precision in ("float32", "winograd"):
        loss = SosLoss(FeatureNetwork(weights, winograd=precision == "winograd"), memory=MEMORY)
        own_targets = loss.targets.of_style(Style.of(style_image), (SIZE, SIZE))
        view = loss.targets.of_view(content)

        def ours(loss=loss, own_targets=own_targets, view=view) -> Tensor:
            gradient = loss.evaluate(image, own_targets, view).image_gradient
            assert gradient is not None
            return gradient

        methods[f"ours, {precision}"] = ours

    gradients: dict[str, Tensor] = {}
    seconds: dict[str, float] = {}
    for name, method in methods.items():
        started = time.perf_counter()
        gradients[name] = method()
        seconds[name] = time.perf_counter() - started
    reference = gradients["ours, float32"].double()
    rows = {}
    for name, gradient in gradients.items():
        rows[name] = {
            "seconds": seconds[name],
            "times_faster_than_blocks": seconds["blocks, float32"] / seconds[name],
            "relative_error_to_ours_float32": float((gradient.double() - reference).norm() / reference.norm()),
        }
        print(name, rows[name], flush=True)
    write_result("sos_gradient", {"size": SIZE, "backbone": weights.name, "methods": rows})


BLOCK = 512
MARGIN = 256


def blocks(height: int, width: int) -> list[PartitionTile]:
    """Return the blocks with their margins, clipped to the view."""
    return [
        PartitionTile(
            Rectangle(top, left, min(top + BLOCK, height), min(left + BLOCK, width)),
            Rectangle(
                max(top - MARGIN, 0),
                max(left - MARGIN, 0),
                min(top + BLOCK + MARGIN, height),
                min(left + BLOCK + MARGIN, width),
            ),
        )
        for top in range(0, height, BLOCK)
        for left in range(0, width, BLOCK)
    ]


def block_gradient(network: FeatureNetwork, image: Tensor, style: StyleTargets, content: Tensor) -> Tensor:
    """Compute the gradient [H, W, 3] of the SOS loss with lambda_c = 1, for image and content image [H, W, 3]."""
    scales = range(scale_count(image.shape[0], image.shape[1]))
    total = torch.zeros(image.shape)
    for scale in scales:
        gradient = _scale(network, downscale(image, scale), style[scale][0], downscale(content, scale))
        add_upscaled_(total, gradient, scale, 1 / len(scales))
    return total


def _scale(network: FeatureNetwork, image: Tensor, style: StyleTarget, content: Tensor) -> Tensor:
    size = (image.shape[0], image.shape[1])
    tiles = blocks(*size)
    parts: dict[str, list] = {layer: [] for layer in STYLE_LAYERS}
    for tile in tiles:  # first forward: statistics
        features = network.forward(image[tile.outer.slices], cache=False).features
        for layer in STYLE_LAYERS:
            parts[layer].append(layer_statistics(features[layer][tile.owned_cells(layer, size)[1].slices]))
    maps = {layer: style_loss(reduce(merge, parts[layer]), style.layers[layer])[1] for layer in STYLE_LAYERS}
    cells = torch.tensor(float((size[0] // 8) * (size[1] // 8)), dtype=torch.float64)
    result = torch.zeros_like(image)
    for tile in tiles:
        wanted = network.forward(content[tile.outer.slices], cache=False).features[CONTENT_LAYER]  # content forward
        activations = network.forward(image[tile.outer.slices])  # second forward

        def pull(layer: str, features: Tensor, so_far: Tensor, wanted: Tensor = wanted) -> None:
            if layer == CONTENT_LAYER:
                so_far += content_gradient(features, wanted, None, content_factor(cells, features.shape[-1], 1.0))
            else:
                maps[layer].add_to(so_far, features)

        gradient = network.backward(activations, pull)
        inner = Rectangle(
            tile.inner.top - tile.outer.top,
            tile.inner.left - tile.outer.left,
            tile.inner.bottom - tile.outer.top,
            tile.inner.right - tile.outer.left,
        )
        result[tile.inner.slices] = gradient[inner.slices]
    return result


if __name__ == "__main__":
    main()
