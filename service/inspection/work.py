"""Request to `service.inspection.process`, which its client sends as a line of JSON. PyTorch is not imported."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict

from service.files.staging import Staged
from service.parameters import JobParameters
from worker.job import SceneRequest


class WorkRequest(BaseModel):
    """Request to read the files of a job.

    Attributes:
        work: Kind of work, from `process.WORK`.
        staged: Paths of the files, relative to the folder; the scene is the job's result for work on that.
        seconds: Limit of CPU time in seconds.
        memory: Memory limit in bytes for reading.
        limits: Limits of the service for a job's inputs; empty for work on results.
        options: Values that only one kind of work needs.
        output: Name and maximum bytes of the only file that may be written; None for none.
    """

    model_config = ConfigDict(frozen=True)

    work: str
    folder: Path
    staged: Staged
    parameters: JobParameters
    seconds: float
    memory: int
    limits: dict[str, int] = {}
    options: dict[str, Any] = {}
    output: tuple[str, int] | None = None
    threads: int = 1

    @property
    def source(self) -> SceneRequest:
        """Return the request for scene and cameras."""
        return SceneRequest.of(self.staged.scene, self.staged.cameras, self.parameters)

    @property
    def output_file(self) -> Path:
        """Return the file to write, relative to the folder."""
        assert self.output is not None
        return Path(self.output[0])
