"""Callbacks of a distributed job, and the relay that calls them with new events of rank 0."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from worker.ranks.rank import RankStatus

if TYPE_CHECKING:
    from sgsst_core.progress import Progress
    from worker.description import Prepared


@dataclass(frozen=True)
class Listener:
    """Callbacks of a distributed job. All are called on the thread of `stylize_on_ranks`.

    Attributes:
        prepared: Called once, after the job has been prepared.
        progress: Called with the latest progress, a few times per second. An attempt repeats the stages before the
            steps if no earlier attempt has saved its plan.
        happened: Called with a sentence about each lost or resumed attempt.
        warn: Called with each warning.
        stop: Called a few times per second; returns True to interrupt the job.
        finish: Called a few times per second; returns True to end the job after a step, with its present colors as the
            result.
        left_out: Called with the GPUs that the job released because the plan does not use them, by their names in
            CUDA_VISIBLE_DEVICES on their machine.
        stored: Called with the workplace's description of each stored file, in order.
    """

    prepared: Callable[[Prepared], None] = lambda prepared: None
    progress: Callable[[Progress], None] = lambda progress: None
    happened: Callable[[str], None] = lambda line: None
    warn: Callable[[str], None] = lambda line: None
    stop: Callable[[], bool] = lambda: False
    finish: Callable[[], bool] = lambda: False
    left_out: Callable[[Sequence[str]], None] = lambda gpus: None
    stored: Callable[[Any], None] = lambda file: None


class Relay:
    """Relay that passes each event of rank 0 to a listener once, and tracks the progress of the job.

    Args:
        listener: Callbacks of the job.
        resumed: Callback after the first step of an attempt, before the listener is notified.

    Attributes:
        step: Highest step of all attempts.
        total: Number of all steps; 0 until an attempt is prepared.
        saved: Step of the last checkpoint; None if there is none.
        first_step: Step at which the current attempt started; None until it is prepared.
        last_step: Last step of the current attempt, or the step that it resumed from.
        stored: Descriptions of all stored files of all attempts.
        safe_at: Time of the last checkpoint, or of the start of the job, in monotonic seconds.
    """

    def __init__(self, listener: Listener, resumed: Callable[[], None]) -> None:
        self._listener, self._resumed = listener, resumed
        self.step = self.total = self.last_step = 0
        self.saved: int | None = None
        self.first_step: int | None = None
        self.safe_at = time.monotonic()
        self._prepared = False
        self._progress: Progress | None = None
        self._warned = self._reported_files = 0
        self.stored: list[Any] = []

    @property
    def farthest(self) -> tuple[int, int | None]:
        """Return the highest step and the step of the last checkpoint. One of them changes with any progress."""
        return self.step, self.saved

    def begin_attempt(self) -> None:
        """Reset the state of the current attempt for a new set of ranks."""
        self.first_step, self.last_step = None, self.saved or 0
        self._warned = self._reported_files = 0
        self._progress = None

    def pass_on(self, status: RankStatus) -> None:
        """Notify the listener of everything that is new in the latest status of rank 0."""
        for line in status.warnings[self._warned :]:
            self._listener.warn(line)
        self._warned = len(status.warnings)
        for file in status.stored[self._reported_files :]:
            self.stored.append(file)
            self._listener.stored(file)
        self._reported_files = len(status.stored)
        if status.progress is not None and not status.progress.is_step:
            self._pass_on_progress(status.progress)
        self._pass_on_prepared(status)
        if status.progress is not None and status.progress.is_step:
            self._pass_on_progress(status.progress)
        if status.saved is not None and status.saved != self.saved:
            self.saved, self.safe_at = status.saved, time.monotonic()

    def _pass_on_prepared(self, status: RankStatus) -> None:
        if status.prepared is None or self.first_step is not None:
            return
        self.first_step = self.last_step = status.prepared.step
        self.total = status.prepared.total
        if not self._prepared:
            self._prepared = True
            self._listener.prepared(status.prepared)

    def _pass_on_progress(self, progress: Progress) -> None:
        if progress == self._progress:
            return
        self._progress = progress
        if progress.is_step and progress.step != self.last_step:
            if self.last_step == self.first_step:
                self._resumed()
            self.last_step = progress.step
            self.step = max(self.step, self.last_step)
        self._listener.progress(progress)
