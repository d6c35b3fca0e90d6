"""An animation around a scene: the original on one side of a line that moves, the stylized one on the other.

python -m benchmarks.wipe SCENE.ply STYLIZED.ply CAMERAS|orbit:N OUT.webp [--frames 60] [--resolution 480]

Cameras of a file are gone through there and back, those of an orbit around. The line goes over the picture and back
once. Quality is lowered until the file is no larger than `--bytes`.
"""

from __future__ import annotations

import argparse
import io
import math
from pathlib import Path

import torch
from PIL import Image

from benchmarks.cameras import read_views
from sgsst_core.files.ply import read_scene
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.spherical_harmonics import rest_colours, view_colours

QUALITIES = (85, 75, 65, 55, 45, 35, 25)
_LINE = 2  # pixels


def main() -> None:
    """Render and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("stylized", type=Path)
    parser.add_argument("cameras", help="camera file, or orbit:N")
    parser.add_argument("out", type=Path)
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--resolution", type=int, default=480)
    parser.add_argument("--milliseconds", type=int, default=80, help="of a frame")
    parser.add_argument("--background", type=float, default=1.0, help="grey behind the Gaussians, 0 to 1")
    parser.add_argument("--bytes", type=int, default=2_000_000)
    arguments = parser.parse_args()
    scene, stylized = read_scene(arguments.scene).scene, read_scene(arguments.stylized).scene
    around = arguments.cameras.startswith("orbit:")
    count = arguments.frames if around else arguments.frames // 2 + 1
    cameras = read_views(arguments.cameras, scene, count, arguments.resolution)
    if not around:
        cameras += cameras[-2:0:-1]
    rasterizer = make_rasterizer("cpu", scene, background=(arguments.background,) * 3)

    def picture(camera: Camera, sh_dc: torch.Tensor) -> torch.Tensor:
        """[H, W, 3] in 8 bits; both scenes have one geometry."""
        rest = rest_colours(scene.sh_rest, scene.means, camera)
        return (rasterizer.render(view_colours(sh_dc, rest), camera).clamp(0, 1) * 255).round().to(torch.uint8)

    frames = []
    for place, camera in enumerate(cameras):
        line = round(camera.width * (0.5 - 0.5 * math.cos(2 * math.pi * place / len(cameras))))
        frame = picture(camera, stylized.sh_dc)
        frame[:, line:] = picture(camera, scene.sh_dc)[:, line:]
        frame[:, max(0, line - _LINE) : line] = 255
        frames.append(Image.fromarray(frame.numpy()))
    arguments.out.write_bytes(_smallest(frames, arguments.milliseconds, arguments.bytes))


def _smallest(frames: list[Image.Image], milliseconds: int, most: int) -> bytes:
    """An animated WebP of the best quality that is small enough."""
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
