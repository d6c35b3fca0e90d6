"""Estimate of how many GPUs a job should get, based on its database record before its files are read.

When the job runs, its plan decides from measured times how many of these GPUs to use, and the others are released.
Until then the job occupies all of them, so a job of a few seconds should not get eight GPUs. All constants are for H200
GPUs and come from `benchmarks.forecast`; on slower GPUs, jobs could use more GPUs than estimated here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sgsst_core.errors import SettingsError
from sgsst_core.settings import Settings, make_settings
from worker.ranks.host_memory import GAUSSIAN_BYTES, scene_bytes

#: Typical bytes per pixel of a camera's JPEG file (about 3 bits).
_PHOTO_BYTES = 0.35
#: Default longer side of views, and default ratio of height to width.
_LONGER_SIDE, _ASPECT = 1600, 0.625
#: Seconds per step: network forward and backward per pixel, by precision; rasterization per Gaussian; and a fixed time
#: for kernel launches.
_PIXEL_SECONDS = {"float32": 7e-8, "tf32": 1.6e-8, "bfloat16": 7e-9}
_GAUSSIAN_SECONDS, _FIXED_SECONDS = 1e-9, 1e-3
#: Network time of a step in phase 1, which optimizes only the coarsest scale, as a fraction of that in phase 2.
_COARSE_FRACTION = 0.1
#: Communication between ranks: bytes per second that one rank sends, and seconds of latency per message.
_LINK_BYTES, _LINK_SECONDS = 3e11, 1e-5
#: Minimum parallel efficiency with an additional GPU, and minimum duration of all steps per additional GPU in seconds
#: (starting a job takes as long). Both err toward too many GPUs, because the plan releases superfluous ones.
_MIN_EFFICIENCY, _MIN_SECONDS = 0.6, 10.0
#: Seconds before a job's first step (process, CUDA, network and plan), and bytes per second at which its files are
#: staged.
_START_SECONDS, _STAGING_BYTES = 18.0, 1e9


@dataclass(frozen=True)
class JobSize:
    """Amount of work of a job, estimated from its record.

    Attributes:
        gaussians: Number of Gaussians of the scene.
        pixels: Number of pixels per view.
        steps_coarse, steps_sos: Steps of the two phases, times views per step.
        precision: Precision of the feature network.
    """

    gaussians: float
    pixels: float
    steps_coarse: int
    steps_sos: int
    precision: str = "float32"

    def seconds(self, gpus: int = 1) -> float:
        """Return the duration of all steps on this number of GPUs, in seconds."""
        raster = _GAUSSIAN_SECONDS * self.gaussians
        network = _PIXEL_SECONDS[self.precision] * self.pixels
        overhead = _FIXED_SECONDS + self._communication(gpus)
        coarse = (raster + _COARSE_FRACTION * network) / gpus + overhead
        return self.steps_coarse * coarse + self.steps_sos * ((raster + network) / gpus + overhead)

    def _communication(self, gpus: int) -> float:
        """Return the communication time per step in seconds: images, gradients of images and colors, and statistics."""
        if gpus == 1:
            return 0.0
        sent = 2 * 12 * (self.pixels + self.gaussians)
        return 6 * (gpus - 1) * _LINK_SECONDS + sent / _LINK_BYTES

    def gpus(self, most: int) -> int:
        """Return the number of GPUs that the job should get, between 1 and `most`."""
        single, count = self.seconds(), 1
        for gpus in range(2, most + 1):
            seconds = self.seconds(gpus)
            if single < _MIN_EFFICIENCY * gpus * seconds or seconds * gpus < _MIN_SECONDS * (gpus - 1):
                break
            count = gpus
        return count


def estimated_size(parameters: Mapping[str, Any], inputs: Sequence[Mapping[str, Any]]) -> JobSize:
    """Return the size of a job, estimated from its record.

    Args:
        parameters: Stored parameters.
        inputs: `role`, `name` and `size` of each file.
    """
    settings = settings_of(parameters)
    gaussians = sum(_gaussians(entry) for entry in inputs if entry["role"] == "scene") * settings.growth
    steps = settings.views_per_step
    return JobSize(
        gaussians,
        _view_pixels(parameters, settings, inputs),
        settings.steps_coarse * steps,
        settings.steps_sos * steps,
        settings.precision,
    )


def estimated_seconds(parameters: Mapping[str, Any], inputs: Sequence[Mapping[str, Any]], gpus: int = 1) -> float:
    """Return the duration of a job from start to end in seconds, estimated from its record as by `estimated_size`."""
    staging = float(sum(entry["size"] for entry in inputs)) / _STAGING_BYTES
    return _START_SECONDS + staging + estimated_size(parameters, inputs).seconds(max(gpus, 1))


def settings_of(parameters: Mapping[str, Any]) -> Settings:
    """Return the settings of a job from its stored parameters; the defaults if another version has stored them."""
    known = Settings.model_fields.keys() - {"preset"}
    given = {name: value for name, value in parameters.items() if name in known}
    preset = parameters.get("preset", "standard")
    try:
        return make_settings(preset, **given)
    except (SettingsError, TypeError):  # stored by another version: the attempt reports the fault
        return make_settings()


def _gaussians(entry: Mapping[str, Any]) -> float:
    return scene_bytes(str(entry.get("name", "")), entry["size"]) / GAUSSIAN_BYTES


def _view_pixels(parameters: Mapping[str, Any], settings: Settings, inputs: Sequence[Mapping[str, Any]]) -> float:
    photos = [entry["size"] for entry in inputs if entry["role"] == "photos"]
    resolution = parameters.get("resolution")
    side = float(resolution) if isinstance(resolution, int) and resolution > 0 else _LONGER_SIDE
    if photos and not resolution:
        side = (sum(photos) / len(photos) / _PHOTO_BYTES / _ASPECT) ** 0.5
    if settings.max_resolution is not None:
        side = min(side, settings.max_resolution)
    return _ASPECT * side**2
