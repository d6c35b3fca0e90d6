"""Tiny feature networks, which take a negligible fraction of a test's time."""

import functools
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch

from sgsst_core.features.network_weights import BLOCKS, CAFFE_MEAN, BackboneWeights, fetch_network_weights
from sgsst_core.features.vgg import PIXELS
from sgsst_core.features.weight_files import cache_folder

#: Number of channels of every layer.
CHANNELS = 16


@functools.cache
def tiny_weights(name: Literal["vgg16", "vgg19"] = "vgg16") -> BackboneWeights:
    """Return fixed random weights for a network's layers, with `CHANNELS` channels each.

    They are for tests that compare two computations, for which any weights will do.
    """
    return BackboneWeights(
        name=name,
        source="random",
        sha256="0" * 64,
        convolutions=_random_layers(name),
        input_scale=torch.full((3,), 255.0),
        input_shift=-torch.tensor(CAFFE_MEAN),
    )


def comparing_pixels(weights: BackboneWeights, factor: float = 20.0) -> BackboneWeights:
    """Return the same network with the image's pixels as an additional compared layer, multiplied by `factor`."""
    return replace(weights, scales={**weights.scales, PIXELS: factor})


def install_tiny_weights(folder: Path) -> Path:
    """Install `tiny_weights` as vgg16 and the real weights of LPIPS in a folder, for use as `SGSST_CACHE`."""
    file = folder / "narrow.pth"
    state: dict[str, torch.Tensor] = {}
    for name, (weight, bias) in tiny_weights().convolutions.items():
        state |= {f"{name}.weight": weight.flip(1) if name == "conv1_1" else weight, f"{name}.bias": bias}
    torch.save(state, file)
    fetch_network_weights("vgg16", source=file, folder=folder)
    shutil.copy(cache_folder() / "lpips_alex.safetensors", folder)
    return folder


def _random_layers(name: str) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Return random convolutions with He initialization, which preserves the magnitude of features between layers."""
    generator = torch.Generator().manual_seed(16)
    layers, channels = {}, 3
    for block, count in enumerate(BLOCKS[name], start=1):
        for index in range(1, count + 1):
            weight = torch.randn(CHANNELS, channels, 3, 3, generator=generator) * (2 / (9 * channels)) ** 0.5
            layers[f"conv{block}_{index}"] = weight, torch.randn(CHANNELS, generator=generator)
            channels = CHANNELS
    return layers


def flip_a_bit(path: Path) -> None:
    """Flip one bit of a file without changing its size and times, as a faulty disk does."""
    status = path.stat()
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)
    os.utime(path, ns=(status.st_atime_ns, status.st_mtime_ns))
