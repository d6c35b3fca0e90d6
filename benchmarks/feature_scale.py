"""Feature scale of the paper's network, inferred from published optimization logs, for docs/quality.md.

python -m benchmarks.feature_scale factors PICTURE...
python -m benchmarks.feature_scale log CONTENT STYLE [--scales none,paper,even] [--iterations 50]

`factors` prints for each image and layer by which factor VGG16's features are smaller than the original VGG19's. `log`
repeats the optimization whose loss values Gatys et al. published (Gram weights 1e3 / c^2, content weight 1, L-BFGS
starting from the content image, 512 pixels), with VGG16 at several feature scales. Results are added to
benchmarks/results/feature_scale.json.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.machine import RESULTS, write_result
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.features.vgg import CONTENT_LAYER, STYLE_LAYERS, Activations, FeatureNetwork
from sgsst_core.loss.feature_scale import at_scale, paper_scales

SIDE = 512
GRAM_WEIGHT = 1e3


def main() -> None:
    """Run the command, then print and store its figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    factors = commands.add_parser("factors")
    factors.add_argument("pictures", type=Path, nargs="+")
    log = commands.add_parser("log")
    log.add_argument("content", type=Path)
    log.add_argument("style", type=Path)
    log.add_argument("--scales", default="none,paper,even")
    log.add_argument("--iterations", type=int, default=50)
    arguments = parser.parse_args()
    weights = load_network_weights("vgg16")
    if arguments.command == "factors":
        _store("factors", {picture.name: _print_factors(weights, picture) for picture in arguments.pictures})
        return
    content, style = (_pixels(path) for path in (arguments.content, arguments.style))
    found = {}
    for scale in arguments.scales.split(","):
        network = FeatureNetwork(weights if scale == "none" else at_scale(weights, scale))
        found[scale] = _optimize(network, content, style, arguments.iterations)
        print(f"{scale:6} start {found[scale]['start']:14,.0f} end {found[scale]['end']:14,.0f}", flush=True)
    _store("log", {f"{arguments.content.name}, {arguments.style.name}": {"iterations": arguments.iterations} | found})


def _print_factors(weights: BackboneWeights, picture: Path) -> dict[str, float]:
    found = paper_scales(weights, picture)
    print(f"{picture.name:40}", *(f"{layer} {factor:<5g}" for layer, factor in found.items()), flush=True)
    return found


def _pixels(path: Path) -> Tensor:
    """Load an image [h, w, 3] with values from 0 to 1, resized so that its longer side has `SIDE` pixels."""
    with Image.open(path) as picture:
        width, height = (round(side * SIDE / max(picture.size)) for side in picture.size)
        small = picture.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)
    return torch.from_numpy(np.array(small, dtype=np.float32)) / 255


def _gram(features: Tensor) -> Tensor:
    """Return the Gram matrix [c, c] / (h w) of features [h, w, c]."""
    values = features.flatten(0, 1)
    return values.T @ values / len(values)


def _optimize(network: FeatureNetwork, content: Tensor, style: Tensor, iterations: int) -> dict[str, float]:
    """Run L-BFGS from the content image, on pixel values from 0 to 255, and return the first and the last loss."""
    grams = {layer: _gram(features) for layer, features in _forward(network, style).features.items()}
    kept = _forward(network, content).features[CONTENT_LAYER]
    pixels = (255 * content).clone().requires_grad_()
    optimizer = torch.optim.LBFGS([pixels], max_iter=iterations, max_eval=iterations)
    losses: list[float] = []

    def evaluate() -> Tensor:
        loss, pixels.grad = _loss_and_gradient(network, pixels.detach() / 255, grams, kept)
        losses.append(float(loss))
        return loss

    optimizer.step(evaluate)
    return {"start": losses[0], "end": losses[-1], "evaluations": len(losses)}


def _forward(network: FeatureNetwork, pixels: Tensor, *, keep: bool = False) -> Activations:
    return network.forward(pixels, keep=keep)


def _loss_and_gradient(
    network: FeatureNetwork, pixels: Tensor, grams: dict[str, Tensor], kept: Tensor
) -> tuple[Tensor, Tensor]:
    """Return Gatys' loss of pixels [h, w, 3] from 0 to 1, and its gradient with respect to pixels from 0 to 255."""
    total = torch.zeros((), dtype=torch.float64)

    def add(layer: str, features: Tensor, gradient: Tensor) -> None:
        nonlocal total
        values, into = features.flatten(0, 1), gradient.flatten(0, 1)
        cells, channels = values.shape
        if layer in STYLE_LAYERS:
            difference = _gram(features) - grams[layer]
            total = total + GRAM_WEIGHT / channels**2 * difference.double().square().mean()
            into += values @ difference * (4 * GRAM_WEIGHT / channels**4 / cells)
        if layer == CONTENT_LAYER:
            beside = features - kept
            total = total + beside.double().square().mean()
            gradient += 2 / beside.numel() * beside

    gradient = network.backward(_forward(network, pixels, keep=True), add)
    return total, gradient / 255


def _store(name: str, figures: dict[str, Any]) -> None:
    """Add figures to the result file."""
    path = RESULTS / "feature_scale.json"
    earlier = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    parts = {key: earlier[key] for key in ("factors", "log") if key in earlier}
    write_result("feature_scale", parts | {name: {**parts.get(name, {}), **figures}})


if __name__ == "__main__":
    main()
