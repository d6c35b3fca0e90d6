"""Comparison of settings after the same number of steps, on novel views, by a network that is not part of the loss.

python -m benchmarks.equal_steps SCENE CAMERAS|orbit:N STYLE NAME 'ROW={"content_weight": 3000}' 'ROW=...'

Each row is a JSON object of settings that override the standard preset. The additional setting `factor` scales VGG16's
features: a number scales all layers (1 = unchanged), an object individual layers ({"relu1_1": 16, "relu2_1": 8}). A
layer without a factor takes that of the previous layer. Results are added to benchmarks/results/equal_steps.json, under
NAME. With several seeds, figures are means, and "spread" is the largest difference between two seeds. "sliced" is the
sliced Wasserstein distance between the colors of pixels and style, in 8-bit levels; no loss term and no color
initialization optimizes it.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from benchmarks.cameras import read_views
from benchmarks.machine import add_pair, print_row
from sgsst_core import Stylizer, make_settings
from sgsst_core.bench.quality import make_novel_views
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.files.images import load_image
from sgsst_core.files.scene_file import read_scene
from sgsst_core.loss.feature_scale import with_scales
from sgsst_core.quality.judge import Judge
from sgsst_core.quality.lpips import Lpips
from sgsst_core.report.contact_sheet import write_rows
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Number of views on the contact sheet.
SHOWN = 3
COLUMNS = ("style", "color_distance", "sliced", "content", "features", "background_sensitivity", "saturated", "seconds")
#: Number of color directions of the sliced distance, and number of quantiles along each.
DIRECTIONS, QUANTILES = 64, 1024


def main() -> None:
    """Run all rows, then print and store the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("cameras", help="camera file, or orbit:N")
    parser.add_argument("style", type=Path)
    parser.add_argument("name", help="of the pair, in the results")
    parser.add_argument("rows", nargs="+", help="NAME=JSON")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--resolution", type=int, default=320)
    parser.add_argument("--steps-coarse", type=int, default=30)
    parser.add_argument("--steps-sos", type=int, default=60)
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--settings", default="{}", help="JSON, of all rows")
    parser.add_argument("--out", type=Path, help="folder for a sheet of pictures")
    arguments = parser.parse_args()
    scene, style = read_scene(arguments.scene).scene, load_image(arguments.style)
    cameras = read_views(arguments.cameras, scene, arguments.views, arguments.resolution)
    base = {"steps_coarse": arguments.steps_coarse, "steps_sos": arguments.steps_sos, "early_stop": False}
    base |= json.loads(arguments.settings)
    description = {"scene": arguments.scene.parent.name, "style": arguments.style.name, "views": arguments.views}
    description |= {"resolution": arguments.resolution, "steps": [arguments.steps_coarse, arguments.steps_sos]}
    description |= {"settings": json.loads(arguments.settings)}
    judge, palette = _judge(scene, cameras, style, base), quantiles(style, torch.ones(style.shape[:2]))
    rows = {"unstylized": _judged(judge, scene.sh_dc, palette)}
    colors = {"unstylized": scene.sh_dc}
    print(f"{arguments.name:28}", *(f"{name:>9}" for name in COLUMNS))
    print_row("unstylized", rows["unstylized"], COLUMNS)
    for row in arguments.rows:
        name, _, text = row.partition("=")
        results = []
        for seed in arguments.seeds.split(","):
            values = base | json.loads(text or "{}") | {"seed": int(seed)}
            colors[name], seconds = _run(scene, cameras, style, values)
            results.append({**_judged(judge, colors[name], palette), "seconds": seconds})
        rows[name] = _mean(results)
        print_row(name, rows[name], COLUMNS)
        add_pair("equal_steps", arguments.name, description, rows)
    if arguments.out:
        _write_sheet(arguments.out, arguments.name, judge, style, colors)


