"""Who is told what happens to a job on ranks, and what rank 0 tells of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from worker.ranks.rank import RankStatus

if TYPE_CHECKING:
    from sgsst_core.planning.progress import PlanningProgress
    from sgsst_core.stylizing.loop import Progress
    from worker.description import Prepared


@dataclass(frozen=True)
class Listener:
    """Who is told what happens; everything is called on the thread of `stylize_on_ranks`.

    Attributes:
        prepared: once, when the inputs have been read and planned with.
        progress: after steps, the last of them, a few times a second.
        happened: what became of ranks and attempts, in a sentence.
        warn: what is worth knowing although the job goes on.
        stop: asked a few times a second; True ends the job as "interrupted".
        preview: path of each picture of the running job.
        left_out: GPUs that the job has let go of, because the plan does without them, by their names on their machines.
        stored: what a workplace told of each file that it has stored, in their order.
        planning: how far the survey of the views has come, a few times a second; again where an attempt that was lost
            had not saved its plan.
    """

    prepared: Callable[[Prepared], None] = lambda prepared: None
    progress: Callable[[Progress], None] = lambda progress: None
    happened: Callable[[str], None] = lambda line: None
    warn: Callable[[str], None] = lambda line: None
    stop: Callable[[], bool] = lambda: False
    preview: Callable[[Path], None] = lambda path: None
    left_out: Callable[[Sequence[str]], None] = lambda gpus: None
    stored: Callable[[Any], None] = lambda file: None
    planning: Callable[[PlanningProgress], None] = lambda progress: None


class Relay:
    """Passes on to a listener what rank 0 tells, each thing once, and knows by it how far the job has come.

    Args:
        listener: who is told.
        resumed: called when the first step of an attempt has been made, before the listener is told.

    Attributes:
        step: the farthest of all attempts.
        total: of all steps; 0 until an attempt was prepared.
        saved: step of the last checkpoint; None where there is none.
        first_step: at which the present attempt began; None until it was prepared.
        last_step: that the present attempt has made, or went on from.
        stored: what was told of all files that were stored, by any attempt.
        safe_at: when nothing was last lost: the beginning, then each checkpoint; monotonic seconds.
    """

    def __init__(self, listener: Listener, resumed: Callable[[], None]) -> None:
        self._listener, self._resumed = listener, resumed
        self.step = self.total = self.last_step = 0
        self.saved: int | None = None
        self.first_step: int | None = None
        self.safe_at = time.monotonic()
        self._prepared = False
        self._planned = -1  # views that were last told of
        self._warned = self._previewed = self._told_stored = 0
        self.stored: list[Any] = []

    @property
    def farthest(self) -> tuple[int, int | None]:
        """Step and checkpoint: what grows with progress."""
        return self.step, self.saved

    def begin_attempt(self) -> None:
        """Another set of ranks starts to tell."""
        self.first_step, self.last_step = None, self.saved or 0
        self._warned = self._previewed = self._told_stored = 0
        self._planned = -1

    def pass_on(self, status: RankStatus) -> None:
        """Tell what is new in rank 0's last answer."""
        for line in status.warnings[self._warned :]:
            self._listener.warn(line)
        self._warned = len(status.warnings)
        for path in status.previews[self._previewed :]:
            self._listener.preview(path)
        self._previewed = len(status.previews)
        for file in status.stored[self._told_stored :]:
            self.stored.append(file)
            self._listener.stored(file)
        self._told_stored = len(status.stored)
        self._pass_on_planning(status)
        self._pass_on_prepared(status)
        self._pass_on_progress(status)
        if status.saved is not None and status.saved != self.saved:
            self.saved, self.safe_at = status.saved, time.monotonic()

    def _pass_on_planning(self, status: RankStatus) -> None:
        if status.planning is not None and status.planning.done != self._planned:
            self._planned = status.planning.done
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
        if status.progress is None or status.progress.step == self.last_step:
            return
        if self.last_step == self.first_step:
            self._resumed()
        self.last_step = status.progress.step
        self.step = max(self.step, self.last_step)
        self._listener.progress(status.progress)
