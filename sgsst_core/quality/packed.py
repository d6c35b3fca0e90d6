"""What a packed scene file loses: pictures of it against pictures of the scene that was packed."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sgsst_core.files.ply import read_scene
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors

#: Views that are looked at, and their longer side in pixels.
_VIEWS, _SIDE = 3, 256


@dataclass(frozen=True)
class PackedLoss:
    """A packed file beside the scene that it holds.

    Attributes:
        name: of the file.
        form: of the file.
        size: bytes.
        views: names of the views that were compared.
        psnr: peak signal-to-noise ratio of their pictures, colors clamped to 0..1, in dB; None where all are equal.
    """

    name: str
    form: str
    size: int
    views: list[str]
    psnr: float | None

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        psnr = None if self.psnr is None else round(self.psnr, 2)
        return {"name": self.name, "format": self.form, "bytes": self.size, "views": self.views, "psnr_db": psnr}

    @property
    def text(self) -> str:
        """In words."""
        psnr = "the same pictures as" if self.psnr is None else f"{self.psnr:.1f} dB PSNR against"
        return f"{self.form}, {self.size / 1e6:.1f} MB, {psnr} the PLY"


def measure_packed(
    path: Path,
    scene: Scene,
    cameras: Sequence[Camera],
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float,
) -> PackedLoss:
    """Read a packed file back, and compare small pictures of some of the views, rendered on the CPU.

    Args:
        path: the file.
        scene: that was packed.
        cameras: to choose from, at least one.

    Raises:
        SceneError: the file cannot be read.
    """
    back = read_scene(path)
    pairs = [make_rasterizer("cpu", each, background=background, near=near) for each in (scene, back.scene)]
    chosen = [resized(camera, min(_SIDE, max(camera.width, camera.height))) for camera in spread(cameras, _VIEWS)]
    squares = values = 0.0
    for camera in chosen:
        first, second = (
            rasterizer.render(view_colors(each.sh_dc, rest_colors(each.sh_rest, each.means, camera)), camera).clamp(
                0, 1
            )
            for rasterizer, each in zip(pairs, (scene, back.scene), strict=True)
        )
        squares += float((first.double() - second.double()).square().sum())
        values += first.numel()
    psnr = -10 * math.log10(squares / values) if squares else None
    return PackedLoss(path.name, back.form, path.stat().st_size, [camera.name for camera in chosen], psnr)
