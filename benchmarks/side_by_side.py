"""Renders of several scenes side by side, as a JPEG with one column per scene.

python -m benchmarks.side_by_side CAMERAS|orbit:N OUT.jpg LABEL=SCENE.ply ... [--views 2] [--resolution 480]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont

from benchmarks.cameras import read_views
from sgsst_core.files.scene_file import read_scene
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors

_LABEL = 22


def main() -> None:
    """Render all scenes, and write the image."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cameras", help="camera file, or orbit:N")
    parser.add_argument("out", type=Path)
    parser.add_argument("scenes", nargs="+", metavar="LABEL=SCENE.ply")
    parser.add_argument("--views", type=int, default=2, help="rows")
    parser.add_argument("--resolution", type=int, default=480)
    arguments = parser.parse_args()
    columns = []
    for text in arguments.scenes:
        label, _, path = text.partition("=")
        scene = read_scene(Path(path)).scene
        cameras = read_views(arguments.cameras, scene, arguments.views, arguments.resolution)
        columns.append(_column(label, scene, cameras))
    sheet = Image.new("RGB", (sum(column.width for column in columns), columns[0].height), "white")
    left = 0
    for column in columns:
        sheet.paste(column, (left, 0))
        left += column.width
    sheet.save(arguments.out, quality=88)


def _column(label: str, scene: Scene, cameras: list[Camera]) -> Image.Image:
    rasterizer = make_rasterizer("cpu", scene)
    width, height = cameras[0].width, cameras[0].height
    column = Image.new("RGB", (width, _LABEL + height * len(cameras)), "white")
    ImageDraw.Draw(column).text((4, 2), label, "black", ImageFont.load_default(size=_LABEL - 6))
    for row, camera in enumerate(cameras):
        colors = scene_colors(scene, camera)
        values = (rasterizer.render(colors, camera).clamp(0, 1) * 255).round().to(torch.uint8)
        column.paste(Image.fromarray(values.numpy()), (0, _LABEL + row * height))
    return column


if __name__ == "__main__":
    main()
