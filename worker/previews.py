"""Preview images of a running job, and its colors for clients that watch it in 3D."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from sgsst_core.files.images import save_jpg
from sgsst_core.scene.camera import resized
from sgsst_core.stylizing.result_colors import transferred_colors
from sgsst_core.stylizing.stylizer import Stylizer
from worker.live import LiveColors

#: Minimum time between two previews, as a fraction of the job's elapsed time. It limits the number of previews.
_SHARE = 0.05
#: Maximum length of a preview's longer side in pixels.
_SIDE = 960
#: Maximum length of the thumbnail's longer side in pixels.
_THUMBNAIL_SIDE = 480
#: Name of the thumbnail. Clients show the last preview by name.
_THUMBNAIL = "thumbnail.jpg"


class Previews:
    """Preview callback for `loop.Callbacks.preview`.

    A preview is a render of the first evaluation view with the current colors. One is also written before the first
    step, with the colors of a warm start, so that users get a first impression of the result within seconds.

    Args:
        folder: Folder of the JPEGs (`step_0000123.jpg`). It is created with the first preview. Colors are written to
            the folder `live` beside it.
        seconds: Minimum seconds between two previews.
        written: Callback that receives the path of each preview.
        warn: Callback that receives the reason why a preview is missing. A missing preview does not fail the job.

    Attributes:
        live: Writer of the colors.
    """

    def __init__(
        self, folder: Path, seconds: float, written: Callable[[Path], None], warn: Callable[[str], None]
    ) -> None:
        self._folder = folder
        self._seconds = seconds
        self._written = written
        self._warn = warn
        self._started = self._last = time.monotonic()
        self.live = LiveColors(folder.parent / "live", warn)

    def __call__(self, stylizer: Stylizer) -> None:
        """Write a preview and the colors, each if enough time has passed since the last time."""
        self.live(stylizer)
        now = time.monotonic()
        if stylizer.step and now - self._last < max(self._seconds, _SHARE * (now - self._started)):
            return
        try:
            path = self._write(stylizer)
        except Exception as error:
            self._warn(f"The preview could not be rendered: {error}")
        else:
            self._written(path)
        self._last = time.monotonic()

    def finish(self, stylizer: Stylizer) -> None:
        """Write the thumbnail of a finished job: a view whose left half is unstylized. It replaces the previews."""
        try:
            before = _rendered(stylizer, stylizer.job.views.scene.sh_dc.to(stylizer.sh_dc.device), _THUMBNAIL_SIDE)
            after = _rendered(stylizer, stylizer.shown(), _THUMBNAIL_SIDE)
            middle = before.shape[1] // 2
            path = self._path(_THUMBNAIL)
            save_jpg(path, torch.cat([before[:, :middle], after[:, middle:]], dim=1))
        except Exception as error:
            self._warn(f"The thumbnail could not be rendered: {error}")
        else:
            self._written(path)

    def _write(self, stylizer: Stylizer) -> Path:
        path = self._path(f"step_{stylizer.step:07d}.jpg")
        colors = stylizer.shown() if stylizer.step else transferred_colors(stylizer.job).to(stylizer.sh_dc.device)
        save_jpg(path, _rendered(stylizer, colors, _SIDE))
        return path

    def _path(self, name: str) -> Path:
        self._folder.mkdir(parents=True, exist_ok=True)
        return self._folder / name


def _rendered(stylizer: Stylizer, colors: Tensor, side: int) -> Tensor:
    """Render the first evaluation view with colors [n, 3] at a limited size, on this rank alone."""
    views, index = stylizer.job.views, stylizer.job.evaluation_views[0]
    camera = views.cameras[index]
    if camera.side > side:
        camera = resized(camera, side)
    with torch.no_grad():
        return views.rasterizer.render(views.colors(index, colors), camera)
