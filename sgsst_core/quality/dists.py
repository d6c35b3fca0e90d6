"""DISTS, a perceptual distance between two images that tolerates other samples of the same texture.

Ding, Ma, Wang, Simoncelli, "Image Quality Assessment: Unifying Structure and Texture Similarity", IEEE TPAMI 2022. The
image itself and the last ReLU of each of VGG16's five blocks, whose max pooling is replaced by the root of blurred
squares, are compared channel by channel: their means (texture) and their covariance (structure),

    d(x, y) = 1 - sum over channels c of a_c (2 m_x m_y + e) / (m_x^2 + m_y^2 + e)
                                       + b_c (2 s_xy + e) / (s_x^2 + s_y^2 + e)

with learned weights a, b >= 0 whose sum is 1. They come from the authors' package, VGG16 from `sgsst weights fetch`.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.errors import WeightsError
from sgsst_core.features.network_sources import BLOCKS, KAPPA
from sgsst_core.features.network_weights import list_network_weights, load_network_weights

_PACKAGE = "DISTS_pytorch"
#: Channels of the compared layers: the image and VGG16's blocks.
_CHANNELS = (3, 64, 128, 256, 512, 512)
#: Constant e of both terms, and the one below the root of pooled squares.
_EPS, _POOLING_EPS = 1e-6, 1e-12
#: Number of channels that are converted to float64 at a time.
_BLOCK = 16
#: Largest content weight of jobs with VGG16 that can be judged. Others optimize features of the same network.
_LARGEST_CONTENT_WEIGHT = 100.0


class Dists:
    """DISTS network.

    Args:
        dtype: torch.float32, or torch.float64 for the reference.
        device: Device that features are computed on.
        folder: Folder of VGG16's weights; None for the cache folder.

    Raises:
        WeightsError: If the package or VGG16's weights are missing or corrupt, or if the installed VGG16 differs in
            channels from the published one.
    """

    def __init__(
        self,
        *,
        dtype: torch.dtype = torch.float32,
        device: torch.device | str = "cpu",
        folder: Path | None = None,
    ) -> None:
        self.dtype, self.device = dtype, torch.device(device)
        stored = torch.load(_learned_weights(), weights_only=True)
        learned = torch.cat([stored[name].double().flatten() for name in ("alpha", "beta")]).to(self.device)
        means, covariances = (learned / learned.sum()).chunk(2)
        self._means, self._covariances = means.split(_CHANNELS), covariances.split(_CHANNELS)
        weights = load_network_weights("vgg16", folder)
        # Installed weights give features in units of a 0-255 input, published ones in those of a normalized input.
        self._scale, self._shift = (
            (each.double() / KAPPA).to(self.device, dtype)[:, None, None]
            for each in (weights.input_scale, weights.input_shift)
        )
        self._convolutions = {
            layer: (weight.to(self.device, dtype), (bias.double() / KAPPA).to(self.device, dtype))
            for layer, (weight, bias) in weights.convolutions.items()
        }
        widths = [len(self._convolutions[f"conv{block}_1"][1]) for block in range(1, 6)]
        if widths != list(_CHANNELS[1:]):
            raise WeightsError("DISTS needs the published VGG16, and the installed one has other channels.")

    @torch.no_grad()
    def features(self, image: Tensor) -> list[Tensor]:
        """Return the compared layers [c, h, w] of an image [H, W, 3] with values 0 to 1."""
        pixels = image.to(self.device, self.dtype).permute(2, 0, 1)
        layers, hidden = [pixels], pixels * self._scale + self._shift
        for block, count in enumerate(BLOCKS["vgg16"], start=1):
            if block > 1:
                hidden = _pooled(hidden)
            for index in range(1, count + 1):
                hidden = F.conv2d(hidden[None], *self._convolutions[f"conv{block}_{index}"], padding=1)[0].relu_()
            layers.append(hidden)
        return layers

    @torch.no_grad()
    def between(self, first: list[Tensor], second: list[Tensor], coverage: Tensor) -> float:
        """Compute the distance between two images of the same size from their `features`.

        Args:
            first: Features of one image.
            second: Features of the other.
            coverage: Weights [H, W] of the pixels; if all are equal, the distance is the published one.
        """
        similarity, pixels = 0.0, coverage[None].to(self.device, torch.float64)
        for x, y, means, covariances in zip(first, second, self._means, self._covariances, strict=True):
            weights = F.adaptive_avg_pool2d(pixels, (x.shape[1], x.shape[2]))[0].flatten()
            weights = weights / weights.sum()
            for block in range(0, len(x), _BLOCK):
                part = slice(block, block + _BLOCK)
                texture, structure = _similarities(x[part], y[part], weights)
                similarity += float(means[part] @ texture + covariances[part] @ structure)
        return max(1 - similarity, 0.0)


def load_dists_or_none(device: torch.device | str = "cpu", folder: Path | None = None) -> Dists | None:
    """Load DISTS in float32, or return None if its package or the published VGG16 is not installed."""
    installed = any(entry.name == "vgg16" and entry.path for entry in list_network_weights(folder))
    if not installed or not find_spec(_PACKAGE):
        return None
    try:
        return Dists(device=device, folder=folder)
    except WeightsError:  # another network of that name
        return None


def may_judge(network: str, content_weight: float) -> bool:
    """Return whether DISTS is independent of what a job with a feature network and a content weight optimizes."""
    return network != "vgg16" or content_weight <= _LARGEST_CONTENT_WEIGHT


def _learned_weights() -> Path:
    """Return the file of the learned weights, without importing the package, which needs torchvision."""
    package = find_spec(_PACKAGE)
    if package is None or not package.submodule_search_locations:
        raise WeightsError("DISTS is not installed: run `pip install 'sgsst-service[dists]'`.")
    return Path(package.submodule_search_locations[0]) / "weights.pt"


def _pooled(features: Tensor) -> Tensor:
    """Return the root of squares of features [c, h, w], blurred by 1-2-1 and sampled at every second position."""
    line = torch.tensor([0.25, 0.5, 0.25], dtype=features.dtype, device=features.device)
    kernel = torch.outer(line, line).expand(len(features), 1, 3, 3)
    squares = F.conv2d(features.square()[None], kernel, stride=2, padding=1, groups=len(features))[0]
    return (squares + _POOLING_EPS).sqrt_()


def _similarities(x: Tensor, y: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the similarities of means and of centered values of channels [c, h, w], each [c] float64.

    Args:
        x: Features of one image.
        y: Features of the other.
        weights: Position weights [h w] float64 whose sum is 1.
    """
    x, y = (each.flatten(1).double() for each in (x, y))
    mean_x, mean_y = x @ weights, y @ weights
    x, y = x - mean_x[:, None], y - mean_y[:, None]
    texture = (2 * mean_x * mean_y + _EPS) / (mean_x.square() + mean_y.square() + _EPS)
    spread = x.square() @ weights + y.square() @ weights
    return texture, (2 * ((x * y) @ weights) + _EPS) / (spread + _EPS)
