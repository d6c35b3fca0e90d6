"""What of the folder that an attempt writes to goes into the store of files, as it appears there."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from safetensors import SafetensorError, safe_open

from service.errors import StoreError
from service.files.artifacts import Artifacts
from service.files.names import CHECKPOINT, RESULT
from service.store.leases import Published

_STEM = Path(RESULT).stem
#: What there is once a job has ended, by the endings of the files' names.
_RESULTS = {
    "report.json": f"{_STEM}.report.json",
    "report.html": f"{_STEM}.report.html",
    "before_after.jpg": f"{_STEM}.before_after.jpg",
    "loss.png": f"{_STEM}.loss.png",
    "colors.f16": f"{_STEM}.colors.f16",
}
#: Names of files that become visible with the job's end, and not before.
RESULTS = frozenset((RESULT, *_RESULTS))


class Outbox:
    """Puts files under names of an attempt's epoch into the store; rows make them visible later.

    Args:
        out: the folder that the attempt writes to.
    """

    def __init__(self, job_id: str, epoch: int, out: Path, artifacts: Artifacts) -> None:
        self._job_id, self._epoch = job_id, epoch
        self._out, self._artifacts = out, artifacts
        self._put: dict[str, tuple[int, int]] = {}

    def unfinished(self) -> dict[str, Path]:
        """What may be looked at while the job runs, whether it is there or not."""
        files = {
            "plan.json": self._out / f"{_STEM}.plan.json",
            "views.jpg": self._out / f"{_STEM}.views.jpg",
            CHECKPOINT: self._out / f"{_STEM}.checkpoint.safetensors",
        }
        previews = self._out / "previews"
        if previews.is_dir():
            files |= {f"previews/{path.name}": path for path in previews.glob("step_*.jpg")}
        return files

    def results(self) -> dict[str, Path]:
        """What a job that has ended has made."""
        files = {RESULT: self._out / RESULT} | {name: self._out / file for name, file in _RESULTS.items()}
        return {name: path for name, path in files.items() if path.is_file()}

    def put(self, files: Mapping[str, Path]) -> tuple[list[Published], StoreError | None]:
        """Put those files that are new or have changed; returns them, and what kept the others from being put."""
        done = []
        for name, path in files.items():
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                stamp = (status.st_size, status.st_mtime_ns)
                if self._put.get(name) == stamp:
                    continue
                try:
                    done.append(self._put_file(name, path))
                except StoreError as error:
                    return done, error
                self._put[name] = stamp
        return done, None

    def _put_file(self, name: str, path: Path) -> Published:
        step = _saved_step(path) if name == CHECKPOINT else None
        # a later checkpoint takes the name of this one, and leaves its bytes; nobody writes to results any more
        final = name == CHECKPOINT or name in RESULTS
        return replace(self._artifacts.put(self._job_id, self._epoch, name, path, final=final), step=step)


def _saved_step(checkpoint: Path) -> int | None:
    """The step that a checkpoint was saved at; None for one that is damaged, which the next attempt will find out.

    Raises:
        FileNotFoundError: it has just been removed.
    """
    try:
        with safe_open(checkpoint, "np") as file:
            return int(file.metadata()["step"])
    except (SafetensorError, TypeError, KeyError):
        return None
