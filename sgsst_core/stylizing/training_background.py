"""What lies behind an object scan in a step: a color drawn anew for every view, which nothing can be fitted to.

A scan without background covers a part of each picture, and features near its silhouette see what is behind it too. A
color that never changes is part of what the loss judges, and the object's colors come to make up for it.

A color follows from the job's seed, the step and the view alone: there is no state, a run repeats and resumes bit for
bit, and all ranks agree.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch
from torch import Tensor

from sgsst_core.loss.mixture import StyleMixture
from sgsst_core.settings import PlannedBackground

#: Red, green, blue in 0..1.
Color = tuple[float, float, float]

_BITS = 53  # of a float64's fraction


def drawn_color(kind: PlannedBackground, seed: int, step: int, view: int, style: Tensor | StyleMixture) -> Color | None:
    """What is behind a view in the step after `step` others; None for the background of the settings.

    Args:
        kind: "random" for a uniform color, "palette" for that of a random pixel of the style.
        seed: of the job, not negative.
        view: index of its camera.
        style: pictures [H, W, 3] in 0..1, on the CPU; of several, one is drawn by its weight.
    """
    if kind == "background":
        return None
    red, green, blue = _uniform(seed, step, view)
    if kind == "palette":
        pixels = _drawn_picture(StyleMixture.of(style), green).reshape(-1, 3)
        red, green, blue = pixels[int(red * len(pixels))].tolist()
    return red, green, blue


def _drawn_picture(style: StyleMixture, number: float) -> Tensor:
    """One of the pictures, by their weights and a number in [0, 1)."""
    for picture, weight in zip(style.pictures, style.weights, strict=True):
        number -= weight
        if number < 0:
            return picture
    return style.pictures[-1]  # the weights' sum may be rounded down


def _uniform(*numbers: int) -> Color:
    """Three numbers in [0, 1) that look random; the same for the same numbers on every machine."""
    digest = hashlib.blake2b(",".join(map(str, numbers)).encode(), digest_size=24).digest()
    first, second, third = (int.from_bytes(digest[place : place + 8], "big") >> 64 - _BITS for place in (0, 8, 16))
    return first / 2**_BITS, second / 2**_BITS, third / 2**_BITS


def put_behind(image: Tensor, coverage: Tensor, color: Sequence[float], present: Sequence[float]) -> Tensor:
    """Image [h, w, 3] of Gaussians with another color behind them: image + (1 - coverage) (color - present).

    Rendering is linear in what lies behind, and so is the box average: an image at a scale takes the coverage at it.

    Args:
        coverage: [h, w] in 0..1.
        color: [3], that is wanted.
        present: [3], that the image has behind.
    """
    uncovered = (1 - coverage).to(image.dtype)
    # Numbers travel with the kernels that they belong to: a device has neither a copy to make nor to be waited for.
    channels = zip(image.unbind(-1), color, present, strict=True)
    return torch.stack([channel.add(uncovered, alpha=wanted - old) for channel, wanted, old in channels], dim=-1)
