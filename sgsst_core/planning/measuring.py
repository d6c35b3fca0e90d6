"""What a job measures beside its steps, so that it takes no more than a share of the job's time.

Held-out views are measured at moments of a run. Both become fewer from level to level (`LEVELS`). The plan takes the
first level whose expected seconds are allowed; the first view that is really measured says whether a later level is
needed (`quality.measure`). No level changes a colour.
"""

from __future__ import annotations

from dataclasses import dataclass

from sgsst_core.planning.plan import Prediction

#: So many seconds are always allowed: small jobs are measured in full.
LEAST_ALLOWED = 30.0
#: Held-out views of a `Level.views` that are rendered: one for the Gram distance, the others of its pairs.
RENDERED = 4


@dataclass(frozen=True)
class Level:
    """How much is measured.

    Attributes:
        views: whose Gram distance is measured, and pairs of each range that are compared, at most.
        halvings: h for each moment, after total / 2^h steps; 0 is the end.
        start: the unstylized scene is measured too.
    """

    views: int
    halvings: tuple[int, ...]
    start: bool = True

    def moments(self, total: int) -> list[int]:
        """Steps after which a run of `total` is measured."""
        return sorted({*([0] if self.start else []), *(total >> halvings for halvings in self.halvings)})


#: From all to the least: the end alone.
LEVELS = (
    Level(4, (0, 1, 2, 3, 4, 5)),
    Level(4, (0, 2, 4)),
    Level(2, (0, 2, 4)),
    Level(2, (0,)),
    Level(1, (0,)),
    Level(1, (0,), start=False),
)


@dataclass(frozen=True)
class Prices:
    """Seconds of measuring.

    Attributes:
        setup: once, for each of `Level.views`: the poses' surroundings, depth and warps.
        view: at each moment, for each of them.
        moment: at each moment beside them: the gradient against the exact one.
    """

    setup: float
    view: float
    moment: float = 0.0

    def again(self, level: Level) -> float:
        """Of a moment after the first."""
        return level.views * self.view + self.moment

    def of(self, level: Level, moments: int) -> float:
        """Of so many moments."""
        return level.views * self.setup + moments * self.again(level)


def held_out_seconds(share: float, expected: Prediction) -> float:
    """Seconds that held-out views may take: what the loss before and after leaves of a share of the steps' time."""
    if not share:
        return 0.0
    steps = expected.job - expected.measuring
    return max(max(LEAST_ALLOWED, share * steps) - 2 * expected.evaluation, 0.0)


def choose_level(prices: Prices, allowed: float, total: int, first: int = 0) -> int:
    """Place in `LEVELS`, from `first` on, of the first one that takes no more than `allowed` seconds; else the last.

    Args:
        total: steps of the run.
    """
    for place in range(first, len(LEVELS)):
        if prices.of(LEVELS[place], len(LEVELS[place].moments(total))) <= allowed:
            return place
    return len(LEVELS) - 1
