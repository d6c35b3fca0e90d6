"""How many GPUs a job is worth, from what its record tells: before anybody has read its files or planned it.

The plan of a job, made with measured times, has the last word, and GPUs that it leaves out go back. Until then the job
holds what it was given, so that one of a few seconds should not be given eight. Everything here is an estimate for one
H200, made from `benchmarks.forecast`; where a machine is slower, all jobs are worth more than this says.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sgsst_core.errors import SettingsError
from sgsst_core.settings import Settings, make_settings
from worker.ranks.host_memory import GAUSSIAN_BYTES, scene_bytes

#: Bytes of a pixel of a photo as cameras save them (JPEG, 3 bits).
_PHOTO_BYTES = 0.35
#: Longer side of views of which nothing is known, and height to width of those of which only that is known.
_LONGER_SIDE, _ASPECT = 1600, 0.625
#: Seconds of a step: a pixel through the network forth and back by precision, a Gaussian, launches of the host.
_PIXEL_SECONDS = {"float32": 5.5e-8, "tf32": 1.6e-8, "bfloat16": 9e-9}
_GAUSSIAN_SECONDS, _FIXED_SECONDS = 2e-9, 2.1e-3
#: A step of phase 1, on the coarsest scale alone: what it takes of a pixel of the whole view.
_COARSE_SHARE = 0.1
#: What ranks tell each other: bytes a second that one sends, seconds of a message from one to the next.
_LINK_BYTES, _LINK_SECONDS = 3e11, 1e-5
#: Of what a GPU could do, the least that it does where it is worth having; and seconds of steps that are not worth
#: dividing further: a job takes as long to start. Cautious on either side, since the plan gives back what is too much.
_LEAST_SHARE, _LEAST_SECONDS = 0.6, 10.0
#: Seconds before a job's first step: process, CUDA, network and plan; bytes of its files a second from the store.
_START_SECONDS, _STAGING_BYTES = 18.0, 1e9


@dataclass(frozen=True)
class JobSize:
    """What a job will have to do, as far as its record tells.

    Attributes:
        gaussians: of the scene.
        pixels: of a view.
        steps_coarse, steps_sos: of its phases; every view of a step counts.
        precision: of the feature network.
    """

    gaussians: float
    pixels: float
    steps_coarse: int
    steps_sos: int
    precision: str = "float32"

    def seconds(self, gpus: int = 1) -> float:
        """Of all steps, on so many GPUs."""
        raster = _GAUSSIAN_SECONDS * self.gaussians
        network = _PIXEL_SECONDS[self.precision] * self.pixels
        beside = _FIXED_SECONDS + self._talking(gpus)
        coarse = (raster + _COARSE_SHARE * network) / gpus + beside
        return self.steps_coarse * coarse + self.steps_sos * ((raster + network) / gpus + beside)

    def _talking(self, gpus: int) -> float:
        """Seconds of a step in which GPUs wait for each other: the image there and its gradient back, the colors'
        gradient, statistics.
        """
        if gpus == 1:
            return 0.0
        moved = 2 * 12 * (self.pixels + self.gaussians)
        return 6 * (gpus - 1) * _LINK_SECONDS + moved / _LINK_BYTES

    def gpus(self, most: int) -> int:
        """How many it is worth having: at least one, at most so many."""
        alone, found = self.seconds(), 1
        for gpus in range(2, most + 1):
            seconds = self.seconds(gpus)
            if alone < _LEAST_SHARE * gpus * seconds or seconds * gpus < _LEAST_SECONDS * (gpus - 1):
                break
            found = gpus
        return found


def estimated_size(parameters: Mapping[str, Any], inputs: Sequence[Mapping[str, Any]]) -> JobSize:
    """The size of a job by its record.

    Args:
        parameters: as they were stored.
        inputs: `role`, `name` and `size` of each file.
    """
    settings = _settings(parameters)
    gaussians = sum(_gaussians(entry) for entry in inputs if entry["role"] == "scene") * settings.refine
    steps = settings.views_per_step
    return JobSize(
        gaussians,
        _view_pixels(parameters, settings, inputs),
        settings.steps_coarse * steps,
        settings.steps_sos * steps,
        settings.precision,
    )


def estimated_seconds(parameters: Mapping[str, Any], inputs: Sequence[Mapping[str, Any]], gpus: int = 1) -> float:
    """From a job's start to its end, by its record; as `estimated_size` otherwise."""
    staging = float(sum(entry["size"] for entry in inputs)) / _STAGING_BYTES
    return _START_SECONDS + staging + estimated_size(parameters, inputs).seconds(max(gpus, 1))


def _settings(parameters: Mapping[str, Any]) -> Settings:
    known = Settings.model_fields.keys() - {"preset", "keep"}
    given = {name: value for name, value in parameters.items() if name in known}
    preset = parameters.get("preset", "standard")
    try:
        return make_settings(preset, **given)
    except (SettingsError, TypeError):  # stored by another version: the attempt will say what is wrong
        return make_settings()


def _gaussians(entry: Mapping[str, Any]) -> float:
    return scene_bytes(str(entry.get("name", "")), entry["size"]) / GAUSSIAN_BYTES


def _view_pixels(parameters: Mapping[str, Any], settings: Settings, inputs: Sequence[Mapping[str, Any]]) -> float:
    photos = [entry["size"] for entry in inputs if entry["role"] == "photos"]
    asked = parameters.get("resolution")
    side = float(asked) if isinstance(asked, int) and asked > 0 else _LONGER_SIDE
    if photos and not asked:
        side = (sum(photos) / len(photos) / _PHOTO_BYTES / _ASPECT) ** 0.5
    if settings.max_resolution is not None:
        side = min(side, settings.max_resolution)
    return _ASPECT * side**2
