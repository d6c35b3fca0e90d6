"""Methods side by side on four scenes and three paintings, by the judge and by the consistency that papers report.

python -m benchmarks.methods run DATA
python -m benchmarks.methods show [--pairs]

`run` needs the folder of `benchmarks.cross_validation`, whose views, novel views and judge it uses. All methods change
the DC colors of the same scene through the same rasterizer and VGG16, from the same views. "colors" maps them linearly,
so that the mean and covariance of the views' pixels become the style's. "NNFM" follows Zhang et al., "ARF" (ECCV 2022):
this map, nearest-neighbor feature matching with the third block at full size and a content loss on the recolored scene
for ten rounds of the views, then the map again, with the optimizer of `standard`. `paper` has a fraction of its 20,000
steps.

Consistency is measured on a path of neighboring views: halfway between the cameras of a file, or every 6 degrees of an
orbit. Each pair is stored in benchmarks/results/methods.json when it is done; what is stored of the same code is not
run again.
"""

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from statistics import fmean
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor

from benchmarks.common import RESULTS, add_pair, is_of_this_code, parse, read_views
from benchmarks.cross_validation import DEMO, SCENES, inputs
from benchmarks.equal_steps import UNSTYLIZED, judged
from sgsst_core import Stylizer, load_image, make_settings
from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.features.network_weights import load_network_weights
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.quality.judge import Judge, Lpips, shown
from sgsst_core.quality.novel_views import (
    LONG_RANGE,
    SHORT_RANGE,
    Warp,
    consistency,
    expected_depth,
    find_warp,
    neighbors,
    view_pairs,
)
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, between
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import PresetName
from sgsst_core.style import color_moments, square_root

PAINTINGS = ("starry_night", "great_wave", "vallotton_woodcut")
PAIRS = [f"{scene}, {painting}" for painting in PAINTINGS for scene in (*SCENES, DEMO)]
COLORS, NNFM = "colors", "NNFM"
#: Settings of all methods, and of those on several scales: two of views of 192x144 pixels.
COMMON = {"precision": "winograd", "early_stop": False, "measure": 0}
SEVERAL_SCALES = {"coarsest_side": 96}
#: Preset and settings of each method that optimizes.
METHODS: dict[str, tuple[PresetName, dict[str, Any]]] = {
    "preview": ("preview", SEVERAL_SCALES),
    "standard": ("standard", SEVERAL_SCALES),
    "paper": ("paper", {"steps_coarse": 60, "steps_sos": 60, **SEVERAL_SCALES}),
    NNFM: ("standard", {"style_loss": "nnfm", "warm_start": False, "scale_sampling": 1, "steps_sos": 120}),
}
#: Cameras on a full circle of the path around a scene without cameras of its own.
CIRCLE = "orbit:60"
#: Longer side of the views in pixels, and pairs of views that are compared per range.
RESOLUTION, COMPARED = 192, 3
#: Title and digits of each figure of the table.
COLUMNS = {
    "style": ("style", 3),
    "interior_style": ("interior style", 3),
    "sliced_features": ("sliced features", 3),
    "color_distance": ("color distance", 1),
    "content": ("content", 3),
    "ssim": ("SSIM", 3),
    "short_rmse": ("short-range RMSE", 3),
    "short_lpips": ("short-range LPIPS", 3),
    "long_rmse": ("long-range RMSE", 3),
    "long_lpips": ("long-range LPIPS", 3),
    "seconds": ("CPU s", 0),
}

#: Presets whose settings the figures depend on.
PRESETS: tuple[PresetName, ...] = ("preview", "standard", "paper")

Rows = dict[str, dict[str, float]]


def main() -> None:
    """Run pairs, or print tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    ways.add_parser("run").add_argument("data", type=Path, help="folder with scenes/ and styles/")
    ways.add_parser("show").add_argument("--pairs", action="store_true", help="also a table of each pair")
    arguments = parse(parser)
    if arguments.way == "run":
        for pair in PAIRS:
            if not is_of_this_code(_pairs().get(pair, {}).get("commit", "")):
                rows = run(arguments.data, pair, RESOLUTION)
                add_pair("methods", pair, {"resolution": RESOLUTION}, rows, presets=PRESETS)
                print(f"## {pair}\n\n{table([rows])}\n", flush=True)
    print(table(list(stored().values())))
    for pair, rows in stored().items() if arguments.way == "show" and arguments.pairs else ():
        print(f"\n## {pair}\n\n{table([rows])}")


def stored() -> dict[str, Rows]:
    """Return the stored rows of each pair."""
    return {pair: each["rows"] for pair, each in _pairs().items()}


def _pairs() -> dict[str, Any]:
    path = RESULTS / "methods.json"
    return json.loads(path.read_text(encoding="utf-8"))["pairs"] if path.exists() else {}


def run(data: Path, pair: str, resolution: int, **settings: Any) -> Rows:
    """Run and judge all methods on a pair; `settings` override those of the methods."""
    name, painting = pair.split(", ")
    scene, cameras, novel = inputs(data, name, resolution)
    style = load_image(data / "styles" / f"{painting}.jpg")
    judge = Judge(Lpips(), style, scene, make_rasterizer("cpu", scene), novel)
    path = ViewPath(scene, path_cameras(data, name, scene, cameras, resolution))
    rows: Rows = {}

    def add(method: str, sh_dc: Tensor, started: float) -> None:
        seconds = time.process_time() - started
        figures = judged(judge, sh_dc) | path.consistency(sh_dc) | {"seconds": seconds}
        rows[method] = {key: float(f"{value:.5g}") for key, value in figures.items()}

    add(UNSTYLIZED, scene.sh_dc, time.process_time())
    started = time.process_time()
    colors = recolored(scene, cameras, style)
    add(COLORS, colors, started)
    for method in METHODS:
        started, start = time.process_time(), replace(scene, sh_dc=colors) if method == NNFM else scene
        stylizer = stylizer_of(method, start, cameras, style, settings)
        for _ in range(stylizer.job.total_steps):
            stylizer.run_step()
        result = stylizer.stylized()
        if method == NNFM:
            result = recolored(replace(scene, sh_dc=result), cameras, style)
        add(method, result, started)
    return rows


def recolored(scene: Scene, cameras: Sequence[Camera], style: Tensor) -> Tensor:
    """Return the DC colors [N, 3] by the linear map that gives the pixels of views the style's mean and covariance."""
    rasterizer = make_rasterizer("cpu", scene)
    images = [rasterizer.render(scene_colors(scene, camera), camera).clamp(0, 1).flatten(0, 1) for camera in cameras]
    coverage = torch.cat([rasterizer.coverage(camera).flatten() for camera in cameras])
    mean, covariance = color_moments(torch.cat(images), coverage)
    wanted_mean, wanted = color_moments(style.flatten(0, 1))
    matrix = square_root(wanted) @ square_root(covariance).inverse()
    colors = (COLOR_OFFSET + SH_C0 * scene.sh_dc.double() - mean) @ matrix.T + wanted_mean
    return ((colors.clamp(0, 1) - COLOR_OFFSET) / SH_C0).float()


