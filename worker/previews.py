"""Preview images of a running job, and its colors for clients that watch it in 3D."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from sgsst_core.files.images import save_jpg
from sgsst_core.files.scene_file import write_scene
from sgsst_core.files.stylized_ply import write_colors
from sgsst_core.planning.plan import LOSS_VIEWS
from sgsst_core.scene.camera import resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.stylizing.stylizer import Stylizer, render_first_view, transferred_colors
from worker.inputs import Inputs

#: Minimum time between two previews, as a fraction of the job's elapsed time. It limits the number of previews.
_SHARE = 0.05
#: Minimum time between a job's first previews, which differ most, in seconds and as a fraction of the elapsed time.
_FIRST_SECONDS, _FIRST_SHARE = 2.0, 0.1
#: Maximum length of a preview's longer side in pixels.
_SIDE = 960
#: Maximum length of the thumbnail's longer side in pixels.
_THUMBNAIL_SIDE = 480
#: Name of the thumbnail. Clients show the last preview by name.
_THUMBNAIL = "thumbnail.jpg"
#: Minimum time between two writes of the colors, in seconds and as a fraction of the elapsed time.
_COLOR_SECONDS, _COLOR_SHARE = 2.0, 0.02
#: Maximum fraction of the elapsed time that writing the colors may take.
_COST_SHARE = 0.01


class Previews:
    """Preview callback for `loop.Callbacks.preview`.

    A preview is a render of one view with the current colors. The first one is written before the job is planned, or
    before the first step on a GPU. It has the colors of a warm start, so that users get a first impression of the
    result within seconds.

    Args:
        folder: Folder of the JPEGs (`step_0000123.jpg`). It is created with the first preview. Colors are written to
            the folder `live` beside it.
        seconds: Minimum seconds between two previews, except for the first ones.
        warn: Callback that receives the reason why a preview is missing. A missing preview does not fail the job.
    """

    def __init__(self, folder: Path, seconds: float, warn: Callable[[str], None]) -> None:
        self._folder = folder
        self._seconds = seconds
        self._warn = warn
        self._started = time.monotonic()
        #: Time of the last preview; None before the first.
        self._last: float | None = None
        self.live = LiveColors(folder.parent / "live", warn)

    def write_first(self, inputs: Inputs, settings: Settings) -> None:
        """Write the first preview of a job that has not been planned, unless a GPU will plan it within seconds."""
        if torch.cuda.is_available():
            return
        camera = inputs.cameras[_shown_view(range(len(inputs.cameras)))]
        camera = resized(camera, min(camera.side, _SIDE))
        self._write(
            0, lambda: render_first_view(inputs.scene_file.scene, camera, inputs.style, settings, inputs.regions)
        )

    def __call__(self, stylizer: Stylizer) -> None:
        """Write a preview and the colors, each if enough time has passed since the last time."""
        self.live(stylizer)
        now, last = time.monotonic(), self._last
        elapsed = now - self._started
        wait = max(min(self._seconds, max(_FIRST_SECONDS, _FIRST_SHARE * elapsed)), _SHARE * elapsed)
        if last is not None and (not stylizer.step or now - last < wait):
            return
        self._write(stylizer.step, lambda: _rendered(stylizer, _colors(stylizer), _SIDE))

    def finish(self, stylizer: Stylizer) -> None:
        """Write the thumbnail of a finished job: a view whose left half is unstylized. It replaces the previews."""
        try:
            before = _rendered(stylizer, stylizer.job.views.scene.sh_dc.to(stylizer.sh_dc.device), _THUMBNAIL_SIDE)
            after = _rendered(stylizer, stylizer.shown(), _THUMBNAIL_SIDE)
            middle = before.shape[1] // 2
            save_jpg(self._path(_THUMBNAIL), torch.cat([before[:, :middle], after[:, middle:]], dim=1))
        except Exception as error:
            self._warn(f"The thumbnail could not be rendered: {error}")

    def _write(self, step: int, render: Callable[[], Tensor | None]) -> None:
        """Write the preview of a step, if there is an image to write."""
        try:
            image = render()
            if image is None:
                return
            save_jpg(self._path(f"step_{step:07d}.jpg"), image)
        except Exception as error:
            self._warn(f"The preview could not be rendered: {error}")
        self._last = time.monotonic()

    def _path(self, name: str) -> Path:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self._folder / name


def _shown_view(covered: Sequence[int]) -> int:
    """Return the index of the view that previews show, given those of the views that see anything.

    It is the first of those on which the loss is evaluated, if there is time for all of these.
    """
    return spread(covered, LOSS_VIEWS)[0]


def _colors(stylizer: Stylizer) -> Tensor:
    """Return the colors [n, 3] of a preview: before the first step, those of a warm start even if the job has none."""
    return stylizer.shown() if stylizer.step else transferred_colors(stylizer.job).to(stylizer.sh_dc.device)


def _rendered(stylizer: Stylizer, colors: Tensor, side: int) -> Tensor:
    """Render the view that previews show with colors [n, 3] at a limited size, on this rank alone."""
    views = stylizer.job.views
    index = _shown_view(views.covered)
    camera = views.cameras[index]
    camera = resized(camera, min(camera.side, side))
    with torch.no_grad():
        return views.rasterizer.render(views.colors(index, colors), camera)


class LiveColors:
    """Writer of a job's current colors (`colors.f16`), each time in place of the former ones.

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
        self._due = now + max(_COLOR_SECONDS, _COLOR_SHARE * (now - self._started), (now - started) / _COST_SHARE)

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
