"""Throughput of the feature network's forward and backward pass in TFLOP/s and as a fraction of the device's peak."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from benchmarks.gpu.clock import seconds
from benchmarks.gpu.inputs import network_weights, small_weights
from benchmarks.gpu.part import QUICK, Findings, Sizes, device
from sgsst_core.bench.synthetic import texture
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.features.vgg import STYLE_LAYERS, FeatureNetwork, layer_stride, use_whole_float32

#: Dense TFLOP/s from the data sheets, by substring of the device's name. The PCIe version of the H100 is slower.
PEAKS: dict[str, dict[str, float]] = {
    "H200": {"bfloat16": 989, "tf32": 495, "float32": 67},
    "H100": {"bfloat16": 989, "tf32": 495, "float32": 67},
    "A100": {"bfloat16": 312, "tf32": 156, "float32": 19.5},
}


def run(sizes: Sizes, findings: Findings) -> None:
    """Measure the network on a square image in every available precision."""
    weights = small_weights() if sizes == QUICK else network_weights()
    findings.add("network", f"{weights.name}, {weights.source}")
    findings.add("side", sizes.network)
    use_whole_float32()
    image = texture(sizes.network, sizes.network).to(device())
    exact: dict[str, Tensor] = {}
    for precision, make in precisions(weights).items():
        network = make()
        features = network.forward(image, cache=False).features
        exact = exact or features
        findings.add(f"{precision}/error_of_features", max(_error(features[name], exact[name]) for name in exact))
        for name, action in _passes(network, image).items():
            taken = seconds(action, device(), sizes.repeats)
            rate = flop(weights, sizes.network) * (2 if name == "both" else 1) / taken / 1e12
            findings.add(f"{precision}/{name}", {"seconds": taken, "tflops": rate, "share": share(rate, precision)})
    if "tf32" not in precisions(weights):
        findings.add("tf32", {"skipped": "the feature network has no such precision"})


def precisions(weights: BackboneWeights) -> dict[str, Callable[[], FeatureNetwork]]:
    """Return functions that construct the network, by precision; float32 comes first."""
    variants: dict[str, dict[str, Any]] = {"float32": {}, "bfloat16": {"dtype": torch.bfloat16}}
    if "tf32" in inspect.signature(FeatureNetwork).parameters:
        variants["tf32"] = {"tf32": True}

    def make(options: dict[str, Any]) -> Callable[[], FeatureNetwork]:
        return lambda: FeatureNetwork(weights, STYLE_LAYERS, device=device(), **options)

    return {name: make(options) for name, options in variants.items()}


def _passes(network: FeatureNetwork, image: Tensor) -> dict[str, Callable[[], object]]:
    def add(layer: str, features: Tensor, gradient: Tensor) -> None:
        gradient.add_(features)

    return {
        "forward": lambda: network.forward(image),
        "both": lambda: network.backward(network.forward(image), add),
    }


def flop(weights: BackboneWeights, side: int) -> float:
    """Count the operations of a forward pass over side x side pixels; a backward pass has as many."""
    deepest = layer_stride(STYLE_LAYERS[-1])
    total = 0.0
    for name, (weight, _) in weights.convolutions.items():
        stride = layer_stride(f"relu{name[4:]}")
        if stride < deepest or name == "conv5_1":
            total += 2 * weight.numel() * (side // stride) ** 2
    return total


def share(tflops: float, precision: str) -> float | None:
    """Return the fraction of the device's peak, or None if the peak is unknown."""
    if device().type != "cuda":
        return None
    name = torch.cuda.get_device_name(device())
    known = next((peaks for part, peaks in PEAKS.items() if part in name and "PCIe" not in name), None)
    return tflops / known[precision] if known else None


def _error(actual: Tensor, exact: Tensor) -> float:
    return float((actual.double() - exact.double()).norm() / exact.double().norm())
