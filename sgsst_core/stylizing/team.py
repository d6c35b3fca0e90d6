"""Ranks that stylize a scene together: their groups, and a check for drift."""

from __future__ import annotations

import math
import zlib

from torch import Tensor

from sgsst_core.errors import RanksDriftedError
from sgsst_core.parallel.collectives import Collectives, same_on_all
from sgsst_core.settings import Settings

#: Steps between two checks that all ranks have the same colors.
DRIFT_STEPS = 50


class Team:
    """Ranks of a job, and the position of this rank among them.

    Attributes:
        groups: Number of groups that these ranks form; each group processes its own views.
        group: Ranks that process the same views as this one.
    """

    def __init__(self, settings: Settings, collectives: Collectives) -> None:
        self.everybody = collectives
        self.groups = math.gcd(settings.views_per_step, collectives.size)
        self.group = collectives.split_group(self.groups)

    def expect(self, seconds: float) -> None:
        """Set the timeouts of the ranks for steps that take so many seconds."""
        for ranks in (self.everybody, self.group):
            ranks.set_timeout_for(seconds)

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
