"""Styles: one or several weighted images.

The mean mu and covariance S of a style of several images, with weights w_i, are those of their union:

    mu = sum_i w_i mu_i,  S = sum_i w_i (S_i + (mu_i - mu) (mu_i - mu)^T),  sum_i w_i = 1
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.errors import ImageError, SettingsError

#: Vincent van Gogh, The Starry Night, 1889, which comes with the program: 800x633 JPEG, in the public domain.
STARRY_NIGHT = Path(__file__).parent / "paintings" / "starry_night.jpg"
#: Accepted dtypes of images.
_DTYPES = (torch.uint8, torch.float16, torch.bfloat16, torch.float32, torch.float64)
#: Numbers of channels of gray, RGB and RGBA images.
_CHANNELS = (1, 3, 4)
#: Maximum number of pixels that represent a style.
_PIXELS = 1 << 16
#: Fractional part of the golden ratio; its multiples modulo 1 fill the unit interval evenly.
_GOLDEN = 0.6180339887498949
#: Mean [3] and covariance [3, 3], float64.
Moments = tuple[Tensor, Tensor]


@dataclass(frozen=True)
class Style:
    """Weighted images that are used together as one style.

    Attributes:
        images: Images, [H_i, W_i, 3] in 0..1 each.
        weights: Weights above 0 that add up to 1.
        names: Display names of the images; empty if they have none.
        notes: Parts of the image files that are not used, such as a broken color profile.
    """

    images: tuple[Tensor, ...]
    weights: tuple[float, ...] = (1.0,)
    names: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @staticmethod
    def of(style: Tensor | Style) -> Style:
        """Wrap a single image [H, W, 3] as a style; return a style unchanged."""
        return style if isinstance(style, Style) else Style((style,))

    @staticmethod
    def weighted(images: Sequence[Tensor], weights: Sequence[float], names: Sequence[str] = ()) -> Style:
        """Create a style from weights that need not add up to 1.

        Raises:
            SettingsError: If there are no images, or a weight is not a finite number above 0.
        """
        return Style(tuple(images), normalized(weights), tuple(names))

    @staticmethod
    def given(style: Tensor | NDArray[Any] | Style) -> Style:
        """Check a style that a caller of the library passes, and convert its images; see `image_of`.

        Raises:
            ImageError: If an image cannot be used.
        """
        return style.map(image_of) if isinstance(style, Style) else Style((image_of(style),))

    def map(self, change: Callable[[Tensor], Tensor]) -> Style:
        """Return the style with a function applied to every image, or `self` if no image changes."""
        images = tuple(change(image) for image in self.images)
        if all(new is old for new, old in zip(images, self.images, strict=True)):
            return self
        return replace(self, images=images)

    @property
    def text(self) -> str:
        """Display text: the names, with percentages if there are several images."""
        names = self.names or [f"image {number}" for number in range(1, len(self.images) + 1)]
        if len(names) == 1:
            return names[0]
        shares = zip(names, self.weights, strict=True)
        return ", ".join(f"{name} {share:.0%}" for name, share in shares)


def chosen_positions(count: int, most: int) -> Tensor:
    """Return at most `most` of `count` indices, evenly spread, int64 in ascending order.

    If `count` is at most `most`, all indices are returned. Otherwise the range is divided into `most` equal intervals,
    and one index is taken from each, at a varying offset. With a constant offset, a style with a regular pattern, such
    as stripes, would be sampled at the same phase everywhere. An index may appear twice.
    """
    if count <= most:
        return torch.arange(count)
    part = torch.arange(most, dtype=torch.float64)
    return ((part + (part * _GOLDEN).frac()) * (count / most)).long().clamp_max(count - 1)


def some_pixels(style: Style) -> Tensor:
    """Return evenly spread pixels [n, 3] of a style, in proportion to the weights of its images."""
    parts = []
    for image, weight in zip(style.images, style.weights, strict=True):
        pixels, count = image.reshape(-1, 3), max(1, round(_PIXELS * weight))
        positions = chosen_positions(len(pixels), count)
        if len(style.images) > 1 and len(positions) < count:  # repeat the pixels of a small image
            positions = torch.arange(count) * len(pixels) // count
        parts.append(pixels[positions])
    return torch.cat(parts)


def image_of(values: Tensor | NDArray[Any], name: str = "style image") -> Tensor:
    """Convert an array or tensor to an image as `load_image` returns it: [H, W, 3] float32 in 0..1, on the CPU.

    Args:
        values: Image [H, W], or with 1, 3 or 4 channels that come last or first; sRGB values, uint8 in 0..255 or
            floating point in 0..1. Transparent parts are composited over white.
        name: Name of the image in messages.

    Raises:
        ImageError: If the type, dtype, shape or range differs, or values are NaN.
    """
    if not isinstance(values, Tensor | np.ndarray):
        raise ImageError(
            f"The {name} is a {type(values).__name__}, not a tensor or NumPy array. Read files with `load_image`."
        )
    if isinstance(values, np.ndarray):
        if values.dtype.kind not in "uif":
            raise ImageError(f"The {name} has dtype {values.dtype}. Give uint8 in 0..255 or floats in 0..1.")
        values = torch.from_numpy(np.array(values, values.dtype.newbyteorder("="), order="C"))
    if values.dtype not in _DTYPES:
        raise ImageError(
            f"The {name} has dtype {str(values.dtype).removeprefix('torch.')}. Give uint8 in 0..255 or floats in 0..1."
        )
    values = values.detach() if values.requires_grad else values
    image = _channels_last(values, name).to("cpu", torch.float32)
    image = image if values.dtype.is_floating_point else image / 255
    low, high = (float(value) for value in image.aminmax())
    if math.isnan(low):
        raise ImageError(f"The {name} holds NaN. Use another image.")
    if low < 0 or high > 1:
        raise ImageError(
            f"The {name} has values from {low:.4g} to {high:.4g}, but floats must be in 0..1. Divide values in "
            "0..255 by 255, and clamp others."
        )
    if image.shape[2] == 4:
        image = torch.lerp(torch.ones(()), image[:, :, :3], image[:, :, 3:])
    return (image.expand(-1, -1, 3) if image.shape[2] == 1 else image).contiguous()


def _channels_last(values: Tensor, name: str) -> Tensor:
    """Return an image of 1, 3 or 4 channels as [H, W, channels]."""
    shape = tuple(values.shape)
    if len(shape) == 2:
        values = values[:, :, None]
    elif len(shape) == 3 and shape[2] not in _CHANNELS and shape[0] in _CHANNELS:
        values = values.permute(1, 2, 0)
    if values.ndim != 3 or values.shape[2] not in _CHANNELS or not values.numel():
        raise ImageError(f"The {name} has shape {list(shape)}. Give [H, W, 3] or [3, H, W], without a batch dimension.")
    return values


def normalized(weights: Sequence[float]) -> tuple[float, ...]:
    """Normalize weights of style images so that they add up to 1. A single weight becomes exactly 1.

    Raises:
        SettingsError: If there are no weights, or one is not a finite number above 0.
    """
    if not weights:
        raise SettingsError("There is no style image. Give at least one.")
    for weight in weights:
        if not (math.isfinite(weight) and weight > 0):
            raise SettingsError(
                f"The weight {weight:g} of a style image is not a finite number greater than 0. Change it."
            )
    largest = max(weights)  # dividing by it keeps the sum of finite weights finite
    shares = [weight / largest for weight in weights]
    total = math.fsum(shares)
    return tuple(share / total for share in shares)


def mixed_moments(moments: Sequence[tuple[Tensor, Tensor]], weights: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Compute mean [c] and covariance [c, c] of a mixture from those of its components."""
    if len(moments) == 1:
        return moments[0]
    pairs = list(zip(moments, weights, strict=True))
    mean = torch.stack([weight * own for (own, _), weight in pairs]).sum(dim=0)
    spreads = [weight * (spread + torch.outer(own - mean, own - mean)) for (own, spread), weight in pairs]
    return mean, torch.stack(spreads).sum(dim=0)


def color_moments(colors: Tensor, weights: Tensor | None = None) -> Moments:
    """Return the mean and covariance of colors [n, 3], weighted by [n]; None for equal weights."""
    colors = colors.double()
    weights = colors.new_ones(len(colors)) if weights is None else weights.double()
    total = weights.sum()
    mean = (weights[:, None] * colors).sum(dim=0) / total
    centered = colors - mean
    return mean, (weights[:, None] * centered).T @ centered / total


def style_moments(style: Style) -> Moments:
    """Return the mean and covariance of the pixels of a style; those of several images are mixed."""
    return mixed_moments([color_moments(image.reshape(-1, 3)) for image in style.images], style.weights)


def square_root(matrix: Tensor) -> Tensor:
    """Return the square root of a symmetric matrix that is positive semidefinite up to rounding."""
    values, vectors = torch.linalg.eigh(matrix)
    root: Tensor = vectors * values.clamp_min(0).sqrt() @ vectors.T
    return root
