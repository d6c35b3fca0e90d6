"""Contact sheets: style images and renders of some views, side by side as a JPEG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sgsst_core.constants import NEAR
from sgsst_core.files.atomic import atomic_path
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.report.palette import INK, PAPER
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene, sampled
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.stylizing.stylizer import Stylizer

#: Sizes in pixels: height of an image, maximum width of an image, gaps, and the text of labels.
_CELL_HEIGHT = 330
_MAX_CELL_WIDTH = 520
_GAP = 12
_LABEL = 18
#: Sheet of views without a style: maximum number of views, their longer side, aspect ratio of the sheet, and maximum
#: number of Gaussians.
_MAX_VIEWS, _VIEW_SIDE, _SHEET_SHAPE, _VIEW_GAUSSIANS = 48, 240, 1.6, 250_000


def write_contact_sheet(path: Path, stylizer: Stylizer) -> None:
    """Write a JPEG with the style image and, for each evaluation view, the original above the stylized render.

    Raises:
        OutputError: If the file cannot be written.
    """
    views = stylizer.job.views
    device = views.rasterizer.device
    pairs = []
    with torch.no_grad():
        for index in stylizer.job.evaluation_views:
            dcs = (views.scene.sh_dc.to(device), stylizer.shown())
            # Call the rasterizer directly, because only one rank writes the sheet and the other ranks do not render.
            camera = views.cameras[index]
            renders = [_to_image(views.rasterizer.render(views.colors(index, dc), camera)) for dc in dcs]
            pairs.append((camera, renders))
    sheet = _sheet(_stacked([_to_image(image) for style in stylizer.job.styles.all for image in style.images]), pairs)
    _save(path, sheet)


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

    Args:
        cameras: Cameras to choose from, at least one.

    Raises:
        OutputError: If the file cannot be written.
    """
    part = sampled(scene, _VIEW_GAUSSIANS)
    rasterizer = make_rasterizer("cpu", part, background=background, near=near)
    images = []
    for camera in spread(cameras, _MAX_VIEWS):
        small = resized(camera, min(camera.side, _VIEW_SIDE))
        colors = scene_colors(part, small)
        images.append((camera.name, _to_image(rasterizer.render(colors, small))))
    width = max(image.width for _, image in images) + _GAP
    height = max(image.height for _, image in images) + _GAP + _LABEL
    columns = min(len(images), max(1, round(math.sqrt(_SHEET_SHAPE * len(images) * height / width))))
    rows = -(-len(images) // columns)
    sheet = Image.new("RGB", (columns * width + _GAP, rows * height + _GAP), PAPER)
    draw = ImageDraw.Draw(sheet)
    for index, (name, image) in enumerate(images):
        row, column = divmod(index, columns)
        _draw(sheet, draw, image, _GAP + column * width, _GAP + _LABEL + row * height, name)
    _save(path, sheet)


def write_rows(path: Path, style: Tensor, rows: Sequence[tuple[str, Sequence[Tensor]]]) -> None:
    """Write a JPEG with the style image and rows of images [H, W, 3] below it, each row with its name above.

    Raises:
        OutputError: If the file cannot be written.
    """
    named = [
        (name, [_fitted(_to_image(render), _MAX_CELL_WIDTH, _CELL_HEIGHT) for render in renders])
        for name, renders in [("style", [style]), *rows]
    ]
    line = _LABEL + _GAP
    widths = [sum(image.width + _GAP for image in images) for _, images in named]
    heights = [max(image.height for image in images) + line for _, images in named]
    sheet = Image.new("RGB", (max(widths) + _GAP, sum(heights) + _GAP), PAPER)
    draw, top = ImageDraw.Draw(sheet), line
    for (name, images), height in zip(named, heights, strict=True):
        left = _GAP
        for index, image in enumerate(images):
            _draw(sheet, draw, image, left, top, "" if index else name)
            left += image.width + _GAP
        top += height
    _save(path, sheet)


def _save(path: Path, sheet: Image.Image) -> None:
    with atomic_path(path) as temporary:
        sheet.save(temporary, format="JPEG", quality=88)


def _to_image(image: Tensor) -> Image.Image:
    values = (image.detach().to("cpu", torch.float32).clamp(0, 1) * 255).round().to(torch.uint8)
    return Image.fromarray(values.numpy())


def _stacked(images: Sequence[Image.Image]) -> Image.Image:
    """Stack images vertically, all at the width of the widest; a single image is unchanged."""
    if len(images) == 1:
        return images[0]
    width = max(image.width for image in images)
    fitted = [_fitted(image, width, max(1, round(image.height * width / image.width))) for image in images]
    whole = Image.new("RGB", (width, sum(image.height for image in fitted)), PAPER)
    top = 0
    for image in fitted:
        whole.paste(image, (0, top))
        top += image.height
    return whole


def _fitted(image: Image.Image, width: int, height: int) -> Image.Image:
    """Resize an image to the largest size that fits a box, enlarging it if needed."""
    factor = min(width / image.width, height / image.height)
    size = (max(1, round(image.width * factor)), max(1, round(image.height * factor)))
    return image.resize(size, Image.Resampling.LANCZOS)


def _sheet(style: Image.Image, pairs: Sequence[tuple[Camera, list[Image.Image]]]) -> Image.Image:
    style = _fitted(style, _MAX_CELL_WIDTH, _CELL_HEIGHT)
    columns = [
        (camera.name, [_fitted(image, _MAX_CELL_WIDTH, _CELL_HEIGHT) for image in images]) for camera, images in pairs
    ]
    heights = [max(images[row].height for _, images in columns) for row in (0, 1)]
    widths = [style.width, *(images[0].width for _, images in columns)]
    line = _LABEL + _GAP
    size = (sum(widths) + _GAP * (len(widths) + 1), max(sum(heights) + 2 * line, style.height + line) + _GAP)
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    _draw(sheet, draw, style, _GAP, line, "style")
    left = _GAP + style.width + _GAP
    for name, images in columns:
        short = name if len(name) <= 24 else "…" + name[-23:]
        _draw(sheet, draw, images[0], left, line, f"{short}: original")
        _draw(sheet, draw, images[1], left, line + heights[0] + line, "stylized")
        left += images[0].width + _GAP
    return sheet


def _draw(sheet: Image.Image, draw: ImageDraw.ImageDraw, image: Image.Image, left: int, top: int, label: str) -> None:
    sheet.paste(image, (left, top))
    font = ImageFont.load_default(size=_LABEL - 4)
    while label and draw.textlength(label, font) > image.width:  # narrow portrait views
        label = label[:-1]
    draw.text((left, top - _LABEL), label, INK, font)
