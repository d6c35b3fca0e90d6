"""State of an attempt's ranks in the driver: their actors, locations and latest statuses."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from worker.ranks.failure_policy import Failure
from worker.ranks.placement import Reservation
from worker.ranks.rank import Outcome, RankPlace, RankStatus


class AttemptFailedError(Exception):
    """Error if an attempt ends before its job is done."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.reason)
        self.failure = failure


@dataclass
class RankHandle:
    """Handle of one rank.

    Attributes:
        actor: Ray actor of the rank.
        group: Ray placement group that the actor runs in.
        place: Location of the rank's process; None until the rank has reported it.
        pending_poll: Ray reference to the response to a pending poll; None if no poll is pending.
        polled_at, answered_at: Times of the last poll and the last response, in monotonic seconds.
        status: Latest status that the rank has returned.
    """

    actor: Any
    group: Any
    place: RankPlace | None = None
    pending_poll: Any = None
    polled_at: float = 0.0
    answered_at: float = field(default_factory=time.monotonic)
    status: RankStatus = field(default_factory=RankStatus)

    @property
    def outcome(self) -> Outcome | None:
        """Return the outcome of the rank; None while it runs."""
        return self.status.outcome

    @property
    def left_out(self) -> bool:
        """Return whether the job continues without this rank."""
        return self.outcome is not None and self.outcome.kind == "left-out"

    @property
    def silence(self) -> float:
        """Return the seconds since the last response; 0 for a rank that was left out."""
        return 0.0 if self.left_out else time.monotonic() - self.answered_at


@dataclass
class RankGroup:
    """Ranks of one attempt, ordered by number.

    Attributes:
        on_left_out: Callback for each rank that the plan does not use.
        handles: Handles of the ranks; empty until they are started.
        reservation: Reserved resources; None before the reservation and after its release.
    """

    on_left_out: Callable[[RankHandle], None]
    handles: list[RankHandle] = field(default_factory=list)
    reservation: Reservation | None = None

    def name_of(self, rank: RankHandle) -> str:
        """Return the name of a rank for messages."""
        where = f" on {rank.place.host}" if rank.place else ""
        return f"Worker {self.handles.index(rank)}{where}"
