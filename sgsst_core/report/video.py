"""Videos of a scene along a camera path, optionally with a transition from the unstylized scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sgsst_core.files.video import VideoFrame
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors

#: Transition from the unstylized to the stylized scene: a vertical line that moves to the right, or a cross-fade.
Transition = Literal["wipe", "fade"]
#: Fraction of a video before the transition, and after it.
_HOLD = 0.15
#: Alpha below which a pixel rounds to transparent; its color is then black instead of amplified rounding errors.
_INVISIBLE = 0.5 / 255


@dataclass(frozen=True)
class Layer:
    """Scene with its rasterizer; scenes that only differ in their colors can share one.

    With an alpha channel, the rasterizer's background must be black.
    """

    scene: Scene
    rasterizer: Rasterizer = field(repr=False)

    def image(self, camera: Camera, *, alpha: bool) -> Tensor:
        """Return the image [h, w, 3] float32; with alpha [h, w, 4], with premultiplied colors."""
        colors = scene_colors(self.scene, camera, self.rasterizer.device)
        image = self.rasterizer.render(colors, camera).to("cpu", torch.float32)
        if not alpha:
            return image.clamp(0, 1)
        coverage = self.rasterizer.coverage(camera).to("cpu", torch.float32).clamp(0, 1)
        return torch.cat([torch.minimum(image.clamp_min(0), coverage[:, :, None]), coverage[:, :, None]], dim=2)


def write_frames(
    write: Callable[[VideoFrame], None],
    layer: Layer,
    cameras: Sequence[Camera],
    *,
    unstylized: Layer | None = None,
    transition: Transition = "wipe",
    alpha: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> None:
    """Render the frames of a video, one per camera. One frame is in memory at a time.

    Args:
        write: Function that appends a frame to the video; see `sgsst_core.files.video.video_writer`.
        cameras: Cameras of one size, one per frame.
        unstylized: Scene at the start of the transition; None for no transition.
        progress: Callback that receives the numbers of completed and of all frames.
    """
    for index, camera in enumerate(cameras):
        fraction = 1.0 if unstylized is None else shown_fraction(index / max(len(cameras) - 1, 1))
        if unstylized is None or fraction == 1:
            image = layer.image(camera, alpha=alpha)
        elif fraction == 0:
            image = unstylized.image(camera, alpha=alpha)
        else:
            before, after = unstylized.image(camera, alpha=alpha), layer.image(camera, alpha=alpha)
            line = round(fraction * before.shape[1])
            wiped = torch.cat([after[:, :line], before[:, line:]], dim=1)
            image = wiped if transition == "wipe" else torch.lerp(before, after, fraction)
        write(_to_bytes(image))
        progress(index + 1, len(cameras))


def shown_fraction(time: float) -> float:
    """Return how much of the stylized scene a transition shows, in 0..1, at a time in 0..1 of the video.

    It is smooth, and holds both ends for 15 % of the video.
    """
    x = min(max((time - _HOLD) / (1 - 2 * _HOLD), 0.0), 1.0)
    return x * x * (3 - 2 * x)


def _to_bytes(image: Tensor) -> VideoFrame:
    """Return an image [h, w, 3], or [h, w, 4] with premultiplied colors, as a frame with straight alpha."""
    if image.shape[2] == 4:
        alpha = image[:, :, 3:]
        straight = torch.where(alpha > _INVISIBLE, image[:, :, :3] / alpha.clamp_min(_INVISIBLE), 0.0)
        image = torch.cat([straight.clamp_max(1), alpha], dim=2)
    frame: VideoFrame = (image * 255).round().to(torch.uint8).numpy().astype(np.uint8, copy=False)
    return frame
