"""Scenes, views, images and network weights generated from seeds, so that checks and benchmarks need no files."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.features.network_sources import BLOCKS
from sgsst_core.features.network_weights import BackboneWeights
from sgsst_core.scene.camera import Camera, look_at
from sgsst_core.scene.gaussians import Scene

#: Standard deviation of a Gaussian relative to the distance between neighbors. About thirty Gaussians contribute to
#: each point, as in scans.
_OVERLAP = 1.0
_CHANNELS = (64, 128, 256, 512, 512)


def surface_scene(count: int, degree: int = 0) -> Scene:
    """Return Gaussians on a ball of radius 1, sized to cover it, with opacities like those of scans."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator)

    size = math.log(_OVERLAP * math.sqrt(4 * math.pi / count))
    return Scene(
        means=F.normalize(normal(count, 3), dim=1) * (1 + 0.01 * normal(count, 1)),
        quats=normal(count, 4),
        scales=size + 0.5 * normal(count, 3),
        opacities=-0.5 + 2 * normal(count),
        sh_dc=normal(count, 3),
        sh_rest=0.1 * normal(count, (degree + 1) ** 2 - 1, 3),
    )


def views(count: int, width: int, height: int, zoom: float = 1.0) -> list[Camera]:
    """Return cameras around the ball, which fills most of each view's height; with a zoom of 2.1, whole 3:2 views."""
    up, center = torch.tensor([0.0, -1.0, 0.0]), torch.zeros(3)
    angles = torch.arange(count) * (2 * math.pi / max(count, 1))
    return [
        look_at(
            f"view_{index}", torch.stack([3 * angle.sin(), torch.zeros(()), -3 * angle.cos()]), center, up,
            width=width, height=height, focal=1.3 * height * zoom,
        )
        for index, angle in enumerate(angles)
    ]  # fmt: skip


def texture(height: int, width: int, seed: int = 0) -> Tensor:
    """Return an image [height, width, 3], float32 from 0 to 1, with structure at several scales."""
    generator = torch.Generator().manual_seed(seed)
    planes = torch.zeros((1, 3, height, width))
    for cell, strength in ((64, 0.5), (16, 0.3), (4, 0.2)):
        coarse = torch.rand((1, 3, height // cell + 2, width // cell + 2), generator=generator)
        planes += strength * F.interpolate(coarse, size=(height, width), mode="bilinear", align_corners=False)
    return planes[0].permute(1, 2, 0).contiguous()


def random_weights(name: str = "vgg19", channels: tuple[int, ...] = _CHANNELS) -> BackboneWeights:
    """Return random weights of VGG16 or VGG19, whose blocks have these numbers of channels.

    He initialization preserves the magnitude of features from layer to layer.
    """
    generator = torch.Generator().manual_seed(16)
    layers, before = {}, 3
    for block, (count, after) in enumerate(zip(BLOCKS[name], channels, strict=True), start=1):
        for index in range(1, count + 1):
            weight = torch.randn(after, before, 3, 3, generator=generator) * (2 / (9 * before)) ** 0.5
            layers[f"conv{block}_{index}"] = weight, torch.randn(after, generator=generator)
            before = after
    scale, shift = torch.full((3,), 255.0), torch.full((3,), -120.0)
    return BackboneWeights(name, "random", "", layers, scale, shift)
