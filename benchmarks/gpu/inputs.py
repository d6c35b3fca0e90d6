"""Network weights of the benchmark, which needs no files."""

from __future__ import annotations

from sgsst_core.bench.synthetic import random_weights
from sgsst_core.errors import WeightsError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights


def network_weights() -> BackboneWeights:
    """Return the installed weights of VGG19 or VGG16, otherwise random weights of VGG19, which take the same time."""
    try:
        return load_network_weights("auto")
    except WeightsError:
        return random_weights()


def small_weights() -> BackboneWeights:
    """Return random weights of VGG16's layers with 16 channels each, small enough for the interpreter."""
    return random_weights("vgg16", (16,) * 5)
