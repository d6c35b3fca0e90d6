"""Multi-view consistency as papers on stylized radiance fields report it: views 1 and 7 apart, RMSE and LPIPS.

python -m benchmarks.protocol truck train m60 garden --styles starry_night.jpg great_wave.jpg

Papers use the scenes Truck, Train and M60 of Tanks and Temples, and Garden of Mip-NeRF 360. Each folder holds a trained
scene, such as point_cloud/iteration_30000/point_cloud.ply, and its cameras (cameras.json or a COLMAP model). Each scene
is stylized with each style on all its views, which takes a GPU; then one view of each pair is warped into the other by
rendered depth (`sgsst_core.quality.consistency`). Views are in the order of their names, which is that of the capture.
Figures compare with those of other runs of this program only: papers warp by optical flow. Results are written to
benchmarks/results/protocol.json after each pair of scene and style.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from benchmarks.machine import add_pair
from sgsst_core import Stylizer, load_cameras, load_image, load_scene, make_settings
from sgsst_core.quality.consistency import (
    LONG_RANGE,
    SHORT_RANGE,
    Consistency,
    compare,
    expected_depth,
    find_warp,
    shown,
    view_pairs,
)
from sgsst_core.quality.float32_reference import rasterizer_beside
from sgsst_core.quality.lpips import Lpips
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.stylizing.loop import run
from sgsst_core.stylizing.views import ViewColors

RANGES = {"short": SHORT_RANGE, "long": LONG_RANGE}
#: Places of a scene in a folder, in order of preference.
SCENES = ("point_cloud/iteration_*/point_cloud.ply", "*.ply")
#: Rows of the result, and memory in bytes for cached colors of views.
UNSTYLIZED, STYLIZED = "unstylized", "stylized"
_COLOR_MEMORY = 1 << 30


def main() -> None:
    """Stylize and measure each scene with each style, then print and store the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--styles", nargs="+", type=Path, required=True)
    parser.add_argument("--resolution", type=int, help="longer side of the views; default: that of the cameras")
    parser.add_argument("--pairs", type=int, help="at most so many pairs of views per range; default: all")
    parser.add_argument("--preset", default="standard", choices=("preview", "standard", "paper"))
    parser.add_argument("--settings", default="{}", help="JSON, further settings of the jobs")
    arguments = parser.parse_args()
    settings = make_settings(arguments.preset, **{"measure": 0, **json.loads(arguments.settings)})
    scenes = {folder: scene_in(folder) for folder in arguments.folders}  # missing ones are reported at once
    print(f"{'':32}", *(f"{name + ' ' + figure:>12}" for name in RANGES for figure in ("RMSE", "LPIPS")))
    for folder, path in scenes.items():
        scene, cameras = load_scene(path).scene, sorted(load_cameras(folder), key=lambda camera: camera.name)
        cameras = [resized(camera, arguments.resolution or camera.side) for camera in cameras]
        for style in arguments.styles:
            started = time.perf_counter()
            stylizer = Stylizer.planned(scene, cameras, load_image(style), settings)
            run(stylizer)
            seconds = time.perf_counter() - started
            own = stylizer.job.scene
            colors = {UNSTYLIZED: own.sh_dc, STYLIZED: stylizer.stylized()}
            lpips = Lpips(device=stylizer.job.network.device)
            rows = measured(own, cameras, rasterizer_beside(stylizer, own), colors, lpips, arguments.pairs)
            rows[STYLIZED] |= {"seconds": seconds, "steps": stylizer.step}
            size = {"size": [cameras[0].width, cameras[0].height], "views": len(cameras), "gaussians": len(own)}
            name = f"{folder.resolve().name}, {style.stem}"
            for row, figures in rows.items():
                print(f"{name + ', ' + row:32}", *(_cell(figures[each]) for each in RANGES), flush=True)
            add_pair(
                "protocol", name, {"style": style.name, "settings": settings.model_dump(mode="json"), **size}, rows
            )


def scene_in(folder: Path) -> Path:
    """Return the scene in a folder: that of the last iteration, or the only PLY.

    Raises:
        SystemExit: If there is none.
    """
    for pattern in SCENES:
        matches = sorted(folder.glob(pattern), key=lambda path: (len(str(path)), str(path)))
        if matches:
            return matches[-1]
    raise SystemExit(f"{folder}: holds no {' and no '.join(SCENES)}. Name the folder of a trained scene.")


@torch.no_grad()
def measured(
    scene: Scene,
    cameras: list[Camera],
    rasterizer: Rasterizer,
    colors: Mapping[str, Tensor],
    lpips: Lpips,
    most: int | None,
) -> dict[str, dict[str, Any]]:
    """Return the consistency of several colors of a scene in both ranges, as values for JSON.

    Args:
        scene: Scene whose geometry all colors share.
        cameras: Views in capture order.
        rasterizer: Rasterizer of the scene.
        colors: Colors `sh_dc` [N, 3] by name.
        lpips: LPIPS network.
        most: Maximum number of evenly spread pairs per range; None for all.
    """
    view_colors = ViewColors(scene, cameras, rasterizer.device, _COLOR_MEMORY)
    on_device = {name: sh_dc.detach().to(rasterizer.device) for name, sh_dc in colors.items()}

    def image(index: int, name: str) -> Tensor:
        rendered = rasterizer.render(view_colors(index, on_device[name]), cameras[index])
        return shown(rendered, cameras[index], rasterizer.device)

    rows: dict[str, dict[str, Any]] = {name: {} for name in colors}
    for range_name, gap in RANGES.items():
        pairs = {name: Consistency(gap, []) for name in colors}
        for first, second in view_pairs(len(cameras), gap, most):
            depths = {index: expected_depth(scene, cameras[index], rasterizer) for index in (first, second)}
            warp = find_warp(depths[second], cameras[second], depths[first], cameras[first])
            for name, consistency in pairs.items():
                warped, valid = warp.apply(image(second, name))
                consistency.pairs.append(compare(first, second, image(first, name), warped, valid, lpips))
        for name, each in pairs.items():
            rows[name][range_name] = {
                "rmse": each.rmse,
                "lpips": each.lpips,
                "compared": each.compared,
                "pairs": len(each.pairs),
            }
    return rows


def _cell(figures: Mapping[str, float | None]) -> str:
    values = (figures["rmse"], figures["lpips"])
    return " ".join(f"{'-':>12}" if value is None else f"{value:12.4f}" for value in values)


if __name__ == "__main__":
    main()
