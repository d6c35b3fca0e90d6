"""Comparison of settings after the same number of steps, on novel views, by a network that is not part of the loss.

python -m benchmarks.equal_steps SCENE CAMERAS|orbit:N STYLE NAME 'ROW={"content_weight": 3000}' 'ROW=...'

Each row is a JSON object of settings that override the standard preset, in float32 unless it says otherwise. The
additional setting `factor` scales VGG16's features: a number scales all layers (1 = unchanged), an object individual
layers ({"relu1_1": 16, "relu2_1": 8}). A layer without a factor takes that of the previous layer. The additional
setting `rounded` emulates a GPU: a float32 network rounds as in "tf32" or "float16". With the additional setting
`as_long_as`, which names a row before, the steps of both phases are multiplied by one factor, with which they take as
many CPU seconds as the steps of that row.

Results are added to benchmarks/results/equal_steps.json, under NAME. With several seeds, figures are means, and
"spread" is the largest difference between two seeds. "loss" is the float32 loss of the job's own views, relative to the
unstylized scene. "seconds" are the CPU seconds of the steps, "counted" their number times the median of those that
evaluate the same scales. "sliced" is the sliced Wasserstein distance between the colors of pixels and style, in 8-bit
levels; no loss term and no color initialization optimizes it.

With --region SPEC, the cameras are those that show the region. The additional setting `region_content_weight` is its
own content weight, and "region_content" is "content" over its pixels alone, on black.
"""

import json
import sys
import time
from collections import defaultdict
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from statistics import median
from typing import Any
from unittest import mock

import torch
from torch import Tensor

from benchmarks.common import add_pair, input_parser, parse, read_inputs, read_views
from sgsst_core import Stylizer, make_settings
from sgsst_core.bench.variants import judged_row
from sgsst_core.constants import NEAR
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.features.vgg import with_scales
from sgsst_core.files.scene_file import SceneFile, read_scene
from sgsst_core.quality.judge import Judge, Lpips
from sgsst_core.quality.measure import Float32Reference, make_judge, make_novel_views
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.regions import Region, RegionMaps, Regions
from sgsst_core.report.images import write_grid
from sgsst_core.scales import EVEN
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from tests.rounding import RoundedToFloat16, RoundedToTf32
from worker.inputs import select
from worker.options import parse_selection

#: Name of the row of the scene's own colors.
UNSTYLIZED = "unstylized"
COLUMNS = (
    "loss",
    "style",
    "interior_style",
    "sliced_features",
    "color_distance",
    "sliced",
    "content",
    "region_content",
    "background_sensitivity",
    "seconds",
    "counted",
    "steps",
)
#: Number of color directions of the sliced distance, and number of quantiles along each.
DIRECTIONS, QUANTILES = 64, 1024
#: Minimum fraction of a view's pixels that must belong to the region of `--region`.
LEAST_REGION = 0.01
#: Networks of the setting `rounded`.
ROUNDED = {"tf32": RoundedToTf32, "float16": RoundedToFloat16}


