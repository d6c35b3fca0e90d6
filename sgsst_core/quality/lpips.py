"""LPIPS, a learned perceptual distance between two images, as a scalar and as a per-pixel map.

Zhang, Isola, Efros, Shechtman, Wang, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR
2018, equation 1. Features of five layers are scaled to unit length at every position, and

    d(x, y) = sum over layers l of the mean over positions of sum over channels c of w_lc (x_lc - y_lc)^2

with learned weights w >= 0 (version 0.1 of the published weights, which papers report).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.errors import SettingsError, WeightsError
from sgsst_core.features.network_weights import list_network_weights, load_network_weights, load_perceptual
from sgsst_core.features.vgg import FeatureNetwork, layer_stride

LpipsNetwork = Literal["alex", "vgg16"]

#: Layers that LPIPS compares: the last ReLU of each block.
_VGG16_LAYERS = ("relu1_2", "relu2_2", "relu3_3", "relu4_3", "relu5_3")
#: (stride, padding) of AlexNet's convolutions (Krizhevsky 2014, the one-tower version of torchvision).
_ALEX_CONVOLUTIONS = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))
#: Kernel sizes of these convolutions.
_ALEX_KERNELS = (11, 5, 3, 3, 3)
#: Convolutions of AlexNet that follow a 3x3 max pool of stride 2, counted from 1.
_ALEX_POOLED = (2, 3)
#: Minimum length in pixels of the shorter side. On smaller images, the output of the deepest layer is empty.
_MINIMUM_SIDE = {"alex": 31, "vgg16": layer_stride("relu5_3")}
#: Term added to the length of feature vectors, as in the published code: zero vectors stay zero instead of becoming
#: 0/0.
_LENGTH_EPS = 1e-10


@dataclass(frozen=True)
class PerceptualDistance:
    """LPIPS of two images.

    Attributes:
        mean: LPIPS as published; 0 for equal images.
        map: Distance per pixel [H, W]: each layer's distances upsampled bilinearly and summed over layers (published as
            `spatial`). Its mean differs from `mean` only by the upsampling at the border.
    """

    mean: float
    map: Tensor


class Lpips:
    """LPIPS network.

    Args:
        network: "alex", which the authors recommend as a metric, or "vgg16".
        dtype: torch.float32, or torch.float64 for the reference.
        folder: Folder of the weights; None for the cache folder.

    Raises:
        SettingsError: If the network is unknown.
        WeightsError: If the weights are missing or corrupt, or if the installed VGG16 differs in channels from the
            published one.
    """

    def __init__(
        self,
        network: LpipsNetwork = "alex",
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        folder: Path | None = None,
    ) -> None:
        if network not in _MINIMUM_SIDE:
            raise SettingsError(f"LPIPS has no network called {network!r}: use alex or vgg16.")
        self.network = network
        self.dtype = dtype
        self.device = torch.device(device)
        #: Minimum length in pixels of an image's shorter side.
        self.minimum_side = _MINIMUM_SIDE[network]
        tensors = {name: tensor.to(self.device, dtype) for name, tensor in load_perceptual(network, folder).items()}
        self._heads = [tensors[f"linear{layer}.weight"] for layer in range(1, 6)]
        self._layers: Callable[[Tensor], list[Tensor]] = (
            _alexnet(tensors) if network == "alex" else _vgg16(self._heads, folder, dtype, self.device)
        )

    @torch.no_grad()
    def distance(self, first: Tensor, second: Tensor) -> PerceptualDistance:
        """Compute the distance between two images [H, W, 3] of the same size, with values 0 to 1 in any floating dtype.

        Raises:
            ValueError: If the shapes differ or are not those of images, or a side is shorter than `minimum_side`.
        """
        if first.shape != second.shape or first.ndim != 3 or first.shape[2] != 3:
            raise ValueError(f"LPIPS of shapes {tuple(first.shape)} and {tuple(second.shape)}: two images [H, W, 3]")
        size = (int(first.shape[0]), int(first.shape[1]))
        if min(size) < self.minimum_side:
            raise ValueError(
                f"LPIPS ({self.network}) of {size[1]} x {size[0]} pixels: {self.minimum_side} are the least"
            )
        return self.between(self.features(first), self.features(second), size)

    @torch.no_grad()
    def features(self, image: Tensor) -> list[Tensor]:
        """Return the features [h, w, c] of the five layers for an image [H, W, 3] with values 0 to 1.

        The sides of the image must be at least `minimum_side`.
        """
        return self._layers(image.to(self.device, self.dtype))

    def min_coverage(self, coverage: Tensor) -> list[Tensor]:
        """Return the smallest coverage inside the receptive field of each feature of AlexNet.

        Args:
            coverage: Coverage [H, W] of an image's pixels. Beyond the image's border, nothing counts.

        Returns:
            Minimum [h, w] for each of the five layers, at the positions of `features`.
        """
        hidden, minima = -coverage.to(self.device, self.dtype)[None, None], []
        for layer, (stride, padding) in enumerate(_ALEX_CONVOLUTIONS, start=1):
            if layer in _ALEX_POOLED:
                hidden = F.max_pool2d(hidden, 3, 2)
            hidden = F.max_pool2d(hidden, _ALEX_KERNELS[layer - 1], stride, padding)
            minima.append(-hidden[0, 0])
        return minima

    def between(self, first: list[Tensor], second: list[Tensor], size: tuple[int, int]) -> PerceptualDistance:
        """Compute the distance between two images of size (height, width) from their `features`."""
        mean, spatial = 0.0, torch.zeros(size, dtype=self.dtype, device=self.device)
        for x, y, head in zip(first, second, self._heads, strict=True):
            distances = ((unit_features(x) - unit_features(y)).square_() @ head)[None, None]
            mean += float(distances.mean(dtype=torch.float64))
            spatial += F.interpolate(distances, size=size, mode="bilinear", align_corners=False)[0, 0]
        return PerceptualDistance(mean, spatial)


def load_lpips_or_none(device: torch.device | str = "cpu", folder: Path | None = None) -> Lpips | None:
    """Load LPIPS with AlexNet in float32, or return None if its weights (installed along with VGG16's) are missing.

    Raises:
        WeightsError: If the weights are installed but corrupt.
    """
    installed = any(entry.name == "lpips_alex" and entry.path for entry in list_network_weights(folder))
    return Lpips(device=device, folder=folder) if installed else None


def unit_features(features: Tensor) -> Tensor:
    """Scale features [h, w, c] to unit length at every position."""
    lengths: Tensor = torch.linalg.vector_norm(features, dim=2, keepdim=True)
    return features / (lengths + _LENGTH_EPS)


def _alexnet(tensors: dict[str, Tensor]) -> Callable[[Tensor], list[Tensor]]:
    """Return a function from pixels [H, W, 3] to AlexNet's five ReLU outputs [h, w, c]."""

    def features(rgb: Tensor) -> list[Tensor]:
        x = (rgb * tensors["input_scale"] + tensors["input_shift"]).permute(2, 0, 1).unsqueeze(0)
        outputs = []
        for layer, (stride, padding) in enumerate(_ALEX_CONVOLUTIONS, start=1):
            if layer in _ALEX_POOLED:
                x = F.max_pool2d(x, 3, 2)
            weight, bias = tensors[f"conv{layer}.weight"], tensors[f"conv{layer}.bias"]
            x = F.conv2d(x, weight, bias, stride, padding).relu_()
            outputs.append(x[0].permute(1, 2, 0))
        return outputs

    return features


def _vgg16(
    heads: list[Tensor], folder: Path | None, dtype: torch.dtype, device: torch.device
) -> Callable[[Tensor], list[Tensor]]:
    """Return a function from pixels [H, W, 3] to the output [h, w, c] of the last ReLU of each VGG16 block."""
    network = FeatureNetwork(load_network_weights("vgg16", folder), _VGG16_LAYERS, dtype, device)
    if [network.channels(layer) for layer in _VGG16_LAYERS] != [len(head) for head in heads]:
        raise WeightsError(
            "LPIPS needs the channels of the published VGG16, but the installed one has others. Use the network alex."
        )

    def features(rgb: Tensor) -> list[Tensor]:
        outputs = network.forward(rgb, cache=False).features
        return [outputs[layer] for layer in _VGG16_LAYERS]

    return features
