"""Inputs of the benchmarks, and storage of their results with a description of the machine."""

import argparse
import json
import os
import platform
import re
import shlex
import socket
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Any

import psutil
import torch
import torch.nn.functional as F
from torch import Tensor

from sgsst_core.files.atomic import write_json
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.orbit import orbit
from sgsst_core.report.document import processor
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import PresetName, make_settings

RESULTS = Path(__file__).parent / "results"
#: Checkout, and what is measured in it.
_ROOT, _CODE = RESULTS.parents[1], ("sgsst_core", "worker", "service", "api", "benchmarks/*.py")
_PACKAGES = ("torch", "numpy", "numba")
#: Load per core above which other programs distort what is measured, and seconds in which it may fall.
_MOST_LOAD, _SECONDS_TO_FALL = 0.65, 180
#: Names of files and modules of this project in command lines.
_PROGRAM = re.compile(r"sgsst.*|pytest|api\..*|worker\..*|service\..*|benchmarks\..*")
_LOAD_BEFORE = [round(load, 2) for load in psutil.getloadavg()]


def parse(parser: argparse.ArgumentParser, arguments: Sequence[str] | None = None) -> argparse.Namespace:
    """Parse a benchmark's command line, with the option --loaded, and check that nothing else runs on the machine.

    Of a benchmark with several ways of calling it, only `run` measures.

    Raises:
        SystemExit: If other programs run, and the option is not given.
    """
    parser.add_argument("--loaded", action="store_true", help="measure beside other programs; the result says so")
    parsed = parser.parse_args(arguments)
    if not parsed.loaded and getattr(parsed, "way", "run") == "run" and (reason := _busy()):
        sys.exit(f"{reason}, which distorts what is measured: wait for its end, or give --loaded.")
    return parsed


def _busy() -> str | None:
    """Return what keeps the machine busy. The load of an earlier benchmark is given time to fall."""
    own = psutil.Process()
    family = {own.pid, *(each.pid for each in [*own.parents(), *own.children(recursive=True)])}
    for process in psutil.process_iter(["cmdline"]):
        words = [Path(word).name for word in (process.info["cmdline"] or [])[:3]]
        if process.pid not in family and any(_PROGRAM.fullmatch(word) for word in words):
            return f"Process {process.pid} ({' '.join(words)[:60]}) runs"
    most = _MOST_LOAD * (os.cpu_count() or 1)
    for _ in range(_SECONDS_TO_FALL):
        if psutil.getloadavg()[0] <= most:
            return None
        time.sleep(1)
    return f"The load is {psutil.getloadavg()[0]:.1f}, above {most:.1f}"


def describe_machine() -> dict[str, Any]:
    """Describe processor, memory, GPU and software versions of this machine, and its load before and now."""
    gpu = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {
        "processor": processor(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "cores": psutil.cpu_count(logical=False) or os.cpu_count(),
        "threads": torch.get_num_threads(),
        "memory_gib": round(psutil.virtual_memory().total / 2**30, 1),
        "gpu": gpu,
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: version(name) for name in _PACKAGES},
        "load_before": _LOAD_BEFORE,
        "load_after": [round(load, 2) for load in psutil.getloadavg()],
    }


def provenance(presets: Sequence[PresetName] = (), scenes: Mapping[str, Path] | None = None) -> dict[str, Any]:
    """Return what figures were measured with: date, commit, command, machine, settings of presets, hashes of scenes.

    Folders of files in the command are left out but the last one.
    """
    command = re.sub(r"(?<![^\s=:])/(?:[^/\s:=]+/)*([^/\s:=]+/[^/\s:=]+)", r"\1", shlex.join(sys.orig_argv[1:]))
    return {
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "commit": _commit(),
        "command": f"python {command}",
        "loaded": "--loaded" in sys.argv,
        "machine": describe_machine(),
        "presets": {name: make_settings(name).model_dump(mode="json") for name in presets},
        "scenes": {name: sha256(path.read_bytes()).hexdigest() for name, path in (scenes or {}).items()},
    }


def _commit() -> str | None:
    """Return the commit of the code, with a plus sign if the code differs from it; None without Git."""
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=_ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
    commit = head.stdout.decode().strip()
    return commit + "+" * (not is_of_this_code(commit)) if commit else None


def is_of_this_code(commit: str) -> bool:
    """Return whether the measured code is that of a commit."""
    compared = ["git", "diff", "--quiet", commit, "--", *_CODE]
    return subprocess.run(compared, cwd=_ROOT, stderr=subprocess.DEVNULL).returncode == 0


def write_result(
    name: str,
    figures: dict[str, Any],
    folder: Path = RESULTS,
    *,
    presets: Sequence[PresetName] = (),
    scenes: Mapping[str, Path] | None = None,
) -> Path:
    """Write figures with their `provenance` to `NAME.json` in `folder`, and return the path.

    Args:
        name: Name of the result.
        figures: Measured values.
        folder: Folder of the file.
        presets: Presets whose settings the figures depend on.
        scenes: Files of the scenes.
    """
    path = folder / f"{name}.json"
    write_json(path, provenance(presets, scenes) | figures)
    return path


def add_pair(
    name: str,
    pair: str,
    description: dict[str, Any],
    rows: dict[str, Any],
    *,
    presets: Sequence[PresetName] = (),
    scenes: Mapping[str, Path] | None = None,
) -> Path:
    """Add rows with their `provenance` to one pair of scene and style, or another part, in `NAME.json`.

    Other rows and pairs stay. Each row gets its own date and commit; those of the pair are of the latest row. Returns
    the path.
    """
    path = RESULTS / f"{name}.json"
    pairs = json.loads(path.read_text(encoding="utf-8"))["pairs"] if path.exists() else {}
    earlier, now = pairs.get(pair, {}).get("rows", {}), provenance(presets, scenes)
    date = {key: now[key] for key in ("date", "commit")}
    dated = {key: row | date if isinstance(row, dict) else row for key, row in rows.items()}
    pairs[pair] = {**now, **description, "rows": {**earlier, **dated}}
    write_json(path, {"pairs": pairs})
    return path


def free_address() -> str:
    """Return an address on this machine whose port is free, as HOST:PORT."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{listener.getsockname()[1]}"


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
