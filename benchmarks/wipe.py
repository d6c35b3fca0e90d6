"""Animation of a camera path, with the original scene on one side of a moving line and the stylized one on the other.

python -m benchmarks.wipe SCENE.ply STYLIZED.ply CAMERAS|orbit:N OUT.webp [--first 0] [--count 8] [--resolution 480]

With orbit:N, the camera circles the scene in N views. With a camera file, it moves through `--count` cameras, starting
at `--first`, and back again, with three interpolated views between consecutive cameras. Meanwhile, the line crosses the
image and returns. Image quality is reduced until the file is no larger than `--bytes`.
"""

from __future__ import annotations

import argparse
import io
import math
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path

import torch
from PIL import Image

from benchmarks.cameras import read_views
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import read_scene
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, between, resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors

QUALITIES = (85, 75, 65, 55, 45, 35, 25)
_LINE = 2  # width in pixels


def main() -> None:
    """Render the frames and write the animation."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("stylized", type=Path)
    parser.add_argument("cameras", help="camera file, or orbit:N")
    parser.add_argument("out", type=Path)
    parser.add_argument("--first", type=int, default=0, help="camera of a file")
    parser.add_argument("--count", type=int, default=8, help="cameras of a file")
    parser.add_argument("--resolution", type=int, default=480)
    parser.add_argument("--milliseconds", type=int, default=80, help="of a frame")
    parser.add_argument("--background", type=float, default=1.0, help="gray behind the Gaussians, 0 to 1")
    parser.add_argument("--bytes", type=int, default=2_000_000)
    arguments = parser.parse_args()
    scene, stylized = read_scene(arguments.scene).scene, read_scene(arguments.stylized).scene
    cameras = _way(arguments, scene)
    before, after = _painter(scene, arguments.background), _painter(stylized, arguments.background)
    frames = []
    for place, camera in enumerate(cameras):
        line = round(camera.width * (0.5 - 0.5 * math.cos(2 * math.pi * place / len(cameras))))
        frame = after(camera)
        frame[:, line:] = before(camera)[:, line:]
        frame[:, max(0, line - _LINE) : line] = 255
        frames.append(Image.fromarray(frame.numpy()))
    arguments.out.write_bytes(_smallest(frames, arguments.milliseconds, arguments.bytes))


def _painter(scene: Scene, gray: float) -> Callable[[Camera], torch.Tensor]:
    """Return a function that renders views of a scene as 8-bit images [H, W, 3]."""
    rasterizer = make_rasterizer("cpu", scene, background=(gray,) * 3)

    def picture(camera: Camera) -> torch.Tensor:
        return (rasterizer.render(scene_colors(scene, camera), camera).clamp(0, 1) * 255).round().to(torch.uint8)

    return picture


def _way(arguments: argparse.Namespace, scene: Scene) -> list[Camera]:
    """Return the cameras of all frames, which form a closed loop."""
    if arguments.cameras.startswith("orbit:"):
        count = int(arguments.cameras.removeprefix("orbit:"))
        return read_views(arguments.cameras, scene, count, arguments.resolution)
    every = read_cameras(Path(arguments.cameras))[arguments.first : arguments.first + arguments.count]
    way = [resized(camera, arguments.resolution) for camera in every]
    for _ in range(2):
        way = [camera for pair in pairwise(way) for camera in (pair[0], between(*pair))] + way[-1:]
    return way + way[-2:0:-1]


def _smallest(frames: list[Image.Image], milliseconds: int, most: int) -> bytes:
    """Encode an animated WebP at the highest quality for which it has at most `most` bytes."""
    for quality in QUALITIES:
        target = io.BytesIO()
        first, *others = frames
        options = {"duration": milliseconds, "loop": 0, "quality": quality, "method": 6}
        first.save(target, "WEBP", save_all=True, append_images=others, **options)
        print(f"quality {quality}: {target.tell():,} bytes", flush=True)
        if target.tell() <= most:
            return target.getvalue()
    raise SystemExit(f"larger than {most} bytes at any quality: ask for fewer frames, or smaller ones")


if __name__ == "__main__":
    main()
