"""Callbacks of a distributed job, and the relay that calls them with new events of rank 0."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worker.ranks.rank import RankStatus

if TYPE_CHECKING:
    from sgsst_core.planning.survey import PlanningProgress
    from sgsst_core.stylizing.loop import Progress
    from worker.description import Prepared


@dataclass(frozen=True)
class Listener:
    """Callbacks of a distributed job. All are called on the thread of `stylize_on_ranks`.

    Attributes:
        prepared: Called once, after the job has been prepared.
        progress: Called with the progress of the latest step, a few times per second.
        happened: Called with a sentence about each lost or resumed attempt.
        warn: Called with each warning.
        stop: Called a few times per second; returns True to interrupt the job.
        finish: Called a few times per second; returns True to end the job after a step, with its present colors as the
            result.
        preview: Called with the path of each preview.
        left_out: Called with the GPUs that the job released because the plan does not use them, by their names in
            CUDA_VISIBLE_DEVICES on their machine.
        stored: Called with the workplace's description of each stored file, in order.
        planning: Called with the progress of the stages before the steps, a few times per second. An attempt repeats
            the survey if no earlier attempt has saved its plan.
    """

    prepared: Callable[[Prepared], None] = lambda prepared: None
    progress: Callable[[Progress], None] = lambda progress: None
    happened: Callable[[str], None] = lambda line: None
    warn: Callable[[str], None] = lambda line: None
    stop: Callable[[], bool] = lambda: False
    finish: Callable[[], bool] = lambda: False
    preview: Callable[[Path], None] = lambda path: None
    left_out: Callable[[Sequence[str]], None] = lambda gpus: None
    stored: Callable[[Any], None] = lambda file: None
    planning: Callable[[PlanningProgress], None] = lambda progress: None


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
        self._planned: PlanningProgress | None = None
        self._progress: Progress | None = None
        self._warned = self._previewed = self._reported_files = 0
        self.stored: list[Any] = []

    @property
    def farthest(self) -> tuple[int, int | None]:
        """Return the highest step and the step of the last checkpoint. One of them changes with any progress."""
        return self.step, self.saved

    def begin_attempt(self) -> None:
        """Reset the state of the current attempt for a new set of ranks."""
        self.first_step, self.last_step = None, self.saved or 0
        self._warned = self._previewed = self._reported_files = 0
        self._planned = self._progress = None

    def pass_on(self, status: RankStatus) -> None:
        """Notify the listener of everything that is new in the latest status of rank 0."""
        for line in status.warnings[self._warned :]:
            self._listener.warn(line)
        self._warned = len(status.warnings)
        for path in status.previews[self._previewed :]:
            self._listener.preview(path)
        self._previewed = len(status.previews)
        for file in status.stored[self._reported_files :]:
            self.stored.append(file)
            self._listener.stored(file)
        self._reported_files = len(status.stored)
        self._pass_on_planning(status)
        self._pass_on_prepared(status)
        self._pass_on_progress(status)
        if status.saved is not None and status.saved != self.saved:
            self.saved, self.safe_at = status.saved, time.monotonic()

    def _pass_on_planning(self, status: RankStatus) -> None:
        if status.planning is not None and status.planning != self._planned:
            self._planned = status.planning
            self._listener.planning(status.planning)

    def _pass_on_prepared(self, status: RankStatus) -> None:
        if status.prepared is None or self.first_step is not None:
            return
        self.first_step = self.last_step = status.prepared.step
        self.total = status.prepared.total
        if not self._prepared:
            self._prepared = True
            self._listener.prepared(status.prepared)

    def _pass_on_progress(self, status: RankStatus) -> None:
        if status.progress is None or status.progress == self._progress:
            return
        self._progress = status.progress
        if status.progress.step != self.last_step:
            if self.last_step == self.first_step:
                self._resumed()
            self.last_step = status.progress.step
            self.step = max(self.step, self.last_step)
        self._listener.progress(status.progress)
