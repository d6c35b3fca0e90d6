"""Colors of a running job for clients that watch it in 3D."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

from sgsst_core.files.scene_file import write_scene
from sgsst_core.files.stylized_ply import write_colors
from sgsst_core.scene.gaussians import Scene
from sgsst_core.stylizing.stylizer import Stylizer

#: Minimum seconds between two writes, and as a fraction of the elapsed time. They limit the number of files.
_SECONDS, _ELAPSED_SHARE = 2.0, 0.02
#: Maximum fraction of the elapsed time that writing may take.
_COST_SHARE = 0.01


class LiveColors:
    """Writer of a job's current colors (`colors.f16` as in `files.colors`), each time in place of the former ones.

    Gaussians that no view shows have their original colors, because theirs are computed only at the end.

    Args:
        folder: Folder of the files. It is created with the first one.
        warn: Callback that receives the reason why a file is missing. A missing file does not fail the job.
    """

    def __init__(self, folder: Path, warn: Callable[[str], None]) -> None:
        self._folder = folder
        self._warn = warn
        self._started = self._due = time.monotonic()

    def share_scene(self, scene: Scene) -> None:
        """Write the scene to which the colors belong (`scene.ply`), whose rows are not those of the job's input."""
        self._write(lambda: write_scene(self._path("scene.ply"), scene))

    def __call__(self, stylizer: Stylizer) -> None:
        """Write the colors after a step if enough time has passed since the last time."""
        started = time.monotonic()
        if not stylizer.step or started < self._due:
            return
        self._write(lambda: self._write_colors(stylizer))
        now = time.monotonic()
        self._due = now + max(_SECONDS, _ELAPSED_SHARE * (now - self._started), (now - started) / _COST_SHARE)

    def _write_colors(self, stylizer: Stylizer) -> None:
        job = stylizer.job
        colors = job.scene.sh_dc.clone()
        colors[job.plan.seen] = stylizer.shown().cpu()
        write_colors(self._path("colors.f16"), colors)

    def _write(self, write: Callable[[], None]) -> None:
        try:
            write()
        except Exception as error:
            self._warn(f"The colors to watch could not be written: {error}")

    def _path(self, name: str) -> Path:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self._folder / name
