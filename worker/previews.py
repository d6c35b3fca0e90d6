"""Preview images of a running job."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch

from sgsst_core.files.images import save_jpg
from sgsst_core.scene.camera import resized
from sgsst_core.stylizing.result_colors import transferred_colors
from sgsst_core.stylizing.stylizer import Stylizer

#: Minimum time between two previews, as a fraction of the job's elapsed time. It limits the number of previews.
_SHARE = 0.05
#: Maximum length of a preview's longer side in pixels.
_SIDE = 960


class Previews:
    """Preview callback for `loop.Callbacks.preview`.

    A preview is a render of the first evaluation view with the current colors. One is also written before the first
    step, with the colors of a warm start, so that users get a first impression of the result within seconds.

    Args:
        folder: Folder of the JPEGs (`step_0000123.jpg`). It is created with the first preview.
        seconds: Minimum seconds between two previews.
        written: Callback that receives the path of each preview.
        warn: Callback that receives the reason why a preview is missing. A missing preview does not fail the job.
    """

    def __init__(
        self, folder: Path, seconds: float, written: Callable[[Path], None], warn: Callable[[str], None]
    ) -> None:
        self._folder = folder
        self._seconds = seconds
        self._written = written
        self._warn = warn
        self._started = self._last = time.monotonic()

    def __call__(self, stylizer: Stylizer) -> None:
        """Write a preview if enough time has passed since the last one."""
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

    def _write(self, stylizer: Stylizer) -> Path:
        views = stylizer.job.views
        index = stylizer.job.evaluation_views[0]
        camera = views.cameras[index]
        if camera.side > _SIDE:
            camera = resized(camera, _SIDE)
        path = self._folder / f"step_{stylizer.step:07d}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        colors = stylizer.shown() if stylizer.step else transferred_colors(stylizer.job).to(stylizer.sh_dc.device)
        with torch.no_grad():
            # Only this rank renders here, so the distributed renderer cannot be used.
            image = views.rasterizer.render(views.colors(index, colors), camera)
        save_jpg(path, image)
        return path
