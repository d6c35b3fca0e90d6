"""Time budget of a job: the resolution, the views and the steps that fit, given what small views cost.

Resolution is lowered first, then steps are left out, and only then the resolution is lowered further.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

from sgsst_core.decision import Decision
from sgsst_core.loss.scale_weights import ScaleWeights, scale_count
from sgsst_core.number_format import duration
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.settings import Settings

#: Function that returns the seconds that are left of a time budget.
SecondsLeft = Callable[[], float]
T = TypeVar("T")

#: Longer sides in pixels are multiples of `_STEP`, and at least `_LEAST_SIDE`.
_STEP, _LEAST_SIDE = 32, 96
#: Longer side below which steps are left out before the resolution is lowered further, and the least fraction of them
#: that remains before it is.
_ENOUGH_SIDE, _LEAST_STEPS = 256, 0.2
#: Steps that a trial takes, and portion of the time after it that is left for what no measurement predicts.
_TRIAL_STEPS, _MARGIN = 6, 0.1
#: Time of a step of phase 1 relative to one on all scales, if there are several.
_COARSE = 0.5
#: Factor of the longer budget whose choice is shown.
_MORE = 4


def seconds_left(within: float | None, started: float | None = None) -> SecondsLeft | None:
    """Return a function that returns the seconds left of a time budget; None without a budget.

    Args:
        within: Time budget in seconds.
        started: Start of the budget, in seconds since the epoch; None for now.
    """
    if within is None:
        return None
    # The system's clock may be set while the job runs.
    end = time.monotonic() + within - (0.0 if started is None else time.time() - started)
    return lambda: end - time.monotonic()


@dataclass(frozen=True)
class ViewCost:
    """Measured cost of views of one resolution.

    Attributes:
        pixels: Pixels of a view that a step evaluates, on all its scales, mean over views and steps.
        seconds: Seconds of a step of phase 2.
        first: Additional seconds of a view's first visit.
        survey: Seconds of the survey of a view.
        scales: Largest number of scales of a view.
    """

    pixels: float
    seconds: float
    first: float
    survey: float
    scales: int = 1

    def at(self, pixels: float, scales: int) -> ViewCost:
        """Return the cost of views with other pixels and scales, in proportion to the pixels."""
        more = pixels / self.pixels
        return ViewCost(pixels, more * self.seconds, more * self.first, more * self.survey, scales)


@dataclass(frozen=True)
class TimeChoice:
    """Choice of a time budget.

    Attributes:
        resolution: Longer side of the views in pixels.
        views: Indices of the chosen views.
        steps_coarse, steps_sos: Steps of both phases.
        seconds: Predicted seconds of the steps and everything after the choice.
        longer_resolution, longer_steps: Longer side of the views and steps of a budget that is `_MORE` times as long.
    """

    resolution: int
    views: tuple[int, ...]
    steps_coarse: int
    steps_sos: int
    seconds: float
    longer_resolution: int = 0
    longer_steps: int = 0

    def of(self, views: Sequence[T]) -> list[T]:
        """Return what belongs to the chosen views."""
        return [views[index] for index in self.views]

    def applied(self, settings: Settings) -> Settings:
        """Return the settings with the choice in place of what they ask for without a budget."""
        steps = settings.steps_coarse + settings.steps_sos
        fraction = (self.steps_coarse + self.steps_sos) / max(steps, 1)
        chosen: dict[str, object] = {
            "max_resolution": self.resolution,
            "steps_coarse": self.steps_coarse,
            "steps_sos": self.steps_sos,
        }
        if fraction < 1 and "learning_rate_end" not in settings.fixed:
            chosen["learning_rate_end"] = settings.learning_rate_at(fraction)
        return settings.model_copy(update=chosen)

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
        more = f"; in {duration(_MORE * within, ' ')}: {', '.join(gains)}" if within and gains else ""
        taken = f"{steps} step{'s' if steps != 1 else ''}"
        return Decision("time budget", f"{self.resolution} px, {views}, {taken}", reason + more)

    def corrected(self, settings: Settings, seconds: float, once: float, left: float) -> TimeChoice:
        """Return the choice with the steps that fit, now that a step of the chosen views has been measured.

        Args:
            settings: Settings without the choice.
            seconds: Seconds of all steps that the settings ask for.
            once: Seconds of everything else that remains.
            left: Seconds that are left.
        """
        usable = left / (1 + _MARGIN) - once
        fraction = min(max(usable / (seconds * (1 + settings.measure)), 0.0), 1.0) if seconds else 1.0
        coarse, sos = _steps(settings, fraction)
        return replace(self, steps_coarse=coarse, steps_sos=sos, seconds=fraction * seconds + once)


def choosable(settings: Settings) -> bool:
    """Return whether a time budget has anything to choose: the resolution or the steps."""
    return settings.within is not None and not {"max_resolution", "steps_sos"} <= {*settings.fixed}


def choose(cameras: Sequence[Camera], settings: Settings, cost: ViewCost, left: float, ending: float) -> TimeChoice:
    """Choose what fits a time budget, and what fits a longer one.

    Args:
        cameras: All cameras at the resolution of the settings.
        settings: Settings of the job with all steps.
        cost: Cost of small views.
        left: Seconds that are left.
        ending: Seconds from the last step to the last file.
    """
    estimate = _Estimate(cameras, settings, cost, ending)
    longer = estimate.best(left + (_MORE - 1) * (settings.within or 0.0))
    steps = longer.steps_sos + longer.steps_coarse * estimate.has_two_phases(longer.resolution)
    return replace(estimate.best(left), longer_resolution=longer.resolution, longer_steps=steps)


class _Estimate:
    """Estimator of the seconds of a job by resolution and steps."""

    def __init__(self, cameras: Sequence[Camera], settings: Settings, cost: ViewCost, ending: float) -> None:
        self._cameras, self._settings, self._small, self._ending = spread(cameras, 16), settings, cost, ending
        self._count, self._known = len(cameras), dict[int, ViewCost]()
        self._side = max(camera.side for camera in cameras)

    def best(self, left: float) -> TimeChoice:
        """Return the best choice that fits into the seconds that are left, or the smallest one."""
        sides = [self._side]
        if "max_resolution" not in self._settings.fixed:
            sides += reversed(range(min(_LEAST_SIDE, self._side), self._side, _STEP))
        sides = [side for side in sides if self._cost(side).scales >= len(self._settings.scales)] or sides[:1]
        smaller = [side for side in sides if side <= _ENOUGH_SIDE] or sides[-1:]
        for side in sides[: len(sides) - len(smaller)] + smaller[:1]:
            if (choice := self._choice(side, 1.0)).seconds <= left:
                return choice
        for side in smaller:
            fraction = self._fraction(side, left)
            if fraction >= _LEAST_STEPS:
                return self._choice(side, fraction)
        return self._choice(smaller[-1], fraction)

    def has_two_phases(self, side: int) -> bool:
        """Return whether views of a resolution have a phase on the coarsest of several scales."""
        return self._cost(side).scales > 1

    def _fraction(self, side: int, left: float) -> float:
        """Return the largest fraction of all steps that fits, in hundredths; 0 if none fits."""
        hundredths = range(100, 0, -1)
        return next((each / 100 for each in hundredths if self._choice(side, each / 100).seconds <= left), 0.0)

    def _choice(self, side: int, fraction: float) -> TimeChoice:
        settings, cost = self._settings, self._cost(side)
        coarse, sos = _steps(settings, fraction)
        visits = max(sos, int(not sos) * coarse) * settings.views_per_step
        count = self._count if "views" in settings.fixed else min(self._count, max(visits, 1))
        coarse_seconds = _COARSE * cost.seconds if self.has_two_phases(side) else 0.0
        steps = coarse * coarse_seconds + sos * cost.seconds + min(visits, count) * cost.first
        steps *= 1 + settings.measure
        seconds = steps + count * cost.survey + _TRIAL_STEPS * cost.seconds + self._ending
        return TimeChoice(side, tuple(spread(range(self._count), count)), coarse, sos, seconds)

    def _cost(self, side: int) -> ViewCost:
        """Return the expected cost of views of a resolution."""
        if side not in self._known:
            self._known[side] = self._small.at(*pixels_of(self._cameras, side, self._settings))
        return self._known[side]


def pixels_of(cameras: Sequence[Camera], side: int, settings: Settings) -> tuple[float, int]:
    """Return the pixels of a view that a step evaluates on average, given its longer side, and the most scales."""
    pixels, most = 0.0, 1
    for camera in (resized(each, min(side, each.side)) for each in cameras):
        scales = scale_count(camera.height, camera.width, settings.coarsest_side)
        evaluated = ScaleWeights(settings.scales).evaluated(scales, settings.scale_sampling)
        pixels += camera.width * camera.height * evaluated
        most = max(most, scales)
    return pixels / len(cameras), most


def _steps(settings: Settings, fraction: float) -> tuple[int, int]:
    """Return a fraction of the steps of both phases, at least one in all, except for given numbers."""
    coarse, sos = (
        asked if name in settings.fixed else math.floor(fraction * asked + 1e-6)
        for name, asked in (("steps_coarse", settings.steps_coarse), ("steps_sos", settings.steps_sos))
    )
    return coarse, max(sos, int(not coarse and bool(settings.steps_sos)))
