"""Inputs of the benchmarks, and storage of their results with a description of the machine."""

from __future__ import annotations

import argparse
import json
import os
import platform
import socket
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit import orbit
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene

RESULTS = Path(__file__).parent / "results"
_PACKAGES = ("torch", "numpy", "numba")


def describe_machine() -> dict[str, Any]:
    """Describe processor, memory, GPU, software versions and current load of this machine."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "processor": _processor(),
        "cores": psutil.cpu_count(logical=False) or os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "gpu": gpu,
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: version(name) for name in _PACKAGES},
        "load_average": [round(load, 2) for load in psutil.getloadavg()],
    }


def write_result(name: str, figures: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write figures, machine and date to `NAME.json` in `folder`, and return the path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.json"
    content = {"date": datetime.now(UTC).isoformat(timespec="seconds"), "machine": describe_machine(), **figures}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
    return path


def add_pair(name: str, pair: str, description: dict[str, Any], rows: dict[str, Any]) -> None:
    """Add rows to the results of one pair of scene and style in `NAME.json`; other rows and pairs stay."""
    path = RESULTS / f"{name}.json"
    pairs = json.loads(path.read_text(encoding="utf-8"))["pairs"] if path.exists() else {}
    earlier = pairs.get(pair, {}).get("rows", {})
    pairs[pair] = {**description, "rows": {**earlier, **rows}}
    write_result(name, {"pairs": pairs})


def free_address() -> str:
    """Return an address on this machine whose port is free, as HOST:PORT."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{listener.getsockname()[1]}"


def _processor() -> str:
    """Return the processor's name, or its architecture if the name is unknown."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


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


def grainy_photo(name: str, height: int, width: int) -> Tensor:
    """Return a photo of scikit-image, e.g. "astronaut", as [height, width, 3] from 0 to 1, with fine grain added.

    Without grain, enlarged photos have no detail at full size, unlike real views.
    """
    from skimage import data

    pixels = torch.from_numpy(getattr(data, name)()[..., :3].copy()).float() / 255
    planes = F.interpolate(pixels.permute(2, 0, 1)[None], size=(height, width), mode="bicubic", align_corners=False)
    grain = torch.randn((height, width, 3), generator=torch.Generator().manual_seed(0)) * 0.03
    return (planes[0].permute(1, 2, 0) + grain).clamp(0, 1).contiguous()
