"""Findings about the render mode of a scene: what it changes, and whether another one is more likely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sgsst_core.errors import TooManyIntersectionsError
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.quality.findings import Finding
from sgsst_core.quality.scene_difference import scene_psnr
from sgsst_core.rasterizer.projection import Column, Shapes, project
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering

#: Number of compared views.
_VIEWS = 8
#: Opacity above which a Gaussian counts as opaque, and factor of compensation below which it is small: at 0.5, its area
#: is about a third of that of the blur.
_OPAQUE, _SMALL = 0.5, 0.5
#: Fraction of small ones among the opaque Gaussians of a view, above which a scene that states no mode is reported.
_MANY = 0.2


def render_mode_findings(file: SceneFile, cameras: Sequence[Camera], *, near: float) -> list[Finding]:
    """Return what an antialiased mode changes in views, and whether a scene that states no mode may need it.

    Args:
        file: Scene file.
        cameras: Cameras of the views.
        near: Distance of the near plane in world units.
    """
    scene, views = file.scene, spread(list(cameras), min(_VIEWS, len(cameras)))
    if scene.rendering.antialiased:
        difference = _difference(scene, CLASSIC, views, near)
        why = "as the file states" if scene.rendering == file.tag.rendering else "as requested"
        return [Finding("scene", f"drawn {scene.rendering.text}", len(scene), len(scene), difference, why)]
    if file.tag.reason or not views:
        return []
    small, opaque = small_gaussians(scene, views, near)
    if small <= _MANY * opaque:
        return []
    difference = _difference(scene, Rendering("antialiased", scene.rendering.eps2d), views, near)
    done = "drawn classic; if the scene was trained with antialiasing, add --render-mode antialiased"
    what = "opaque but smaller than a pixel, as in antialiased scenes; the file states no mode"
    return [Finding("scene", what, small, opaque, difference, done)]


def small_gaussians(scene: Scene, cameras: Sequence[Camera], near: float) -> tuple[int, int]:
    """Return the numbers of small opaque Gaussians, and of opaque ones, as means over views."""
    scene = replace(scene, rendering=replace(scene.rendering, mode="classic"))
    compensated = replace(scene, rendering=replace(scene.rendering, mode="antialiased"))
    shapes, counts = Shapes.of(scene), []
    for camera in cameras:
        opacity, after = np.zeros(len(scene)), np.zeros(len(scene))
        for each, values in ((scene, opacity), (compensated, after)):
            projection = project(each, camera, near=near, shapes=shapes)
            values[projection.gaussians] = np.exp2(projection.values[:, Column.LOG2_OPACITY])
        opaque = opacity > _OPAQUE
        counts.append((int((opaque & (after < _SMALL * opacity)).sum()), int(opaque.sum())))
    small, total = np.mean(counts, axis=0).round().astype(int)
    return int(small), int(total)


def _difference(scene: Scene, rendering: Rendering, views: Sequence[Camera], near: float) -> str:
    """Return how much renders in another mode differ, as text."""
    try:
        psnr = scene_psnr(scene, replace(scene, rendering=rendering), views, near=near)
    except TooManyIntersectionsError:  # reported as a finding of the views
        return ""
    differ = "the same renders as" if psnr is None else f"{psnr:.1f} dB PSNR against"
    return f"{differ} {rendering.text}, in {len(views)} views"
