"""Progress of a job: the record that the loop reports, and that command line, service, database, API and page show."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field

from sgsst_core.number_format import time_left

#: What a step of a stage stands for, if it is not a step of the optimization.
_UNITS = {"planning": "view", "refining": "view", "video": "frame"}


def _fraction(known: dict[str, Any]) -> float:
    """Return the completed fraction, given the fields before it."""
    return known["step"] / known["total"] if known.get("total") else 0.0


class Progress(BaseModel):
    """Progress of a job: a step, or the work before and after the steps.

    Example:
        >>> Progress(stage="sos", step=3, total=12, loss=0.5, eta_s=61.0).text()
        'sos: step 3 of 12, loss 0.5, 1:01 left'
    """

    model_config = ConfigDict(
        frozen=True,
        json_schema_extra={
            "examples": [
                {
                    "stage": "sos",
                    "step": 120,
                    "total": 300,
                    "fraction": 0.4,
                    "eta_s": 310.5,
                    "loss": 23729174.8,
                    "scales": [41029174.8, 19120331.2, 11038018.4],
                    "mean_loss": 24105220.5,
                    "mean_scales": [42105220.5, 19210441.0, 11000000.0],
                    "seconds": 205.1,
                }
            ]
        },
    )

    stage: str = Field(
        description="`reading`, `planning` (surveying the views), `refining` (choosing Gaussians to split), "
        "`starting`, `coarse` (coarsest scale), `sos` (all scales), `measuring` "
        "(checking the quality of some views) or `video` (frames of the video)."
    )
    step: int = Field(0, description="Completed steps; views while `planning` or `refining`; frames while `video`.")
    total: int = Field(0, description="Maximum number of steps or views; 0 while unknown.")
    fraction: float = Field(default_factory=_fraction, description="Completed fraction of the steps or views, 0 to 1.")
    eta_s: float | None = Field(
        None, description="Estimated remaining seconds, including measurements at the end; null if unknown."
    )
    loss: float | None = Field(None, description="Loss of the step.")
    scales: list[float | None] | None = Field(
        None, description="Loss of each scale, full size first; null for scales that the step skipped."
    )
    mean_loss: float | None = Field(None, description="Loss of the last round of views, comparable over time.")
    mean_scales: list[float | None] | None = Field(None, description="The same for each scale.")
    views_checked: int | None = Field(None, description="While `measuring`: completed views of this check of quality.")
    views_to_check: int | None = Field(None, description="While `measuring`: all views of this check of quality.")
    seconds: float | None = Field(None, description="Seconds of all steps so far.")

    @property
    def is_step(self) -> bool:
        """Whether this is the progress after a step of the optimization."""
        return self.loss is not None

    @property
    def completed(self) -> tuple[str, int, int]:
        """Return the unit of the stage, and the number of completed and of all units."""
        if self.views_to_check is not None:
            return "view", self.views_checked or 0, self.views_to_check
        return _UNITS.get(self.stage, "step"), self.step, self.total

    @property
    def note(self) -> str:
        """Return the loss and the remaining time as text; empty if both are unknown."""
        loss = self.mean_loss or self.loss
        return ", ".join(filter(None, ("" if loss is None else f"loss {loss:.3g}", time_left(self.eta_s))))

    def text(self, title: str | None = None) -> str:
        """Return the progress as a line, which starts with the stage or the `title` of it."""
        unit, done, total = self.completed
        stage = title or self.stage
        return ", ".join(filter(None, (f"{stage}: {unit} {done} of {total}" if total else stage, self.note)))
