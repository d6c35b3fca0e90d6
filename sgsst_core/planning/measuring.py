"""What a job measures beside its steps, so that it takes no more than a share of the job's time.

The loss before and after is taken on some of the job's views; novel views are measured at moments of a run. Half of
what is allowed goes to the loss at most, and its views are fewer where they would take more. What it leaves is for
novel views: they and their moments become fewer from level to level (`LEVELS`). The plan takes the first level whose
expected seconds are allowed; the first view that is really measured says whether a later level is needed
(`quality.measure`). Nothing is measured before the first step, and nothing changes a color.
"""

from __future__ import annotations

from dataclasses import dataclass

from sgsst_core.planning.plan import Prediction

#: So many seconds are always allowed, so that short jobs are measured too: of those whose steps take less than five
#: minutes, they may be more than a tenth.
LEAST_ALLOWED = 30.0
#: Prices are right within a fifth or so: what is planned takes no more than this share of what is allowed.
_PLANNED = 0.8
#: Views on which the loss is taken before and after: the most of these that half of the allowed seconds pay for. One is
#: taken whatever it costs, because a job that cannot say what it has reached is worth little.
LOSS_VIEWS = (4, 2, 1)
#: Novel views of a `Level.views` that are rendered: one for the Gram distance, the others of its pairs.
RENDERED = 4


@dataclass(frozen=True)
class Level:
    """How much is measured.

    Attributes:
        views: whose Gram distance is measured, and pairs of each range that are compared, at most.
        halvings: h for each moment, after total / 2^h steps; 0 is the end.
        start: the unstylized scene is measured too, when the first of the other moments comes.
    """

    views: int
    halvings: tuple[int, ...]
    start: bool = True

    def moments(self, total: int) -> list[int]:
        """Steps after which a run of `total` is measured."""
        later = {total >> halvings for halvings in self.halvings if total >> halvings}
        return sorted({0, *later} if self.start else later)


#: From all to nothing; the last but one is the end alone.
LEVELS = (
    Level(4, (0, 1, 2, 3, 4, 5)),
    Level(4, (0, 2, 4)),
    Level(2, (0, 2, 4)),
    Level(2, (0,)),
    Level(1, (0,)),
    Level(1, (0,), start=False),
    Level(0, (), start=False),
)
#: Place of the level without any novel view.
NOTHING = len(LEVELS) - 1


@dataclass(frozen=True)
class Prices:
    """Seconds of measuring.

    Attributes:
        setup: once, for each of `Level.views`: the poses' surroundings, depth and warps.
        view: at each moment, for each of them; and once more, to judge them at the end.
        moment: at each moment beside them: the gradient against the exact one.
    """

    setup: float
    view: float
    moment: float = 0.0

    def again(self, level: Level) -> float:
        """Of a moment after the first."""
        return level.views * self.view + self.moment

    def of(self, level: Level, moments: int) -> float:
        """Of so many moments, and of judging the last one."""
        return level.views * (self.setup + self.view) + moments * self.again(level)


def allowed_seconds(share: float, steps: float) -> float:
    """Seconds that all measuring may take beside so many seconds of steps."""
    return max(LEAST_ALLOWED, share * steps)


def novel_view_seconds(share: float, expected: Prediction) -> float:
    """Seconds that novel views may take: what the loss before and after leaves; none without a share."""
    if not share:
        return 0.0
    return max(_PLANNED * allowed_seconds(share, expected.job - expected.measuring) - expected.losses, 0.0)


def choose_loss_views(share: float, steps: float, price: float, views: int) -> int:
    """On how many of a job's `views` the loss is taken before and after, beside so many seconds of steps.

    Args:
        price: seconds of both losses of a view.
    """
    half = _PLANNED * allowed_seconds(share, steps) / 2
    return min(next((count for count in LOSS_VIEWS if min(count, views) * price <= half), LOSS_VIEWS[-1]), views)


def choose_level(prices: Prices, allowed: float, total: int, first: int = 0) -> int:
    """Place in `LEVELS`, from `first` on, of the first one that takes no more than `allowed` seconds.

    Args:
        total: steps of the run.
    """
    for place in range(first, NOTHING):
        if prices.of(LEVELS[place], len(LEVELS[place].moments(total))) <= allowed:
            return place
    return NOTHING