def main() -> None:
    """Run all rows, then print and store the results."""
    parser = input_parser(__doc__)
    parser.add_argument("name", help="of the pair, in the results")
    parser.add_argument("rows", nargs="+", help="NAME=JSON")
    parser.add_argument("--views", type=int, default=8)
    parser.add_argument("--resolution", type=int, default=320)
    parser.add_argument("--steps-coarse", type=int, default=30)
    parser.add_argument("--steps-sos", type=int, default=60)
    parser.add_argument("--seeds", default="0")
    parser.add_argument("--settings", default="{}", help="JSON, of all rows")
    parser.add_argument("--region", help="SPEC of a region, as in `sgsst stylize --region NAME:SPEC`")
    parser.add_argument("--out", type=Path, help="folder for a contact sheet")
    arguments = parse(parser)
    scene, cameras, style = read_inputs(arguments, arguments.views, arguments.resolution)
    region = JudgedRegion(read_scene(arguments.scene), arguments.region) if arguments.region else None
    if region:
        every = read_views(arguments.cameras, scene, sys.maxsize, arguments.resolution)
        cameras = spread([camera for camera in every if region.is_shown_by(camera)], arguments.views)
    base = {"steps_coarse": arguments.steps_coarse, "steps_sos": arguments.steps_sos, "early_stop": False}
    base |= json.loads(arguments.settings)
    description = {"scene": arguments.scene.parent.name, "style": arguments.style.name, "views": arguments.views}
    description |= {"resolution": arguments.resolution, "steps": [arguments.steps_coarse, arguments.steps_sos]}
    description |= {"settings": json.loads(arguments.settings)}
    description |= {"region": arguments.region} if region else {}
    judge, exact = judge_and_loss(scene, cameras, style, base)
    wanted = quantiles(style, torch.ones(style.shape[:2]))
    rows = {name: json.loads(text or "{}") for name, _, text in (row.partition("=") for row in arguments.rows)}
    paces: dict[tuple[str, int], Pace] = {}

    def run(row: str, seed: int) -> tuple[Tensor, dict[str, float]]:
        values = base | rows[row] | {"seed": seed}
        own = values.pop("region_content_weight", None)
        regions = region.regions(own) if region and own is not None else None
        if (other := values.pop("as_long_as", None)) is not None:
            values |= steps_as_long_as(paces[other, seed], values["steps_coarse"], values["steps_sos"])
        colors, paces[row, seed] = _run(scene, cameras, style, values, regions)
        figures = {"loss": loss(colors) / start, **_judged(judge, colors, wanted, region)}
        return colors, figures | seconds_of(paces[row, seed])

    def loss(colors: Tensor) -> float:
        terms = exact.evaluate(exact.views.covered, colors)
        return EVEN.mean({scale: each.total for scale, each in terms.items()})

    start = loss(scene.sh_dc)
    colors, judgments = {UNSTYLIZED: scene.sh_dc}, {UNSTYLIZED: _judged(judge, scene.sh_dc, wanted, region)}
    print(f"{arguments.name:28}", *(f"{name:>9}" for name in COLUMNS))
    _print_row(UNSTYLIZED, judgments[UNSTYLIZED])
    for row in rows:
        results = []
        for seed in arguments.seeds.split(","):
            colors[row], figures = run(row, int(seed))
            results.append(figures)
        judgments[row] = _mean(results)
        _print_row(row, judgments[row])
        add_pair(
            "equal_steps",
            arguments.name,
            description,
            judgments,
            presets=["standard"],
            scenes={description["scene"]: arguments.scene},
        )
    if arguments.out:
        arguments.out.mkdir(parents=True, exist_ok=True)
        sheet = [judged_row(judge, row, sh_dc) for row, sh_dc in colors.items()]
        write_grid(arguments.out / f"{arguments.name}.jpg", [[("style", style)], *sheet])


class JudgedRegion:
    """Region of a scene whose content is judged by itself.

    Args:
        file: Scene.
        text: SPEC of the region.
    """

    def __init__(self, file: SceneFile, text: str) -> None:
        self._labels = select(parse_selection(text, "--region"), file, [], NEAR).to(torch.uint8)
        self._maps = RegionMaps(self._labels, (1,), make_rasterizer("cpu", file.scene))
        self._lpips = Lpips()

    def is_shown_by(self, camera: Camera) -> bool:
        """Return whether the region takes at least `LEAST_REGION` of a view."""
        return float(self._maps.render(camera).mean()) >= LEAST_REGION

    def regions(self, content_weight: float) -> Regions:
        """Return the regions of a job in which this one has its own content weight."""
        return Regions((Region("rest"), Region("region", content_weight=content_weight)), self._labels)

    def content(self, judge: Judge, sh_dc: Tensor) -> float:
        """Return the LPIPS of colors [N, 3] against the unstylized scene, mean over the region's pixels on black."""
        distance = pixels = 0.0
        for camera in judge.cameras:
            images = [judge.renders(colors, camera)[0] for colors in (sh_dc, judge.scene.sh_dc)]
            fraction = self._maps.render(camera)[..., 0].double()
            distance += float((self._lpips.distance(*images) * fraction).sum())
            pixels += float(fraction.sum())
        assert pixels, "no judged view shows the region: choose another region, or more cameras"
        return distance / pixels


def judge_and_loss(
    scene: Scene, cameras: list[Camera], style: Tensor, settings: dict[str, Any]
) -> tuple[Judge, Float32Reference]:
    """Return a judge of the novel views between a job's views, and the exact loss of its views."""
    values = {"precision": "float32", **settings}
    stylizer = Stylizer.planned(scene, cameras, style, make_settings("standard", **values), weights=_weights(None))
    return make_judge(stylizer, make_novel_views(stylizer), Lpips()), Float32Reference(stylizer)


def _judged(judge: Judge, sh_dc: Tensor, wanted: Tensor, region: JudgedRegion | None) -> dict[str, float]:
    sliced = [sliced_distance(judge.renders(sh_dc, view), wanted) for view in judge.cameras]
    own = {"region_content": region.content(judge, sh_dc)} if region else {}
    return {**judged(judge, sh_dc), **own, "sliced": sum(sliced) / len(sliced)}


