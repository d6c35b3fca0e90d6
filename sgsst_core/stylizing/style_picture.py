"""The style's pictures as a job uses them: turned, and in the scene's colors, where that is asked."""

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
    """A style, of pictures [H, W, 3] in 0..1, as the settings want it; itself where they want nothing.

    Args:
        sh_dc: [N, 3], of the scene.
        weights: [N] float64, total blend weights, at least one positive.
    """
    if settings.style_rotation:
        style = style.map(lambda picture: turned(picture, settings.style_rotation))
    if settings.preserve_colors == "match":
        # Gatys, Ecker, Bethge, Hertzmann, Shechtman, "Controlling Perceptual Factors in Neural Style Transfer", CVPR
        # 2017, section 5.2.
        style = in_colors_of(style, sh_dc, weights)
    elif settings.preserve_colors == "luminance":
        style = in_luminance_of(style, sh_dc, weights)  # section 5.1 there
    return style


def check_style_size(style: Tensor | StyleMixture, cameras: Sequence[Camera], scale: float) -> None:
    """Prove that no view asks for a style picture [H, W, 3] of more than `MAX_RESOLUTION` pixels on its longer side.

    Args:
        cameras: at the sizes that they are stylized at.
        scale: of its strokes.

    Raises:
        SettingsError: otherwise.
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
                f"{size[1]} x {size[0]}; {MAX_RESOLUTION:,} may be the longer side. Give a smaller scale."
            )


def turned(style: Tensor, degrees: float) -> Tensor:
    """A picture [H, W, 3] turned against the clock, cut to the largest upright rectangle that lies inside.

    By quarters of a turn exactly; otherwise interpolated (cubic splines) and clamped to 0..1.
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
    """Sides of the largest upright rectangle inside one that is turned by an angle between 0 and pi/2; at least 1.

    Either two of its corners lie on one long side of the turned one and it is as long as can be with half of the short
    side above it, or each of its corners lies on another side.
    """
    sine, cosine = math.sin(angle), math.cos(angle)
    shorter, longer = min(height, width), max(height, width)
    if shorter <= 2 * sine * cosine * longer:
        half = shorter / 2
        across, down = (half / sine, half / cosine) if width >= height else (half / cosine, half / sine)
    else:
        spread = cosine * cosine - sine * sine
        across, down = (width * cosine - height * sine) / spread, (height * cosine - width * sine) / spread
    # A pixel less on each side, where the interpolation reaches beyond the picture.
    return max(int(down) - 2, 1), max(int(across) - 2, 1)
