"""What a scene does not need is left out: decisions before the first iteration, each with its evidence.

The plan looks at scene, views and machine (one survey of the views, one timed probe of the feature network), decides,
and predicts seconds an iteration and peak memory. `Stylizer` follows it; the report sets what happened beside it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import psutil
import torch
from torch import Tensor

from sgsst_core.camera import Camera
from sgsst_core.partition import Rectangle
from sgsst_core.pyramid import downscale, scale_count
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.cached import CachedRasterizer
from sgsst_core.scene import Scene
from sgsst_core.settings import Settings
from sgsst_core.sos import SosLoss
from sgsst_core.survey import Survey, survey
from sgsst_core.vgg import CONTENT_LAYER

#: With this share of pixels uncovered, views are taken for those of an object scan, with an empty surround.
UNCOVERED_SHARE = 0.01
#: Largest side of the picture that the network is timed on: large enough that its rate is that of a partition tile.
PROBE_SIDE = 384
#: Bytes an optimised Gaussian costs beside the scene: colours, gradient and two moments, float32.
OPTIMISER_BYTES = 4 * 3 * 4


@dataclass(frozen=True)
class Decision:
    """One line of a plan.

    Attributes:
        item: what was looked at.
        decision: what was decided.
        reason: the evidence.
        seconds: saved in every iteration, estimated; None where that is not known.
        bytes: of memory saved; None likewise.
        error: what it may cost in accuracy; "none" for what changes no result beyond rounding.
    """

    item: str
    decision: str
    reason: str
    seconds: float | None = None
    bytes: int | None = None
    error: str = "none"


@dataclass(frozen=True)
class Prediction:
    """What the plan expects of an SOS iteration: seconds (mean over views), and the job's peak memory in bytes."""

    seconds: float
    peak_bytes: int


@dataclass(frozen=True)
class Plan:
    """What was decided for a scene.

    Attributes:
        survey: what the views show.
        seen: [N] bool, Gaussians that are rendered and optimised.
        weighted: statistics are weighted by coverage.
        steps_coarse: of phase 1; 0 where it is left out.
        decisions: for people.
        prediction: for comparison with what happens.
    """

    survey: Survey
    seen: Tensor
    weighted: bool
    steps_coarse: int
    decisions: list[Decision] = field(default_factory=list)
    prediction: Prediction | None = None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "decisions": [asdict(decision) for decision in self.decisions],
            "prediction": asdict(self.prediction) if self.prediction else None,
        }


def make_plan(
    scene: Scene, cameras: Sequence[Camera], settings: Settings, loss: SosLoss, rasterizer: Rasterizer, memory: int
) -> Plan:
    """Survey the views, time the feature network, decide.

    Args:
        cameras: at the size at which they are stylized.
        loss: the job's loss, whose network and memory budget are used.
        rasterizer: of the whole scene.
        memory: bytes that the job may plan with.

    Raises:
        CameraError: no camera sees a Gaussian.
    """
    looked = survey(scene, cameras, rasterizer)
    seen = torch.ones(len(scene), dtype=torch.bool) if settings.keep_everything else looked.total_weights > 0
    weighted = settings.position_weights == "on" or (
        settings.position_weights == "auto" and looked.uncovered_share > UNCOVERED_SHARE
    )
    several = any(scale_count(camera.height, camera.width) > 1 for camera in cameras)
    plan = Plan(looked, seen, weighted, settings.steps_coarse if several or settings.preset == "paper" else 0)
    work = _Work.of(cameras, loss, looked, weighted and not settings.keep_everything)
    rate = probe(loss, min(PROBE_SIDE, max(max(camera.width, camera.height) for camera in cameras)))
    plan.decisions.extend(_scene_decisions(scene, plan, settings))
    plan.decisions.extend(_view_decisions(cameras, plan, settings, work, rate))
    plan.decisions.extend(_network_decisions(settings, work, rate, loss))
    seconds = work.pixels * rate.both + work.again * rate.forward
    kept = 0 if settings.keep_everything else _kept_bytes(scene, cameras, settings, loss, looked.covered)
    peak = psutil.Process().memory_info().rss + min(memory, work.peak_bytes(loss) + kept) + _image_bytes(cameras)
    return Plan(looked, seen, weighted, plan.steps_coarse, plan.decisions, Prediction(seconds, int(peak)))