def sliced_distance(renders: list[Tensor], wanted: Tensor) -> float:
    """Return the order-2 sliced Wasserstein distance of a view's covered pixels from a style, in 8-bit levels.

    Args:
        renders: Renders of the view [h, w, 3], on black and on white.
        wanted: Quantiles of the style's colors.
    """
    on_black, on_white = renders
    coverage = (1 - (on_white - on_black).mean(-1)).clamp(0, 1)
    return 255 * float((quantiles(on_black, coverage) - wanted).square().mean().sqrt())


def quantiles(image: Tensor, weights: Tensor) -> Tensor:
    """Return the quantiles [QUANTILES, DIRECTIONS] of an image [h, w, 3] with pixel weights [h, w]."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.nn.functional.normalize(torch.randn((3, DIRECTIONS), generator=generator).double(), dim=0)
    ordered, order = (image.reshape(-1, 3).double() @ directions).sort(dim=0)
    cumulative = weights.reshape(-1).double()[order].cumsum(0) / weights.double().sum()
    fractions = (torch.arange(QUANTILES, dtype=torch.float64) + 0.5) / QUANTILES
    indices = torch.searchsorted(cumulative.T.contiguous(), fractions.expand(DIRECTIONS, -1).contiguous()).T
    return ordered.gather(0, indices.clamp_max(len(ordered) - 1))


#: CPU seconds of the steps of a run, by the scales that they evaluate.
Pace = dict[tuple[int, ...], list[float]]


def seconds_of(pace: Pace) -> dict[str, float]:
    """Return the figures of a run's steps: their seconds, the same as counted, and their number."""
    seconds, steps = sum(map(sum, pace.values())), sum(map(len, pace.values()))
    return {"seconds": seconds, "counted": sum(len(own) * median(own) for own in pace.values()), "steps": steps}


def steps_as_long_as(pace: Pace, steps_coarse: int, steps_sos: int) -> dict[str, int]:
    """Return the steps of both phases, in their proportion, that take as long as a run if each evaluates all scales."""
    coarse, every = (median(pace[scales]) for scales in (min(pace, key=len), max(pace, key=len)))
    factor = seconds_of(pace)["counted"] / (steps_coarse * coarse + steps_sos * every)
    return {"steps_coarse": round(factor * steps_coarse), "steps_sos": round(factor * steps_sos)}


def _run(
    scene: Scene, cameras: list[Camera], style: Tensor, values: dict[str, Any], regions: Regions | None
) -> tuple[Tensor, Pace]:
    """Run a job, and return its colors [N, 3] and its pace."""
    weights = _weights(values.pop("factor", None))
    network = ROUNDED.get(values.pop("rounded", None))
    settings = make_settings("standard", **{"precision": "float32", **values})
    with mock.patch("sgsst_core.planning.plan.FeatureNetwork", network) if network else nullcontext():
        stylizer = Stylizer.planned(scene, cameras, style, settings, weights=weights, regions=regions)
    pace: Pace = defaultdict(list)
    for _ in range(stylizer.job.total_steps):
        before = time.process_time()
        evaluated = stylizer.run_step().evaluated
        pace[evaluated].append(time.process_time() - before)
    return stylizer.stylized(), pace


def _weights(factor: float | dict[str, float] | None) -> BackboneWeights:
    weights = load_network_weights("vgg16")
    if factor is None:
        return weights
    if isinstance(factor, dict):
        return with_scales(weights, factor)
    layers = [layer.replace("conv", "relu") for layer in weights.convolutions]
    return with_scales(weights, dict.fromkeys(layers, float(factor)))


def judged(judge: Judge, sh_dc: Tensor) -> dict[str, float]:
    """Return the judgment of colors [N, 3], without measures that have no value."""
    judgment = judge.judge(sh_dc)
    assert judgment is not None, "no view can be judged: give more cameras, or larger views"
    return {name: value for name, value in asdict(judgment).items() if value is not None}


def _mean(results: list[dict[str, float]]) -> dict[str, Any]:
    mean: dict[str, Any] = {name: sum(row[name] for row in results) / len(results) for name in results[0]}
    mean["seeds"] = len(results)
    if len(results) > 1:
        values = {name: [row[name] for row in results] for name in results[0]}
        mean["spread"] = {name: max(each) - min(each) for name, each in values.items()}
    return mean


def _print_row(name: str, row: dict[str, Any]) -> None:
    """Print the figures of one row in columns; missing figures stay blank."""
    print(f"{name:28}", *(f"{row[column]:9.3f}" if column in row else " " * 9 for column in COLUMNS), flush=True)


if __name__ == "__main__":
    main()