def stylizer_of(
    method: str, scene: Scene, cameras: Sequence[Camera], style: Tensor, settings: dict[str, Any]
) -> Stylizer:
    """Return the stylizer of a method."""
    preset, own = METHODS[method]
    chosen = make_settings(preset, **{**COMMON, **own, **settings})
    return Stylizer.planned(scene, cameras, style, chosen, weights=load_network_weights("vgg16"))


def path_cameras(data: Path, name: str, scene: Scene, own: list[Camera], resolution: int) -> list[Camera]:
    """Return neighboring views between the cameras of a scene, in order; the demo's cameras are `own`."""
    if name != DEMO:
        source = SCENES[name][1]
        source = CIRCLE if source.startswith("orbit:") else str(data / "scenes" / source)
        own = read_views(source, scene, sys.maxsize, resolution)
    return [between(*pair) for pair in neighbors(own)]


#: Layers of VGG16 that LPIPS compares, and the file of their weights.
_VGG_LAYERS = ("relu1_2", "relu2_2", "relu3_3", "relu4_3", "relu5_3")
_VGG_HEADS = Path(__file__).with_name("lpips") / "vgg.safetensors"


class VggLpips(Lpips):
    """LPIPS with VGG16, as papers report consistency.

    Features are in other units than torchvision's, which makes no difference, since they are scaled to unit length.
    """

    network = "vgg"

    def __init__(self, dtype: torch.dtype = torch.float32) -> None:
        self.dtype, self.device = dtype, torch.device("cpu")
        heads = load_file(_VGG_HEADS)
        self._heads = [heads[f"linear{layer}.weight"].to(dtype) for layer in range(1, 6)]
        self._vgg = FeatureNetwork(load_network_weights("vgg16"), _VGG_LAYERS, dtype)

    def features(self, image: Tensor) -> list[Tensor]:
        """Return the features [h, w, c] of the five layers for an image [H, W, 3] with values 0 to 1."""
        features = self._vgg.forward(image, cache=False).features
        return [features[layer] for layer in _VGG_LAYERS]


class ViewPath:
    """Consecutive views of a scene, whose consistency is measured as papers do, but warped by the scene's depth."""

    def __init__(self, scene: Scene, cameras: list[Camera]) -> None:
        self._scene, self._cameras = scene, cameras
        self._rasterizer, self._lpips = make_rasterizer("cpu", scene), VggLpips()
        self._warp = cache(self._find_warp)

    def _find_warp(self, first: int, second: int) -> Warp:
        one, other = self._cameras[first], self._cameras[second]
        depth, others = (expected_depth(self._scene, camera, self._rasterizer) for camera in (one, other))
        return find_warp(others, other, depth, one)

    def consistency(self, sh_dc: Tensor) -> dict[str, float]:
        """Return the figures of colors [N, 3] at both ranges; a range without comparable views has only `compared`."""
        scene, figures = replace(self._scene, sh_dc=sh_dc), dict[str, float]()

        def image(index: int) -> Tensor:
            camera = self._cameras[index]
            return shown(self._rasterizer.render(scene_colors(scene, camera), camera), camera, self._rasterizer.device)

        for reach, gap in (("short", SHORT_RANGE), ("long", LONG_RANGE)):
            pairs = view_pairs(len(self._cameras), gap, COMPARED)
            measured = consistency(gap, pairs, image, self._warp, self._lpips)
            values = {"compared": measured.compared, "rmse": measured.rmse, "lpips": measured.lpips}
            figures |= {f"{reach}_{key}": value for key, value in values.items() if value is not None}
        return figures


def table(pairs: Sequence[Rows]) -> str:
    """Return a Markdown table of each method's figures, as means over pairs."""
    titles = [f"mean of {len(pairs)}" if len(pairs) > 1 else "method", *(title for title, _ in COLUMNS.values())]
    lines = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    for method in pairs[0] if pairs else ():
        means = {key: [rows[method][key] for rows in pairs if key in rows[method]] for key in COLUMNS}
        cells = [f"{fmean(means[key]):.{digits}f}" if means[key] else "" for key, (_, digits) in COLUMNS.items()]
        lines.append(f"| {' | '.join([method, *cells])} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
