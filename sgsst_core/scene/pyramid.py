"""Image pyramid: exact 2^s x 2^s box averages, and their adjoint."""

from __future__ import annotations

import torch
from torch import Tensor

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
