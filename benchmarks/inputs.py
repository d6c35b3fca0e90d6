"""Inputs of the benchmarks: command line, scene, cameras and style."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

from torch import Tensor

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit.cameras import orbit
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene


def input_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a command line parser with the arguments `scene`, `cameras` and `style`."""
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("cameras", help="camera file, or orbit:N")
    parser.add_argument("style", type=Path)
    return parser


def read_inputs(arguments: argparse.Namespace, count: int, resolution: int) -> tuple[Scene, list[Camera], Tensor]:
    """Read the inputs that `input_parser` has parsed; see `read_views` for the cameras."""
    scene = read_scene(arguments.scene).scene
    return scene, read_views(arguments.cameras, scene, count, resolution), load_image(arguments.style)


def read_views(source: str, scene: Scene, count: int, resolution: int) -> list[Camera]:
    """Return `count` cameras, with `resolution` pixels on their longer side.

    Args:
        source: Camera file, or orbit:N for a ring of N cameras.
        scene: Scene that an orbit is placed around; a camera file doesn't need it.
        count: Number of cameras to select, at even intervals from the source.
        resolution: Longer side in pixels.
    """
    if source.startswith("orbit:"):
        cameras = orbit(scene, int(source.removeprefix("orbit:")), up=[0, -1, 0])
    else:
        cameras = read_cameras(Path(source))
    return [resized(camera, resolution) for camera in spread(cameras, count)]


def with_size(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera at another size, with the same horizontal field of view and a centered principal point."""
    factor = width / camera.width
    return replace(
        camera,
        width=width,
        height=height,
        fx=camera.fx * factor,
        fy=camera.fy * factor,
        cx=width / 2,
        cy=height / 2,
    )
