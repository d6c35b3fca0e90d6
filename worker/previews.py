"""Pictures of a running job."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import torch

from sgsst_core.files.images import save_jpg
from sgsst_core.scene.camera import resized
from sgsst_core.stylizing.stylizer import Stylizer

#: Previews become rarer as a job goes on: this share of its time lies between two, so that there are never thousands.
_SHARE = 0.05
#: Longer side, pixels.
_SIDE = 960


class Previews:
    """Writes the first evaluation view with its present colors now and then; for `loop.Callbacks.preview`.

    Before the first step there is one, too, with the colors of a warm start: it shows in seconds where the
    job goes.

    Args:
        folder: of the JPEGs, `step_0000123.jpg` and so on; made at the first of them.
        seconds: between two, at least.
        written: told the path of each.
        warn: told why one is missing: a picture less is no reason to lose the job.
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
        """Write one, if it is time."""
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
        views = stylizer.views
        index = stylizer.evaluation_views[0]
        camera = views.cameras[index]
        if camera.side > _SIDE:
            camera = resized(camera, _SIDE)
        path = self._folder / f"step_{stylizer.step:07d}.jpg"
        path.parent.mkdir(parents=True, exist_ok=True)
        colors = stylizer.shown() if stylizer.step else stylizer.transferred().to(stylizer.sh_dc.device)
        with torch.no_grad():
            # The rasterizer's own render: other ranks take no part in it.
            image = views.rasterizer.render(views.colors(index, colors), camera)
        save_jpg(path, image)
        return path