def _judge(scene: Scene, cameras: list[Camera], style: torch.Tensor, settings: dict[str, Any]) -> Judge:
    """Return a judge of the novel views between a job's views."""
    stylizer = Stylizer.planned(scene, cameras, style, make_settings("standard", **settings))
    novel_views = make_novel_views(stylizer)
    views = [novel_views.cameras[index] for index in novel_views.views]
    return Judge(Lpips(), style, scene, novel_views.rasterizer, views, stylizer.job.settings.background)


def _judged(judge: Judge, sh_dc: torch.Tensor, palette: torch.Tensor) -> dict[str, float]:
    judgment = judge.judge(sh_dc)
    assert judgment is not None, "no view can be judged: give more cameras, or larger views"
    sliced = [sliced_distance(judge.renders(sh_dc, view), palette) for view in judge.cameras]
    return {**asdict(judgment), "sliced": sum(sliced) / len(sliced)}


def sliced_distance(renders: list[torch.Tensor], palette: torch.Tensor) -> float:
    """Return the order-2 sliced Wasserstein distance of a view's covered pixels from a palette, in 8-bit levels.

    Args:
        renders: Renders of the view [h, w, 3], on black and on white.
        palette: Quantiles of the style's colors.
    """
    on_black, on_white = renders
    coverage = (1 - (on_white - on_black).mean(-1)).clamp(0, 1)
    return 255 * float((quantiles(on_black, coverage) - palette).square().mean().sqrt())


def quantiles(image: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return the quantiles [QUANTILES, DIRECTIONS] of an image [h, w, 3] with pixel weights [h, w]."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn((3, DIRECTIONS), generator=generator).double(), dim=0)
    ordered, order = (image.reshape(-1, 3).double() @ directions).sort(dim=0)
    cumulative = weights.reshape(-1).double()[order].cumsum(0) / weights.double().sum()
    fractions = (torch.arange(QUANTILES, dtype=torch.float64) + 0.5) / QUANTILES
    indices = torch.searchsorted(cumulative.T.contiguous(), fractions.expand(DIRECTIONS, -1).contiguous()).T
    return ordered.gather(0, indices.clamp_max(len(ordered) - 1))


def _run(
    scene: Scene, cameras: list[Camera], style: torch.Tensor, values: dict[str, Any]
) -> tuple[torch.Tensor, float]:
    """Run a job, and return its colors [N, 3] and the CPU seconds of its steps."""
    weights = _weights(values.pop("factor", None))
    stylizer = Stylizer.planned(scene, cameras, style, make_settings("standard", **values), weights=weights)
    before = time.process_time()
    while stylizer.step < stylizer.job.total_steps:
        stylizer.run_step()
    return stylizer.stylized(), time.process_time() - before


def _weights(factor: float | dict[str, float] | None) -> BackboneWeights:
    weights = load_network_weights("vgg16")
    if factor is None:
        return weights
    if isinstance(factor, dict):
        return with_scales(weights, factor)
    layers = [layer.replace("conv", "relu") for layer in weights.convolutions]
    return with_scales(weights, dict.fromkeys(layers, float(factor)))


def _mean(results: list[dict[str, float]]) -> dict[str, Any]:
    """Return means over seeds, and spreads between them."""
    mean: dict[str, Any] = {name: sum(row[name] for row in results) / len(results) for name in results[0]}
    mean["seeds"] = len(results)
    if len(results) > 1:
        values = {name: [row[name] for row in results] for name in COLUMNS}
        mean["spread"] = {name: max(each) - min(each) for name, each in values.items()}
    return mean


def _write_sheet(folder: Path, name: str, judge: Judge, style: torch.Tensor, colors: dict[str, torch.Tensor]) -> None:
    """Write each row's colors, and a contact sheet with one row of views per setting."""
    folder.mkdir(parents=True, exist_ok=True)
    rows = [(way, [judge.renders(sh_dc, view)[0] for view in judge.cameras[:SHOWN]]) for way, sh_dc in colors.items()]
    write_rows(folder / f"{name}.jpg", style, rows)
    torch.save(colors, folder / f"{name}.pt")


if __name__ == "__main__":
    main()
