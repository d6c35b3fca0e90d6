"""LPIPS, a learned perceptual distance between two images, as a scalar and as a per-pixel map.

Zhang, Isola, Efros, Shechtman, Wang, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR
2018, equation 1. Features of five layers are scaled to unit length at every position, and

    d(x, y) = sum over layers l of the mean over positions of sum over channels c of w_lc (x_lc - y_lc)^2

with learned weights w >= 0 (version 0.1 of the published weights, which papers report).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.features.network_weights import list_network_weights, load_perceptual

#: Name of the network in reports.
LPIPS_NETWORK = "alex"
#: (stride, padding) of AlexNet's convolutions (Krizhevsky 2014, the one-tower version of torchvision).
_ALEX_CONVOLUTIONS = ((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))
#: Kernel sizes of these convolutions.
_ALEX_KERNELS = (11, 5, 3, 3, 3)
#: Convolutions of AlexNet that follow a 3x3 max pool of stride 2, counted from 1.
_ALEX_POOLED = (2, 3)
#: Minimum length in pixels of the shorter side. On smaller images, the output of the deepest layer is empty.
MIN_SIDE = 31
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
    """LPIPS with AlexNet, which the authors recommend as a metric.

    Args:
        dtype: torch.float32, or torch.float64 for the reference.
        folder: Folder of the weights; None for the cache folder.

    Raises:
        WeightsError: If the weights are missing or corrupt.
    """

    def __init__(
        self,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        folder: Path | None = None,
    ) -> None:
        self.dtype = dtype
        self.device = torch.device(device)
        self._tensors = {name: tensor.to(self.device, dtype) for name, tensor in load_perceptual(folder).items()}
        self._heads = [self._tensors[f"linear{layer}.weight"] for layer in range(1, 6)]

    @torch.no_grad()
    def distance(self, first: Tensor, second: Tensor) -> PerceptualDistance:
        """Compute the distance between two images [H, W, 3] of the same size, with values 0 to 1 in any floating dtype.

        Raises:
            ValueError: If the shapes differ or are not those of images, or a side is shorter than `MIN_SIDE`.
        """
        if first.shape != second.shape or first.ndim != 3 or first.shape[2] != 3:
            raise ValueError(f"LPIPS of shapes {tuple(first.shape)} and {tuple(second.shape)}: two images [H, W, 3]")
        size = (int(first.shape[0]), int(first.shape[1]))
        if min(size) < MIN_SIDE:
            raise ValueError(f"LPIPS of {size[1]} x {size[0]} pixels: {MIN_SIDE} are the least")
        return self.between(self.features(first), self.features(second), size)

    @torch.no_grad()
    def features(self, image: Tensor) -> list[Tensor]:
        """Return the features [h, w, c] of the five layers for an image [H, W, 3] with values 0 to 1.

        The sides of the image must be at least `MIN_SIDE`.
        """
        tensors, outputs = self._tensors, []
        rgb = image.to(self.device, self.dtype)
        x = (rgb * tensors["input_scale"] + tensors["input_shift"]).permute(2, 0, 1).unsqueeze(0)
        for layer, (stride, padding) in enumerate(_ALEX_CONVOLUTIONS, start=1):
            if layer in _ALEX_POOLED:
                x = F.max_pool2d(x, 3, 2)
            weight, bias = tensors[f"conv{layer}.weight"], tensors[f"conv{layer}.bias"]
            x = F.conv2d(x, weight, bias, stride, padding).relu_()
            outputs.append(x[0].permute(1, 2, 0))
        return outputs

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
