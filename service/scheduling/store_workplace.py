"""Description of a job's files for ranks on machines that share only the file store with the dispatcher (`Workplace`).

Whatever stages the files is imported when a rank needs it: the process of an attempt without a workplace must not wait.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from service.files.staging import CHECKPOINT
from service.states import Published
from sgsst_core.errors import InfrastructureError
from worker.ranks.memory import scene_bytes
from worker.ranks.rank import Stored

if TYPE_CHECKING:
    from service.scheduling.rank_folder import RankFolder


@dataclass(frozen=True)
class StoredFile:
    """File in the store."""

    name: str
    sha256: str
    size: int


@dataclass(frozen=True)
class StoreWorkplace:
    """Description of a job's files for its ranks.

    Attributes:
        job_id, epoch: Prefix of the job's stored files.
        inputs: `role`, `name`, `sha256` and `size` of each input, for `stage`.
        checkpoint: Checkpoint to resume from; None for none.
        weights: Feature network weights by file name; empty to use the machine's own.
    """

    url: str
    job_id: str
    epoch: int
    inputs: tuple[dict[str, Any], ...]
    files: tuple[StoredFile, ...]
    checkpoint: StoredFile | None
    weights: dict[str, StoredFile]

    @property
    def scene_bytes(self) -> int:
        """Size of the scene in bytes, once it is read."""
        files = [entry for entry in self.inputs if entry["role"] == "scene"]
        return sum(scene_bytes(entry["name"], entry["size"]) for entry in files)

    def open(self, rank: int, stored: Stored) -> RankFolder:
        """Stage the job's files for a rank.

        Missing files are fetched once into the machine's cache, which all its ranks share.

        Raises:
            InfrastructureError: If the store is unreachable or has lost a file, or the disk is full.
        """
        from service.scheduling.rank_folder import RankFolder

        try:
            return RankFolder(self, rank, stored)
        except OSError as error:
            raise InfrastructureError(f"The job's files cannot be staged here: {error}.") from error

    def after(self, stored: Sequence[Published]) -> StoreWorkplace:
        """Return a copy whose checkpoint is the last one among these files."""
        saved = [file for file in stored if file.name == CHECKPOINT]
        if not saved:
            return self
        return replace(self, checkpoint=StoredFile(saved[-1].location, saved[-1].sha256, saved[-1].size))

    def tidy(self) -> None:
        """Remove folders of dead ranks on this machine."""
        from service.scheduling.rank_folder import remove_leftovers

        remove_leftovers()
