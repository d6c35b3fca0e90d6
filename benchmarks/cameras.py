"""The cameras that benchmarks look at a scene with."""

from __future__ import annotations

from pathlib import Path

from sgsst_core.files.camera_files import read_cameras
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.orbit import orbit


def read_views(source: str, scene: Scene, count: int, resolution: int) -> list[Camera]:
    """`count` cameras of a camera file, or of a ring of N for orbit:N, so many pixels on their longer side."""
    if source.startswith("orbit:"):
        cameras = orbit(scene, int(source.removeprefix("orbit:")), up=[0, -1, 0])
    else:
        cameras = read_cameras(Path(source))
    return [resized(camera, resolution) for camera in spread(cameras, count)]
