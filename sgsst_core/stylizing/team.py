"""Ranks that stylize a scene together: their groups, a check for drift, and load balancing."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping

from torch import Tensor

from sgsst_core.errors import RanksDriftedError
from sgsst_core.parallel.collectives import Collectives, RankLeftOut, same_on_all
from sgsst_core.planning.plan import Plan
from sgsst_core.settings import Settings

#: Steps between two checks that all ranks have the same colors.
DRIFT_STEPS = 50
#: Steps of a phase after which speeds of ranks are compared. The first step is ignored, because it includes
#: preparation.
BALANCE_STEPS = 6
#: Minimum ratio of the fastest to the slowest rank at which the work is redivided.
MIN_IMBALANCE = 1.15

_NETWORK_PARTS = ("vgg_forward", "vgg_backward", "statistics", "matching")


class Team:
    """Ranks that the plan uses, and the position of this rank among them.

    Attributes:
        groups: Number of groups that these ranks form; each group processes its own views.
        group: Ranks that process the same views as this one.

    Raises:
        RankLeftOut: If the job continues without this rank.
    """

    def __init__(self, plan: Plan, settings: Settings, collectives: Collectives) -> None:
        count = min(plan.ranks, collectives.size)
        self.groups = math.gcd(settings.views_per_step, count)
        formed = collectives.form_groups(count, self.groups)
        if formed is None:
            raise RankLeftOut
        self.everybody, self.group = formed
        #: Pixels and seconds of this rank's network passes in each step, until speeds have been compared.
        self._pace: list[tuple[int, float]] | None = [] if settings.rebalance and self.group.size > 1 else None

    def expect(self, plan: Plan) -> None:
        """Set the timeouts of the ranks for steps as long as the plan predicts, if it does."""
        if plan.prediction is not None:
            for ranks in (self.everybody, self.group):
                ranks.set_timeout_for(plan.prediction.seconds)

    @property
    def own_group(self) -> int:
        """Index of this rank's group."""
        return self.everybody.rank // self.group.size

    def check_drift(self, step: int, colors: Tensor) -> None:
        """Check every `DRIFT_STEPS` steps that all ranks have the same colors [n, 3].

        Raises:
            RanksDriftedError: If they differ.
        """
        if self.everybody.size == 1 or step % DRIFT_STEPS:
            return
        checksum = zlib.crc32(colors.detach().cpu().numpy().tobytes())
        if not same_on_all(self.everybody, checksum):
            raise RanksDriftedError(
                f"Step {step}: the ranks' colors are no longer the same. They compute differently: run on "
                "machines of one kind, with the same versions of this program and of PyTorch."
            )

    def compare_speeds(self, cost: int, seconds: Mapping[str, float]) -> tuple[float, ...] | None:
        """Return the speeds of the group's ranks, once, if they differ noticeably; otherwise None.

        Args:
            cost: Pixels that this rank passed through the network in the last step.
            seconds: Time in seconds of that step by activity.
        """
        if self._pace is None:
            return None
        self._pace.append((cost, sum(seconds.get(part, 0.0) for part in _NETWORK_PARTS)))
        if len(self._pace) < BALANCE_STEPS:
            return None
        # Medians, so that a single disturbed step has no effect.
        rates = sorted(pixels / duration for pixels, duration in self._pace[1:] if pixels)
        self._pace = None
        speeds = self.group.all_gather(rates[len(rates) // 2] if rates else 0.0)
        known = [speed for speed in speeds if speed > 0]
        if max(known) <= MIN_IMBALANCE * min(known):
            return None
        return tuple(speed or sum(known) / len(known) for speed in speeds)
