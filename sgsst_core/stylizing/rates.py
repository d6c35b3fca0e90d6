"""Rates of the feature network on this machine, in pixels per second, which earlier jobs leave behind; and estimates.

A rate serves estimates and time budgets alone. It belongs to a device, a precision, a network and a style loss, and to
a size of steps, because a GPU is slower at small ones.
"""

from __future__ import annotations

import json
import math
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import torch

from sgsst_core.errors import OutputError
from sgsst_core.features.vgg import FeatureNetwork
from sgsst_core.features.weight_files import cache_folder
from sgsst_core.files.atomic import write_json
from sgsst_core.loss.sos import make_loss
from sgsst_core.planning.time_budget import Pace, ending_seconds
from sgsst_core.settings import PlannedPrecision, Settings
from sgsst_core.style import Style
from sgsst_core.timing import wait_for

if TYPE_CHECKING:
    from sgsst_core.stylizing.job import StylizationJob

#: Activities of a step that pass pixels through the network.
NETWORK_PARTS = ("vgg_forward", "vgg_backward", "statistics", "matching", "network")
#: Sides of the image that a machine without a remembered rate is tried on: first one that compiles kernels.
_SIDES: dict[str, tuple[int, int]] = {"cpu": (32, 96), "cuda": (64, 512)}
#: Weight of the latest job in a remembered rate.
_LATEST = 0.5


@dataclass(frozen=True)
class Estimate:
    """About how long a job takes, until its own pace is known.

    Attributes:
        seconds: Seconds of a mean step on all scales.
        seconds_coarse: Seconds of a step of phase 1.
        measuring: Seconds of all measurements.
        ending: Seconds from the last step to the last file, except for measurements.
        job: Seconds of all steps and measurements.
    """

    seconds: float
    seconds_coarse: float
    measuring: float
    ending: float
    job: float


def estimate(job: StylizationJob) -> Estimate:
    """Estimate the seconds of a job from the rate that earlier jobs have left behind, and from its survey."""
    plan, settings, cameras = job.plan, job.settings, [job.views.cameras[index] for index in job.views.covered]
    pixels = sum(camera.width * camera.height for camera in cameras) / len(cameras)
    pace = Pace(Rates(job.network, plan.precision, settings).rate(plan.work.sos), job.survey_seconds, pixels)
    views = settings.views_per_step / plan.ranks
    sos, coarse = (pace.step(work, pixels, views) for work in (plan.work.sos, plan.work.coarse))
    measuring = plan.work.measuring / pace.rate
    seconds = plan.steps_coarse * coarse + settings.steps_sos * sos + measuring
    return Estimate(sos, coarse, measuring, ending_seconds(len(job.scene)), min(seconds, settings.within or seconds))


class Rates:
    """Rates of a network on the device of a job, by the number of pixels in a step."""

    def __init__(self, network: FeatureNetwork, precision: PlannedPrecision, settings: Settings) -> None:
        device = network.device
        name = torch.cuda.get_device_name(device) if device.type == "cuda" else f"{torch.get_num_threads()} threads"
        self._network, self._settings = network, settings
        size = f"{network.name} of {network.held_bytes_per_pixel():.0f} bytes per pixel"
        self._key = f"{name}, {precision}, {size}, {settings.style_loss}"
        self._path = cache_folder() / "rates.json"

    def rate(self, pixels: float) -> float:
        """Return the rate of steps with so many pixels: the nearest remembered one, or that of a small image."""
        own, size = _read(self._path).get(self._key, {}), _size(pixels)
        if own:
            return own[min(own, key=lambda known: abs(int(known) - int(size)))]
        return self._tried()

    def remember(self, pixels: float, rate: float) -> None:
        """Remember the rate of a job's steps; one that cannot be written is forgotten."""
        rates, size = _read(self._path), _size(pixels)
        own = rates.setdefault(self._key, {})
        own[size] = math.exp((1 - _LATEST) * math.log(own.get(size, rate)) + _LATEST * math.log(rate))
        with suppress(OSError, OutputError):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            write_json(self._path, rates)

    def _tried(self) -> float:
        """Return the rate of one pass over a small image, in less than half a second."""
        settings, seconds = self._settings.model_copy(update={"scales": (), "stroke_depth": False}), 1.0
        loss = make_loss(self._network, settings, 1 << 40, content_weight=0)
        for side in _SIDES[self._network.device.type]:
            image = torch.rand((side, side, 3), generator=torch.Generator().manual_seed(0)).to(self._network.device)
            style, view = loss.targets.of_style(Style.of(image.cpu()), (side, side)), loss.targets.of_view(image)
            started = time.perf_counter()
            loss.evaluate(image, style, view, [0])
            wait_for(self._network.device)
            seconds = time.perf_counter() - started
        return side * side / seconds


def _size(pixels: float) -> str:
    return str(round(math.log2(max(pixels, 1.0))))


def _read(path: Path) -> dict[str, dict[str, float]]:
    """Return the remembered rates; none if there is no file or it cannot be used."""
    try:
        stored = json.loads(path.read_text("utf-8"))
        return {
            key: {str(int(size)): float(rate) for size, rate in own.items() if 0 < float(rate) < math.inf}
            for key, own in stored.items()
        }
    except (OSError, ValueError, AttributeError, TypeError):
        return {}
