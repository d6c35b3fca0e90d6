"""The ranks of one attempt as the driver knows them: their actors, where they are, what each has last answered."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from worker.ranks.failure_policy import Failure
from worker.ranks.placement import Reservation
from worker.ranks.rank import Outcome, RankPlace, RankStatus


class AttemptFailedError(Exception):
    """An attempt has ended before its job."""

    def __init__(self, failure: Failure) -> None:
        super().__init__(failure.reason)
        self.failure = failure


@dataclass
class RankHandle:
    """One rank.

    Attributes:
        actor: its Ray actor.
        group: Ray's placement group that it runs in.
        place: where it is; None until it has told.
        pending_poll: Ray's reference to the answer that is waited for; None where nothing is.
        polled_at, answered_at: when it was last asked, and answered; monotonic seconds.
        status: its last answer.
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
        """How it ended; None while it has not."""
        return self.status.outcome

    @property
    def left_out(self) -> bool:
        """Whether the job goes on without it, whatever becomes of it."""
        return self.outcome is not None and self.outcome.kind == "left-out"

    @property
    def silence(self) -> float:
        """Seconds since its last answer."""
        return 0.0 if self.left_out else time.monotonic() - self.answered_at


@dataclass
class RankGroup:
    """The ranks of one attempt, in the order of their numbers.

    Attributes:
        on_left_out: called with a rank that the plan does without.
        handles: empty until they have been started.
        reservation: of their places; None before, and where these have been given back.
    """

    on_left_out: Callable[[RankHandle], None]
    handles: list[RankHandle] = field(default_factory=list)
    reservation: Reservation | None = None

    def name_of(self, rank: RankHandle) -> str:
        """For sentences."""
        where = f" on {rank.place.host}" if rank.place else ""
        return f"Worker {self.handles.index(rank)}{where}"
