"""Cameras of the benchmarks, from a camera file or an orbit."""

from __future__ import annotations

from pathlib import Path

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.orbit.cameras import orbit
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene


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
