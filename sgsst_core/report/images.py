"""Images of reports in their colors: contact sheets as JPEG, and the frames of videos."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sgsst_core.constants import NEAR
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.images import to_image
from sgsst_core.files.video import VideoFrame
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene, sampled
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.stylizing.stylizer import Stylizer

PAPER = "#ffffff"
#: Color of text and axes, and of grid lines.
INK, GRID = "#222222", "#888888"
#: Colors of data series, in this order; distinguishable with color vision deficiency.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
#: Colors of the page by their names in its style sheet: for light paper, and for a dark screen.
PAGE = {
    "paper": (PAPER, "#14171b"),
    "ink": (INK, "#e4e7eb"),
    "quiet": ("#5b636c", "#9aa4af"),
    "line": ("#d9dde2", "#333a42"),
    "shade": ("#f4f6f8", "#1d2228"),
    "accent": (COLORS[0], "#4aa8e8"),
}


def color_of(index: int) -> str:
    """Return the color of the data series with the given index; colors repeat after the last one."""
    return COLORS[index % len(COLORS)]


#: Sizes in pixels: height of an image, maximum width of an image, gaps, and the text of labels.
_CELL_HEIGHT = 330
_MAX_CELL_WIDTH = 520
_GAP = 12
_LABEL = 18
_LINE = _LABEL + _GAP
#: Sheet of views without a style: maximum number of views, their longer side, and maximum number of Gaussians.
_MAX_VIEWS, _VIEW_SIDE, _VIEW_GAUSSIANS = 48, 240, 250_000


def write_contact_sheet(path: Path, stylizer: Stylizer) -> None:
    """Write a JPEG with the style images and, for each evaluation view, the original above the stylized render."""
    views, rasterizer = stylizer.job.views, stylizer.job.views.rasterizer
    originals, results = [], []
    with torch.no_grad():
        for index in stylizer.job.evaluation_views:
            camera = views.cameras[index]
            # Call the rasterizer directly, because only one rank writes the sheet and the other ranks do not render.
            before, after = views.scene.sh_dc.to(rasterizer.device), stylizer.shown()
            original = rasterizer.render(views.colors(index, before), camera)
            originals.append((f"original: {camera.name}", _fitted(original)))
            results.append(("stylized", _fitted(rasterizer.render(views.colors(index, after), camera))))
    styles = [("style", _fitted(image)) for style in stylizer.job.styles.all for image in style.images]
    _save_grid(path, [[style, *(row or ())] for style, row in zip_longest(styles, (originals, results))])


def write_views(
    path: Path,
    scene: Scene,
    cameras: Sequence[Camera],
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = NEAR,
) -> None:
    """Write a JPEG with small renders of at most 48 cameras, spread evenly over the list.

    Large scenes are rendered from a sample of their Gaussians (see `sampled`).
    """
    shown = spread(cameras, _MAX_VIEWS)
    renders = small_renders(scene, shown, _VIEW_SIDE, background=background, near=near)
    images = [(camera.name, to_image(render)) for camera, render in zip(shown, renders, strict=True)]
    columns = math.ceil(math.sqrt(len(images)))
    _save_grid(path, [images[start : start + columns] for start in range(0, len(images), columns)])


def small_renders(
    scene: Scene,
    cameras: Sequence[Camera],
    side: int,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = NEAR,
) -> Iterator[Tensor]:
    """Yield renders [H, W, 3] of a scene, or of a sample of a large one, with at most `side` pixels per side."""
    part = sampled(scene, _VIEW_GAUSSIANS)
    rasterizer = make_rasterizer("cpu", part, background=background, near=near, memory=0)
    for camera in cameras:
        small = resized(camera, min(camera.side, side))
        yield rasterizer.render(scene_colors(part, small), small)


def write_grid(path: Path, rows: Sequence[Sequence[tuple[str, Tensor] | None]]) -> None:
    """Write a JPEG with rows of images [H, W, 3] in columns, each with its name above; None leaves a place empty."""
    _save_grid(path, [[cell and (cell[0], _fitted(cell[1])) for cell in row] for row in rows])


def _save_grid(path: Path, grid: Sequence[Sequence[tuple[str, Image.Image] | None]]) -> None:
    """Write a JPEG with rows of images; see `write_grid`."""
    widths = [max((cell[1].width for cell in column if cell), default=0) for column in zip_longest(*grid)]
    heights = [max((cell[1].height for cell in row if cell), default=0) for row in grid]
    size = sum(widths) + _GAP * (len(widths) + 1), sum(heights) + _LINE * len(heights) + _GAP
    sheet = Image.new("RGB", size, PAPER)
    draw, font, top = ImageDraw.Draw(sheet), ImageFont.load_default(size=_LABEL - 4), _LINE
    for row, height in zip(grid, heights, strict=True):
        left = _GAP
        for cell, width in zip(row, widths, strict=False):
            label, image = cell or ("", None)
            if image is not None:
                sheet.paste(image, (left, top))
                draw.text((left, top - _LABEL), _shortened(label, image.width, font), INK, font)
            left += width + _GAP
        top += height + _LINE
    with atomic_path(path) as temporary:
        sheet.save(temporary, format="JPEG", quality=88)


def _shortened(label: str, width: int, font: ImageFont.FreeTypeFont | ImageFont.ImageFont) -> str:
    """Return a label on one line, without its middle if it is wider: names of cameras differ at their end."""
    line = label.replace("\n", " ")
    for length in range(min(len(line), width), 0, -1):  # names in camera files may have a million characters
        start = length // 3
        text = line if length == len(line) else f"{line[:start]}...{line[start - length :]}"
        if font.getlength(text) <= width:
            return text
    return ""


def _fitted(image: Tensor) -> Image.Image:
    """Return an image [H, W, 3] at the largest size that fits a cell, enlarged if needed."""
    whole = to_image(image)
    factor = min(_MAX_CELL_WIDTH / whole.width, _CELL_HEIGHT / whole.height)
    size = (max(1, round(whole.width * factor)), max(1, round(whole.height * factor)))
    return whole.resize(size, Image.Resampling.LANCZOS)


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
        fraction = 1.0 if unstylized is None else _shown_fraction(index / max(len(cameras) - 1, 1))
        image = layer.image(camera, alpha=alpha)
        if unstylized is not None and fraction < 1:
            before, line = unstylized.image(camera, alpha=alpha), round(fraction * image.shape[1])
            wiped = torch.cat([image[:, :line], before[:, line:]], dim=1)
            image = wiped if transition == "wipe" else torch.lerp(before, image, fraction)
        write(_to_bytes(image))
        progress(index + 1, len(cameras))


def _shown_fraction(time: float) -> float:
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
    return (image * 255).round().to(torch.uint8).numpy().astype(np.uint8, copy=False)
