"""Predicted memory and run time of jobs on this machine, by number of Gaussians and pixels, for operators.

python -m benchmarks.sizing [--preset standard] [--views 50]

The built-in scene is probed as for a job, and the planner's own model (`decide`) predicts memory and time for other
sizes. Assumptions: a view shows half of the Gaussians, the size of blend weights is proportional to the number of
pixels, and one half of the rendering time is proportional to the number of pixels and the other half to the number of
Gaussians. A dry run of a real scene is always more accurate.
"""

from __future__ import annotations

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from api.cli.demo_scene import build_demo
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.features.partition import Rectangle
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.scene_file import read_scene
from sgsst_core.parallel.collectives import ALONE
from sgsst_core.planning.context import equip
from sgsst_core.planning.decide import decide
from sgsst_core.planning.facts import Probe, RasterCost
from sgsst_core.planning.memory import gaussian_bytes
from sgsst_core.planning.plan import Prediction
from sgsst_core.planning.probe import measure, probe_link
from sgsst_core.planning.survey import Survey, survey_views
from sgsst_core.scene.camera import fit_cameras
from sgsst_core.settings import Settings, make_settings

GAUSSIANS = (100_000, 500_000, 1_000_000, 4_000_000, 12_000_000)
WIDTHS = (480, 960, 1920)
SH_DEGREE = 3


def measured(settings: Settings) -> Probe:
    """Measure the built-in scene, and return its probe."""
    with tempfile.TemporaryDirectory() as folder:
        files = build_demo(Path(folder))
        scene, cameras = read_scene(files.ply).scene, read_cameras(files.cameras)
    fitted = fit_cameras(cameras, settings)
    planning_context = equip(scene, fitted, settings, load_network_weights("auto"), ALONE)
    survey = survey_views(planning_context.scene, fitted, planning_context.rasterizer, ALONE)
    return measure(planning_context, survey, probe_link(ALONE, planning_context.network.device))


def changed(probe: Probe, gaussians: int, width: int, views: int) -> Probe:
    """Return the probe extrapolated to another number of Gaussians, and to other sizes and numbers of views."""
    height = width * 2 // 3
    before = probe.sizes[0][0] * probe.sizes[0][1]
    pixels = width * height / before
    facts = replace(probe.scene, gaussians=gaussians, sh_degree=SH_DEGREE, used_degree=SH_DEGREE, held_degree=SH_DEGREE)
    seen = torch.ones(gaussians, dtype=torch.float64)
    whole = [Rectangle(0, 0, height, width)] * views
    more = gaussian_bytes(SH_DEGREE) * gaussians - gaussian_bytes(probe.scene.held_degree) * probe.scene.gaussians
    return replace(
        probe,
        scene=facts,
        sizes=((height, width),) * views,
        survey=Survey(seen, list(range(views)), whole, 0.0, shown=gaussians / 2),
        raster=_raster(probe.raster, pixels, gaussians / probe.scene.gaussians, views / len(probe.sizes)),
        process_bytes=probe.process_bytes + more,
    )


def _raster(cost: RasterCost, pixels: float, gaussians: float, views: float) -> RasterCost:
    seconds = (pixels + gaussians) / 2
    return replace(
        cost,
        seconds=cost.seconds * seconds,
        cached_seconds=None if cost.cached_seconds is None else cost.cached_seconds * seconds,
        bytes=None if cost.bytes is None else int(cost.bytes * pixels * views),
        half_bytes=None if cost.half_bytes is None else int(cost.half_bytes * pixels * views),
        caching_seconds=None if cost.caching_seconds is None else cost.caching_seconds * seconds,
        first_seconds=cost.first_seconds * seconds,
        intersection_bytes=int(cost.intersection_bytes * seconds),
    )


def table(probe: Probe, settings: Settings, views: int) -> str:
    """Return a Markdown table by Gaussians and view size: GB of the process (and of its GPU), and hours of the job."""
    lines = [
        f"| Gaussians | {' | '.join(f'{width}x{width * 2 // 3}' for width in WIDTHS)} |",
        f"|---|{'---:|' * len(WIDTHS)}",
    ]
    for gaussians in GAUSSIANS:
        cells = []
        for width in WIDTHS:
            # The largest amount of memory that a plan uses: the scene's own, plus a machine's default budget.
            plan = decide(changed(probe, gaussians, width, views), settings, measured=True)
            assert plan.prediction is not None
            cells.append(_cell(plan.prediction))
        lines.append(f"| {gaussians / 1e6:g} million | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cell(prediction: Prediction) -> str:
    memory = f"{prediction.peak_bytes / 1e9:.1f}"
    if prediction.device_bytes is not None:
        memory += f" + {prediction.device_bytes / 1e9:.1f}"
    hours = (prediction.job + prediction.ending) / 3600
    return f"{memory} GB, {hours:.1f} h" if hours >= 1 else f"{memory} GB, {hours * 60:.0f} min"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Memory and seconds of jobs, from the planner's model.")
    parser.add_argument("--preset", choices=("preview", "standard", "paper"), default="standard")
    parser.add_argument("--views", type=int, default=50)
    options = parser.parse_args()
    settings = make_settings(options.preset)
    probe = measured(settings)
    print(table(probe, settings, options.views))


if __name__ == "__main__":
    main()
