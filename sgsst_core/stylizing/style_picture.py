"""Preparation of a job's style images: rotation, and matching to the scene's colors."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from scipy import ndimage
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.loss.mixture import StyleMixture
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.pyramid import style_size
from sgsst_core.settings import MAX_RESOLUTION, Settings
from sgsst_core.stylizing.warm_start import in_colors_of, in_luminance_of


def prepared_style(style: StyleMixture, settings: Settings, sh_dc: Tensor, weights: Tensor) -> StyleMixture:
    """Prepare a style as the settings require. If they require nothing, return the style itself.

    Args:
        style: Images [H, W, 3] in 0..1.
        settings: Settings of the job.
        sh_dc: [N, 3], colors of the scene.
        weights: [N] float64, total blend weights, at least one positive.
    """
    if settings.style_rotation:
        style = style.map(lambda picture: turned(picture, settings.style_rotation))
    if settings.preserve_colors == "match":
        # Gatys, Ecker, Bethge, Hertzmann, Shechtman, "Controlling Perceptual Factors in Neural Style Transfer", CVPR
        # 2017, section 5.2.
        style = in_colors_of(style, sh_dc, weights)
    elif settings.preserve_colors == "luminance":
        style = in_luminance_of(style, sh_dc, weights)  # section 5.1 of the same paper
    return style


def check_style_size(style: Tensor | StyleMixture, cameras: Sequence[Camera], scale: float) -> None:
    """Check that no view requires a style image with a longer side of more than `MAX_RESOLUTION` pixels.

    Args:
        style: Image [H, W, 3], or a mixture.
        cameras: Cameras at the sizes used for stylization.
        scale: Scale of the strokes.

    Raises:
        SettingsError: If an image would be larger.
    """
    if scale <= 1:
        return
    pictures = StyleMixture.of(style).pictures
    sizes = {(camera.height, camera.width) for camera in cameras}
    for size, picture in itertools.product(sizes, pictures):
        height, width = style_size((picture.shape[0], picture.shape[1]), size, scale)
        if max(height, width) > MAX_RESOLUTION:
            raise SettingsError(
                f"--style-scale {scale:g} would make the style image {width:,} x {height:,} pixels for views of "
                f"{size[1]} x {size[0]}. Its longer side must be at most {MAX_RESOLUTION:,}. Use a smaller scale."
            )


def turned(style: Tensor, degrees: float) -> Tensor:
    """Rotate an image [H, W, 3] counterclockwise, and crop it to the largest upright rectangle inside.

    Quarter turns are exact. Other angles are interpolated (cubic splines) and clamped to 0..1.
    """
    quarters, rest = divmod(degrees, 90)
    style = torch.rot90(style, int(quarters) % 4, (0, 1)).contiguous()
    if not rest:
        return style
    height, width = style.shape[:2]
    spun = ndimage.rotate(style.double().numpy(), rest, axes=(1, 0), reshape=True, order=3, mode="nearest")
    kept_height, kept_width = _inside(height, width, math.radians(rest))
    top, left = (spun.shape[0] - kept_height) // 2, (spun.shape[1] - kept_width) // 2
    cut = spun[top : top + kept_height, left : left + kept_width]
    return torch.from_numpy(cut).clamp(0, 1).to(style.dtype).contiguous()


def _inside(height: int, width: int, angle: float) -> tuple[int, int]:
    """Return the sides of the largest upright rectangle inside one that is rotated by 0 to pi/2; at least 1.

    If the rotated rectangle is narrow, two corners of the result lie on one of its long sides, and half of its short
    side is the limit. Otherwise, each corner of the result lies on a different side.
    """
    sine, cosine = math.sin(angle), math.cos(angle)
    shorter, longer = min(height, width), max(height, width)
    if shorter <= 2 * sine * cosine * longer:
        half = shorter / 2
        across, down = (half / sine, half / cosine) if width >= height else (half / cosine, half / sine)
    else:
        spread = cosine * cosine - sine * sine
        across, down = (width * cosine - height * sine) / spread, (height * cosine - width * sine) / spread
    # One pixel less on each side, where the interpolation reads beyond the image.
    return max(int(down) - 2, 1), max(int(across) - 2, 1)
