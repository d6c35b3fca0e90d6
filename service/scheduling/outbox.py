"""Upload of files from the folder of an attempt to the file store as they appear."""

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
#: Result files of an ended job by artifact name.
_RESULTS = {
    "report.json": f"{_STEM}.report.json",
    "report.html": f"{_STEM}.report.html",
    "before_after.jpg": f"{_STEM}.before_after.jpg",
    "loss.png": f"{_STEM}.loss.png",
    "colors.f16": f"{_STEM}.colors.f16",
}
#: Names of files that become visible only when the job ends.
RESULTS = frozenset((RESULT, *_RESULTS))


class Outbox:
    """Uploader of an attempt's files; users can see them only once they have database rows.

    Args:
        out: Folder that the attempt writes to.
    """

    def __init__(self, job_id: str, epoch: int, out: Path, artifacts: Artifacts) -> None:
        self._job_id, self._epoch = job_id, epoch
        self._out, self._artifacts = out, artifacts
        self._put: dict[str, tuple[int, int]] = {}

    def unfinished(self) -> dict[str, Path]:
        """Return the files that are visible while the job runs; some may not exist yet."""
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
        """Return the result files of an ended job."""
        files = {RESULT: self._out / RESULT} | {name: self._out / file for name, file in _RESULTS.items()}
        return {name: path for name, path in files.items() if path.is_file()}

    def put(self, files: Mapping[str, Path]) -> tuple[list[Published], StoreError | None]:
        """Upload new and changed files; return them, and the error that stopped the upload (None for no error)."""
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
        # a later checkpoint replaces the file instead of overwriting its bytes, and results are never rewritten
        final = name == CHECKPOINT or name in RESULTS
        return replace(self._artifacts.put(self._job_id, self._epoch, name, path, final=final), step=step)


def _saved_step(checkpoint: Path) -> int | None:
    """Return the step of a checkpoint; None if it is damaged, which the next attempt detects.

    Raises:
        FileNotFoundError: If the checkpoint has just been removed.
    """
    try:
        with safe_open(checkpoint, "np") as file:
            return int(file.metadata()["step"])
    except (SafetensorError, TypeError, KeyError):
        return None
