"""Time budget of a job: the resolution, the views and the steps that fit, and how long a plan takes.

Views are as large as lets enough steps fit (`_ENOUGH`): at equal time, that leaves less of the loss than all steps on
smaller views. What is chosen here starts the job; its own pace then decides the number of steps (`stylizing.loop`).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from sgsst_core.progress import Decision, duration
from sgsst_core.scales import ScaleWeights, scale_count
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.settings import Settings

#: Function that returns the seconds that are left of a time budget.
SecondsLeft = Callable[[], float]
T = TypeVar("T")

#: Longer sides in pixels are multiples of `_STEP`, and at least `_LEAST_SIDE`.
_STEP, _LEAST_SIDE = 32, 96
#: Fraction of the steps, and number of steps of phase 2, that are worth more than larger views, if the longer side has
#: `_ENOUGH_SIDE` pixels; proportionally less on smaller views (docs/quality.md, "Why the defaults are what they are").
_ENOUGH, _ENOUGH_STEPS, _ENOUGH_SIDE = 0.25, 60, 480
#: Time of a step of phase 1 relative to one on all scales, if there are several.
_COARSE = 0.5
#: Passes of the rasterizer in a step, relative to that of the survey.
_RASTER_PASSES = 2.0
#: Fraction of the time of a pass of the rasterizer that is in proportion to the pixels; the rest is for the Gaussians.
_OF_PIXELS = 0.5
#: Factor of the longer time whose gain is shown.
LONGER = 4
#: Factor by which a choice may exceed the budget: the pace of the job then leaves out steps, but adds none.
_OPTIMISM = 1.15
#: Time from the last step to the last file written: constant seconds for images and report, and seconds per Gaussian
#: for the neighbor search and for writing (measured with 4 million Gaussians on two cores; an estimate elsewhere).
_ENDING_SECONDS, _ENDING_SECONDS_PER_GAUSSIAN = 3.0, 4e-6


def ending_seconds(gaussians: int) -> float:
    """Return the seconds from the last step of a job to its last file, except for measurements."""
    return _ENDING_SECONDS + _ENDING_SECONDS_PER_GAUSSIAN * gaussians


@dataclass(frozen=True)
class Pace:
    """Speed of passes on a machine.

    Attributes:
        rate: Function that returns how many pixels pass through the network, forward and backward, per second, given
            those of a step; small steps are slower.
        view: Seconds of the rasterizer's pass over a view.
        pixels: Pixels of these views, mean.
        portion: Fraction of a view's pixels that pass through the network.
    """

    rate: Callable[[float], float]
    view: float = 0.0
    pixels: float = 1.0
    portion: float = 1.0

    def survey(self, pixels: float) -> float:
        """Return the seconds to survey a view with so many pixels."""
        return self.view * (1 - _OF_PIXELS + _OF_PIXELS * pixels / self.pixels)

    def step(self, network: float, pixels: float, views: float = 1.0) -> float:
        """Return the seconds of a step, given its pixels through the network, and those of each of its views."""
        return network / self.rate(network) + _RASTER_PASSES * views * self.survey(pixels)


@dataclass(frozen=True)
class TimeChoice:
    """Choice of a time budget.

    Attributes:
        resolution: Longer side of the views in pixels.
        views: Indices of the chosen views.
        steps_coarse, steps_sos: Steps of both phases.
        seconds: Predicted seconds of the steps and everything after the choice.
        longer_resolution, longer_steps: Longer side of the views and steps of a budget that is `LONGER` times as long.
        all_steps: Steps of phase 2 without a budget.
        most_steps: Maximum steps of phase 2 if the pace of the job decides their number; None if it does not.
    """

    resolution: int
    views: tuple[int, ...]
    steps_coarse: int
    steps_sos: int
    seconds: float
    longer_resolution: int = 0
    longer_steps: int = 0
    all_steps: int = 0
    most_steps: int | None = None

    def of(self, views: Sequence[T]) -> list[T]:
        """Return what belongs to the chosen views."""
        return [views[index] for index in self.views]

    def applied(self, settings: Settings) -> Settings:
        """Return the settings with the choice in place of what they ask for without a budget.

        The learning rate falls from step to step as with all steps, however many of them are made.
        """
        return settings.model_copy(update={"max_resolution": self.resolution}).with_steps(
            self.steps_coarse, self.steps_sos
        )

    def decision(self, within: float | None, steps: int) -> Decision:
        """Return the choice as a decision of a plan, given the seconds of the budget and the steps of the plan."""
        views = f"{len(self.views)} view{'s' if len(self.views) != 1 else ''}"
        reason = f"about {duration(self.seconds, ' ')} from here on"
        if within:
            given = duration(within, " ")
            reason += f", more than the {given} given" if self.seconds > within else f" of {given}"
        else:
            reason += ", as chosen before"
        gains = [f"{self.longer_resolution} px"] if self.longer_resolution > self.resolution else []
        gains += [f"{self.longer_steps} steps"] if self.longer_steps > steps else []
        more = f"; in {duration(LONGER * within, ' ')}: {', '.join(gains)}" if within and gains else ""
        taken = f"{steps} step{'s' if steps != 1 else ''}"
        return Decision("time budget", f"{self.resolution} px, {views}, {taken}", reason + more)


def choosable(settings: Settings) -> bool:
    """Return whether a time budget has anything to choose: the resolution or the steps."""
    return settings.within is not None and not {"max_resolution", "steps_sos"} <= {*settings.fixed}


def choose(cameras: Sequence[Camera], settings: Settings, pace: Pace, left: float, gaussians: int) -> TimeChoice:
    """Choose what fits a time budget, and what fits a longer one.

    Args:
        cameras: All cameras at the resolution of the settings.
        settings: Settings of the job with all steps.
        pace: Speed of passes over small views.
        left: Seconds that are left.
        gaussians: Number of Gaussians.
    """
    estimate = _Estimate(cameras, settings, pace, ending_seconds(gaussians))
    longer = estimate.best(left + (LONGER - 1) * (settings.within or 0.0))
    steps = longer.steps_sos + longer.steps_coarse * estimate.has_two_phases(longer.resolution)
    falls = settings.learning_rate_end != settings.learning_rate and "learning_rate_end" in settings.fixed
    most = None if falls or "steps_sos" in settings.fixed else settings.steps_sos
    limit = left if most is None else _OPTIMISM * left
    best = estimate.best(limit)
    return replace(
        best,
        seconds=min(best.seconds, left) if best.seconds <= limit else best.seconds,
        longer_resolution=longer.resolution,
        longer_steps=steps,
        all_steps=settings.steps_sos,
        most_steps=most,
    )


class _Estimate:
    """Estimator of the seconds of a job by resolution and steps."""

    def __init__(self, cameras: Sequence[Camera], settings: Settings, pace: Pace, ending: float) -> None:
        self._cameras, self._settings, self._pace, self._ending = spread(cameras, 16), settings, pace, ending
        self._count, self._known = len(cameras), dict[int, tuple[float, float, int]]()
        self._side = max(camera.side for camera in cameras)

    def best(self, left: float) -> TimeChoice:
        """Return the choice with the largest views for which enough steps fit, or the smallest, and as many as fit."""
        sides = [self._side]
        if "max_resolution" not in self._settings.fixed:
            sides += reversed(range(min(_LEAST_SIDE, self._side), self._side, _STEP))
        sides = [side for side in sides if self._cost(side)[2] >= len(self._settings.scales)] or sides[:1]
        enough = max(_ENOUGH, min(1.0, _ENOUGH_STEPS / max(self._settings.steps_sos, 1)))
        enough /= _ENOUGH_SIDE
        fits = (side for side in sides if self._fraction(side, left) >= enough * min(side, _ENOUGH_SIDE))
        side = next(fits, sides[-1])
        return self._choice(side, self._fraction(side, left))

    def has_two_phases(self, side: int) -> bool:
        """Return whether views of a resolution have a phase on the coarsest of several scales."""
        return self._cost(side)[2] > 1

    def _fraction(self, side: int, left: float) -> float:
        """Return the largest fraction of all steps that fits, in hundredths; 0 if none fits."""
        hundredths = range(100, 0, -1)
        return next((each / 100 for each in hundredths if self._choice(side, each / 100).seconds <= left), 0.0)

    def _choice(self, side: int, fraction: float) -> TimeChoice:
        settings, (step, survey, _) = self._settings, self._cost(side)
        coarse, sos = _steps(settings, fraction)
        visits = max(sos, int(not sos) * coarse) * settings.views_per_step
        count = self._count if "views" in settings.fixed else min(self._count, max(visits, 1))
        steps = coarse * step * (_COARSE if self.has_two_phases(side) else 0.0) + sos * step
        seconds = steps * (1 + settings.measure) + count * survey + self._ending
        return TimeChoice(side, tuple(spread(range(self._count), count)), coarse, sos, seconds)

    def _cost(self, side: int) -> tuple[float, float, int]:
        """Return the expected seconds of a step, those of surveying a view, and the scales of views of a resolution."""
        if side not in self._known:
            views = [resized(each, min(side, each.side)) for each in self._cameras]
            pixels = sum(camera.width * camera.height for camera in views) / len(views)
            evaluated, scales = evaluated_pixels(views, self._settings)
            network = self._settings.views_per_step * self._pace.portion * evaluated
            step = self._pace.step(network, pixels, self._settings.views_per_step)
            self._known[side] = step, self._pace.survey(pixels), scales
        return self._known[side]


def _steps(settings: Settings, fraction: float) -> tuple[int, int]:
    """Return a fraction of the steps of both phases, at least one in all, except for given numbers."""
    coarse, sos = (
        asked if name in settings.fixed else math.floor(fraction * asked + 1e-6)
        for name, asked in (("steps_coarse", settings.steps_coarse), ("steps_sos", settings.steps_sos))
    )
    return coarse, max(sos, int(not coarse and bool(settings.steps_sos)))


def evaluated_pixels(cameras: Sequence[Camera], settings: Settings) -> tuple[float, int]:
    """Return the pixels of a view that a mean step of phase 2 evaluates on all its scales, and the most scales."""
    pixels, most = 0.0, 1
    for camera in cameras:
        scales = scale_count(camera.height, camera.width, settings.coarsest_side)
        evaluated = ScaleWeights(settings.scales).evaluated(scales, settings.scale_sampling)
        pixels += camera.width * camera.height * evaluated
        most = max(most, scales)
    return pixels / len(cameras), most
