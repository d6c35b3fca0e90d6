"""Choice of measurements outside the steps, which may take only a given fraction of the job's time.

Two things are measured: the loss before the first and after the last step, on some of the job's views; and novel views,
after certain steps, called moments. The loss gets at most half of the time allowed, and is evaluated on fewer views if
necessary. Novel views get the rest. Each level of `LEVELS` has fewer views or moments than the level before it, and the
plan takes the first level whose predicted time is allowed. The first novel view that is measured shows whether a later
level is needed (`quality.measure`). Measurements do not delay the first step, and never change a color.
"""

from __future__ import annotations

from dataclasses import dataclass

from sgsst_core.planning.plan import Prediction
from sgsst_core.settings import Settings

#: Without a time budget, measuring may take half of the steps' time, but no more than the second of these numbers of
#: seconds, and the first in any case, so that short jobs are measured too.
SHORT = 5.0, 30.0
#: Planned measurements may use this fraction of the time allowed, because predictions are accurate to about a fifth.
_PLANNED = 0.8
#: Candidate numbers of views for the initial loss; the largest that half of the time allowed covers is used.
#: At least one view is always evaluated, because a job that cannot report what it has achieved is of little use.
LOSS_VIEWS = (4, 2, 1)
#: Novel views rendered per view of a `Level`: one for the Gram distance, the others for the pairs in which it is
#: compared.
RENDERED = 4


@dataclass(frozen=True)
class Level:
    """Set of measurements of novel views; `LEVELS` sorts them by cost.

    Attributes:
        views: Maximum number of views whose Gram distance is measured, and of view pairs compared per range (short and
            long).
        halvings: Exponents h of the moments: novel views are measured after total / 2^h steps; h = 0 is the end.
        start: Whether to measure the unstylized scene too, together with the first of the other moments.
    """

    views: int
    halvings: tuple[int, ...]
    start: bool = True

    def moments(self, total: int) -> list[int]:
        """Return the steps after which a run of `total` steps is measured."""
        later = {total >> halvings for halvings in self.halvings if total >> halvings}
        return sorted({0, *later} if self.start else later)


#: Levels from the most to the least expensive. The last measures nothing, and the one before it only the end. None
#: measures the first tenth of the steps, in which the first strokes appear.
LEVELS = (
    Level(4, (0, 1, 2, 3)),
    Level(4, (0, 2)),
    Level(2, (0, 2)),
    Level(2, (0,)),
    Level(1, (0,)),
    Level(1, (0,), start=False),
    Level(0, (), start=False),
)
#: Index of the level without novel views.
NOTHING = len(LEVELS) - 1


@dataclass(frozen=True)
class Prices:
    """Time that measurements take.

    Attributes:
        setup: Seconds once per view of `Level.views`, for neighboring poses, depth and warps.
        view: Seconds per view and moment, and once more for evaluating the views at the end.
        moment: Additional seconds per moment, for comparing the gradient with the float32 reference.
    """

    setup: float
    view: float
    moment: float = 0.0

    def again(self, level: Level) -> float:
        """Return the time in seconds of a moment after the first."""
        return level.views * self.view + self.moment

    def of(self, level: Level, moments: int) -> float:
        """Return the time in seconds of this many moments, including the evaluation of the last one."""
        return level.views * (self.setup + self.view) + moments * self.again(level)


def allowed_seconds(settings: Settings, steps: float) -> float:
    """Return the seconds that all measurements may take: `measure` of the steps' time, or in short jobs half of it."""
    least, most = (0.0, 0.0) if settings.within else SHORT
    return max(settings.measure * steps, min(max(steps / 2, least), most))


def novel_view_seconds(settings: Settings, expected: Prediction) -> float:
    """Return the time in seconds that novel views may take.

    This is the time allowed minus the time for the initial loss; 0 if `measure` is 0.
    """
    if not settings.measure:
        return 0.0
    return max(_PLANNED * allowed_seconds(settings, expected.job - expected.measuring) - expected.losses, 0.0)


def choose_loss_views(settings: Settings, steps: float, price: float, views: int) -> int:
    """Choose the number of views on which the loss is evaluated before and after.

    Args:
        steps: Time in seconds of all steps.
        price: Time in seconds to evaluate the loss of one view before and after.
    """
    half = _PLANNED * allowed_seconds(settings, steps) / 2
    return min(next((count for count in LOSS_VIEWS if min(count, views) * price <= half), LOSS_VIEWS[-1]), views)


def choose_level(prices: Prices, allowed: float, total: int, first: int = 0) -> int:
    """Return the index in `LEVELS` of the first level, from `first` on, that takes at most `allowed` seconds.

    Args:
        prices: Time in seconds of measurements.
        allowed: Seconds allowed.
        total: Number of steps of the run.
        first: Index of the first level to consider.
    """
    for level in range(first, NOTHING):
        if prices.of(LEVELS[level], len(LEVELS[level].moments(total))) <= allowed:
            return level
    return NOTHING
