"""Training background: a color behind an object scan that is redrawn for every view, so nothing can be fitted to it.

A scan without background covers only part of each image, and features near its silhouette also see what is behind it. A
constant color would become part of what the loss compares, and the object's colors would compensate for it.

A color depends only on the job's seed, the step and the view. There is no random state: repeated and resumed runs are
bit-identical, and all ranks agree.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import torch
from torch import Tensor

from sgsst_core.files.images import Color
from sgsst_core.settings import PlannedBackground
from sgsst_core.style import Style

_BITS = 53  # bits of a float64's fraction


def drawn_color(kind: PlannedBackground, seed: int, step: int, view: int, style: Style) -> Color | None:
    """Return the background color of a view in one step; None for the background of the settings.

    Args:
        kind: "random" for a uniform color, "palette" for the color of a random style pixel.
        seed: Seed of the job, non-negative.
        style: Image [H, W, 3] in 0..1 on the CPU, or a mixture, from which an image is drawn with probability equal to
            its weight.
    """
    if kind == "background":
        return None
    # Three pseudorandom numbers in [0, 1), identical on every machine.
    digest = hashlib.blake2b(f"{seed},{step},{view}".encode(), digest_size=24).digest()
    red, green, blue = ((int.from_bytes(digest[at : at + 8], "big") >> 64 - _BITS) / 2**_BITS for at in (0, 8, 16))
    if kind == "palette":
        index, left = 0, green - style.weights[0]
        while left >= 0 and index + 1 < len(style.images):  # the sum of the weights may be rounded down
            index += 1
            left -= style.weights[index]
        pixels = style.images[index].reshape(-1, 3)
        red, green, blue = pixels[int(red * len(pixels))].tolist()
    return red, green, blue


def replace_background(image: Tensor, coverage: Tensor, color: Sequence[float], present: Sequence[float]) -> Tensor:
    """Replace the background color of an image [h, w, 3]: image + (1 - coverage) (color - present).

    Rendering is linear in the background, and so is the box average: for an image at a scale, use the coverage at that
    scale.

    Args:
        image: [h, w, 3], rendered over the color `present`.
        coverage: [h, w] in 0..1.
        color: [3], new background color.
        present: [3], present background color.
    """
    uncovered = (1 - coverage).to(image.dtype)
    # Scalars are passed as kernel arguments: no copy to the device, and no synchronization.
    channels = zip(image.unbind(-1), color, present, strict=True)
    return torch.stack([channel.add(uncovered, alpha=wanted - old) for channel, wanted, old in channels], dim=-1)
