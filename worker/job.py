"""A job as data: what came out of it (`Result`); `sgsst_core.progress` has what is happening.

Neither PyTorch nor Ray is imported.
"""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel, ConfigDict, Field


class Result(BaseModel):
    """Result of a job. Its record in the service leaves out the last two fields, which the report has in detail.

    Attributes:
        stopped: Reason why the job ended; see `stylizing.loop.run`. If it is "interrupted", only a checkpoint was
            written.
        steps, total: Number of completed steps, and number of all steps.
        loss_before: Mean loss of the unstylized scene on the evaluation views; None if the job was interrupted.
        loss_after: Mean loss of the last round of views, over the same scales; None if the job was interrupted.
        report_error: Reason why the report, contact sheet or loss curves are missing; None if they were written.
        compressed: Text about the quality of the compressed file; None if no compressed file was requested.
        loss_over_time: Summary for the report; None if no step was made on all scales.
    """

    model_config = ConfigDict(frozen=True)

    stopped: str
    steps: int
    total: int
    loss_before: float | None = None
    loss_after: float | None = None
    report_error: str | None = None
    compressed: str | None = Field(None, exclude=True)
    loss_over_time: dict[str, Any] | None = Field(None, exclude=True)
