"""Colors that may change only in some directions (luminance, 0..1, colors of a style), and image pyramids.

Luminance is Y = 0.299 R + 0.587 G + 0.114 B, the luma of YIQ, computed from colors as they are stored and displayed
(gamma-encoded), as in Gatys, Ecker, Bethge, Hertzmann and Shechtman, "Controlling Perceptual Factors in Neural Style
Transfer", CVPR 2017, section 5.1. Adding the same value to all channels of a color does not change its I and Q, which
are its chroma.

A loss on images pushes colors beyond what a screen can show, where viewers clip them and the change is lost. Projecting
each color back after every step is projected gradient descent on a box. Adam scales each channel separately, so
clamping each channel is the exact projection.

The levels of a pyramid are exact 2^s x 2^s box averages.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.settings import Settings
from sgsst_core.style import Style, color_moments, some_pixels

#: Weights of red, green and blue; their sum is 1.
WEIGHTS = (0.299, 0.587, 0.114)
#: Standard deviation along a principal axis of a style's colors, in 0..1, up to which the axis is left out: three of
#: 255 levels, which are hardly visible.
NEGLIGIBLE = 3 / 255
_NEARBY = np.float32((1 - COLOR_OFFSET) / SH_C0)
#: DC coefficients from -LARGEST to LARGEST are colors from 0 to 1: it is the last float32 with a color of at most 1.
LARGEST = float(_NEARBY if COLOR_OFFSET + SH_C0 * float(_NEARBY) <= 1 else np.nextafter(_NEARBY, np.float32(0)))


def luminance(colors: Tensor) -> Tensor:
    """Return the luminance [...] of colors [..., 3], in their dtype."""
    red, green, blue = colors.unbind(-1)
    return WEIGHTS[0] * red + WEIGHTS[1] * green + WEIGHTS[2] * blue


def gray(colors: Tensor) -> Tensor:
    """Return gray colors [..., 3], whose channels all equal the luminance of the given colors."""
    return torch.stack([luminance(colors)] * 3, dim=-1)


def gray_gradient(gradient: Tensor) -> Tensor:
    """Return dL/dcolors [..., 3] from dL/dgray(colors) [..., 3]: the channel sum times the luminance weights."""
    total = gradient.sum(dim=-1)
    return torch.stack([weight * total for weight in WEIGHTS], dim=-1)


def with_chroma_of(colors: Tensor, original: Tensor) -> Tensor:
    """Remove rounding errors from the chroma of colors [n, 3] that differ from `original` only in luminance.

    The difference from the original, averaged over the three channels, is added to each original channel and rounded
    once, so errors of many steps do not accumulate. DC coefficients work too, because colors are linear in them.
    """
    change = (colors.double() - original.double()).mean(dim=-1, keepdim=True)
    return (original.double() + change).to(colors.dtype)


def on_screen(sh_dc: Tensor) -> Tensor:
    """Clamp DC coefficients [n, 3] so that their colors are in 0..1."""
    return sh_dc.clamp(-LARGEST, LARGEST)


def on_screen_by_luminance(sh_dc: Tensor) -> Tensor:
    """Add the smallest gray shift to DC coefficients [n, 3] that brings all channels of their colors into 0..1.

    If the channels differ by more than 1, no shift suffices; they then exceed the range equally on both sides.

    Returns:
        [n, 3], in the dtype of the argument; chroma is preserved up to rounding (`with_chroma_of`).
    """
    lowest, highest = torch.aminmax(sh_dc.double(), dim=1, keepdim=True)
    # Slightly inside the range, so that rounded sums do not leave it again.
    bound = LARGEST * (1 - 1e-6)
    inwards = (-bound - lowest).clamp_min(0) - (highest - bound).clamp_min(0)
    centered = -(lowest + highest) / 2
    return (sh_dc.double() + torch.where(highest - lowest > 2 * bound, centered, inwards)).to(sh_dc.dtype)


@dataclass(frozen=True)
class ColorSubspace:
    """Line or plane in RGB that a style's colors lie on, as an affine map of DC coefficients: c -> c @ matrix + offset.

    The loss cannot tell some hues apart: it compares features that respond to several hues alike, and each channel's
    mean and standard deviation. Patches of yellow and cyan match a black and white woodcut. Projecting colors to the
    line or plane after each step excludes such patches.

    Attributes:
        matrix: [3, 3], orthogonal projection.
        offset: [3].
        dimensions: 1 for a line, 2 for a plane.
        deviation: Largest standard deviation of the style's colors perpendicular to it, in 0..1.
    """

    matrix: Tensor
    offset: Tensor
    dimensions: int
    deviation: float

    @staticmethod
    def of(style: Style) -> "ColorSubspace | None":
        """Return the color subspace of a style; None if its colors vary in all directions, or in none."""
        mean, covariance = color_moments(some_pixels(style))
        variances, axes = torch.linalg.eigh(covariance.cpu())
        deviations = variances.clamp_min(0).sqrt()
        varies = deviations > NEGLIGIBLE
        if varies.all() or not varies.any():
            return None
        matrix = axes[:, varies] @ axes[:, varies].T
        center = (mean.cpu() - COLOR_OFFSET) / SH_C0
        offset = center - center @ matrix
        return ColorSubspace(matrix.float(), offset.float(), int(varies.sum()), float(deviations[~varies].max()))

    def to(self, device: torch.device) -> "ColorSubspace":
        """Return the subspace with its tensors on a device."""
        return replace(self, matrix=self.matrix.to(device), offset=self.offset.to(device))

    def projected(self, sh_dc: Tensor) -> Tensor:
        """Project DC coefficients [n, 3]."""
        return self.along(sh_dc) + self.offset

    def along(self, vectors: Tensor) -> Tensor:
        """Project vectors [n, 3], such as gradients, to the directions of the line or plane.

        Products are added one by one, because matrix products differ between processors in the last bit, and ranks
        must have the same colors.
        """
        red, green, blue = vectors.split(1, dim=1)
        projected: Tensor = red * self.matrix[0] + green * self.matrix[1] + blue * self.matrix[2]
        return projected


def color_subspace_of(styles: Sequence[Style], settings: Settings) -> ColorSubspace | None:
    """Return the color subspace of a job; None if colors are free, or if there are several styles."""
    if len(styles) != 1 or not settings.bounded or settings.preserve_colors != "no":
        return None
    return ColorSubspace.of(styles[0])


#: A style image is downscaled only if it is larger than the view by more than this factor.
STYLE_SIZE_TOLERANCE = 1.1


def downscale(image: Tensor, scale: int) -> Tensor:
    """Box-average an image [H, W] or [H, W, c] over 2^scale x 2^scale blocks, to [H >> scale, W >> scale, ...].

    Rows and columns outside complete blocks are dropped.
    """
    if scale == 0:
        return image
    side = 1 << scale
    height, width = image.shape[0] // side, image.shape[1] // side
    blocks = image[: height * side, : width * side].reshape(height, side, width, side, *image.shape[2:])
    return blocks.mean(dim=(1, 3))


def add_upscaled_(target: Tensor, gradient: Tensor, scale: int, factor: float = 1.0) -> None:
    """Add the adjoint of `downscale` to target in place: each pixel of a block gets 4^-scale of the block's value.

    Args:
        target: [H, W, c], receives factor * downscale^T gradient.
        gradient: [H >> scale, W >> scale, c].
        scale: Scale of the gradient relative to the target.
        factor: Factor of the gradient.
    """
    side = 1 << scale
    height, width = gradient.shape[:2]
    view = target[: height * side, : width * side].unflatten(1, (width, side)).unflatten(0, (height, side))
    view.add_(gradient[:, None, :, None, :], alpha=factor / side**2)


def style_size(style: tuple[int, int], view: tuple[int, int], scale: float = 1.0) -> tuple[int, int]:
    """Return the size (height, width) to which a style image is resized for views of a given size.

    A style whose shorter side is more than 1.1 times the view's is downscaled to the view's shorter side. Its size is
    then multiplied by `scale`, which scales its strokes. With a scale of 1, styles are never enlarged.
    """
    shorter, target = min(style), min(view)
    factor = scale * (1.0 if shorter <= STYLE_SIZE_TOLERANCE * target else target / shorter)
    if factor == 1.0:
        return style
    return max(1, round(style[0] * factor)), max(1, round(style[1] * factor))


def resize_area(image: Tensor, size: tuple[int, int]) -> Tensor:
    """Downscale an image [H, W, 3] to size (height, width) with an antialiasing filter."""
    if (image.shape[0], image.shape[1]) == size:
        return image
    planes = image.permute(2, 0, 1).unsqueeze(0)
    resized = torch.nn.functional.interpolate(planes, size=size, mode="bilinear", antialias=True, align_corners=False)
    return resized[0].permute(1, 2, 0).contiguous()