@dataclass(frozen=True)
class Rate:
    """Seconds a pixel: `forward` alone (with statistics), and `both` passes."""

    forward: float
    both: float


def probe(loss: SosLoss, side: int) -> Rate:
    """Time the feature network on a small picture of side x side pixels; the second of two runs counts."""
    cells = torch.rand((1, 3, side // 16 + 1, side // 16 + 1), generator=torch.Generator().manual_seed(0))
    picture = torch.nn.functional.interpolate(cells, size=(side, side), mode="bilinear")[0]
    image = picture.permute(1, 2, 0).contiguous().to(loss.network.device)
    style, view = loss.style_targets(image.flip(0), (side, side)), loss.view_target(image)
    seconds = []
    for gradient in (True, True, False):
        started = time.perf_counter()
        loss.evaluate(image, style, view, gradient=gradient)
        if loss.network.device.type == "cuda":
            torch.cuda.synchronize()
        seconds.append(time.perf_counter() - started)
    return Rate(forward=seconds[2] / side**2, both=seconds[1] / side**2)


@dataclass(frozen=True)
class _Work:
    """Pixels through the network in one SOS iteration, mean over views.

    Attributes:
        pixels: forward and backward, halos included.
        again: forward a second time, because activations do not fit.
        without_region: what `pixels` would be if uncovered pixels were not left out.
        tiles: of the full-size view with most tiles.
        largest: most pixels that are held at a time.
    """

    pixels: float
    again: float
    without_region: float
    tiles: int
    largest: int

    @staticmethod
    def of(cameras: Sequence[Camera], loss: SosLoss, looked: Survey, leave_out: bool) -> _Work:
        pixels = again = without = 0.0
        tiles = largest = 0
        held = loss.memory / loss.network.held_bytes_per_pixel()
        for index in looked.covered:
            camera = cameras[index]
            for scale in range(scale_count(camera.height, camera.width)):
                size = (camera.height >> scale, camera.width >> scale)
                region = _scaled(looked.regions[index], scale, size) if leave_out else None
                areas = [tile.outer.pixels for tile in loss.tiles(*size, region)]
                whole = [tile.outer.pixels for tile in loss.tiles(*size)]
                kept = sum(areas) if len(areas) == 1 else min(sum(areas), max(held - max(areas, default=0), 0))
                pixels += sum(areas)
                again += sum(areas) - kept
                without += sum(whole)
                tiles = max(tiles, len(areas))
                largest = max(largest, int(kept) + (max(areas, default=0) if len(areas) > 1 else 0))
        count = len(looked.covered)
        return _Work(pixels / count, again / count, without / count, tiles, largest)

    def peak_bytes(self, loss: SosLoss) -> int:
        """Activations at their peak."""
        network = loss.network
        return int(self.largest * (network.held_bytes_per_pixel() + network.working_bytes_per_pixel()))


def _scaled(region: Rectangle, scale: int, size: tuple[int, int]) -> Tensor:
    """Coverage [h, w] that is 1 in a region of the full-size view, at a scale."""
    coverage = torch.zeros((size[0] << scale, size[1] << scale))
    coverage[region.slices] = 1
    return downscale(coverage, scale)


def _scene_decisions(scene: Scene, plan: Plan, settings: Settings) -> list[Decision]:
    decisions = []
    unseen = len(scene) - int(plan.seen.sum())
    if unseen:
        change = (
            "keep their colours" if settings.unseen == "keep" else "take their neighbours' colour change at the end"
        )
        decisions.append(
            Decision(
                "unseen Gaussians",
                f"{unseen:,} of {len(scene):,} are not rendered and not optimised; they {change}",
                "their blend weights are 0 in every pixel of every view",
                bytes=unseen * OPTIMISER_BYTES,
            )
        )
    if scene.sh_degree and not settings.keep_everything:
        degree = scene.subset(plan.seen).sh_degree
        if degree < scene.sh_degree:
            decisions.append(
                Decision(
                    "spherical harmonics",
                    f"evaluated up to degree {degree}",
                    f"all coefficients of degrees {degree + 1} to {scene.sh_degree} are 0",
                    bytes=len(scene) * 3 * ((scene.sh_degree + 1) ** 2 - (degree + 1) ** 2) * 4,
                )
            )
    elif not scene.sh_degree:
        decisions.append(Decision("spherical harmonics", "no view directions are computed", "the scene has degree 0"))
    return decisions


def _view_decisions(
    cameras: Sequence[Camera], plan: Plan, settings: Settings, work: _Work, rate: Rate
) -> list[Decision]:
    decisions = []
    blind = len(cameras) - len(plan.survey.covered)
    if blind:
        decisions.append(Decision("views", f"{blind} of {len(cameras)} are left out", "they see no Gaussian"))
    share = f"{plan.survey.uncovered_share:.1%} of the views' pixels are uncovered"
    if plan.weighted and work.pixels < work.without_region:
        decisions.append(
            Decision(
                "uncovered pixels",
                f"{1 - work.pixels / work.without_region:.0%} of the pixels do not go through the network",
                share,
                seconds=(work.without_region - work.pixels) * rate.both,
            )
        )
    if plan.weighted:
        decisions.append(
            Decision(
                "position weights",
                "statistics are weighted by coverage",
                share,
                error="it is another loss than the paper's",
            )
        )
    if settings.steps_coarse and not plan.steps_coarse:
        decisions.append(
            Decision(
                "phase 1",
                f"its {settings.steps_coarse} steps are left out",
                "the coarsest scale is the only one, so that it would be the same as phase 2",
                error="the steps, which work on the same loss",
            )
        )
    return decisions


def _network_decisions(settings: Settings, work: _Work, rate: Rate, loss: SosLoss) -> list[Decision]:
    decisions = []
    if not settings.content_weight:
        decisions.append(Decision("content", "no content features are computed or kept", "its weight is 0"))
    gigabytes = f"{loss.memory / 1e9:.1f} GB for activations"
    if work.tiles <= 1:
        decisions.append(Decision("partition", "none: a view goes through the network whole", f"it fits {gigabytes}"))
    else:
        decisions.append(Decision("partition", f"up to {work.tiles} tiles a view", f"more would not fit {gigabytes}"))
    if work.again:
        reason = f"activations of {1 - work.again / work.pixels:.0%} of the pixels fit {gigabytes}"
        decisions.append(Decision("second forward", f"for {work.again / work.pixels:.0%} of the pixels", reason))
    else:
        decisions.append(
            Decision(
                "second forward",
                "none: activations are kept between statistics and gradient",
                f"they fit {gigabytes}",
                seconds=work.pixels * rate.forward,
            )
        )
    if settings.precision == "bfloat16":
        decisions.append(
            Decision(
                "precision",
                "features in bfloat16",
                "asked for",
                error="about 20 % of the gradient's norm (python -m benchmarks.sos_gradient)",
            )
        )
    return decisions


def _kept_bytes(
    scene: Scene, cameras: Sequence[Camera], settings: Settings, loss: SosLoss, covered: Sequence[int]
) -> int:
    """Blend weights and content features of all views, as far as there is no limit; the middle view stands for all."""
    middle = cameras[covered[len(covered) // 2]]
    weights = CachedRasterizer(scene, near=settings.near).operator_bytes(middle)
    value = torch.finfo(loss.network.dtype).bits // 8
    cells = sum(
        (middle.height >> scale + 3) * (middle.width >> scale + 3)
        for scale in range(scale_count(middle.height, middle.width))
    )
    content = cells * loss.network.channels(CONTENT_LAYER) * value if settings.content_weight else 0
    return (weights + content) * len(covered)


def _image_bytes(cameras: Sequence[Camera]) -> int:
    """Images of one iteration: the render, its gradient, and their float32 copies on the way."""
    return max(camera.width * camera.height for camera in cameras) * 3 * 4 * 6
