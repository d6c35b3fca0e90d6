"""Warnings about extreme values in a scene, its views and its style, which a user can do something about.

Each finding has a count, the worst case, and its consequence or remedy. Findings are not errors: the file readers
reject unusable input.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sgsst_core.features.vgg import ALIGNMENT
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.planning.survey import Survey, survey_views
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.colors import style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.style import Style

#: Size relative to the scene's extent above which a Gaussian is larger than the scene.
LARGE_SCALE = 1.0
#: SH coefficients of trained scenes stay within a few units; 20 corresponds to a color of 6.
LARGE_COEFFICIENT = 20.0
#: Distance from the world's origin, in scene extents, at which float32 positions have a spacing of about a thousandth
#: of the extent.
FAR_WORLD = 1e4
#: Number of Gaussians from which the scene's extent is estimated.
_SAMPLE = 50_000

Subject = Literal["scene", "views", "style"]


@dataclass(frozen=True)
class Finding:
    """One extreme property of the input.

    Attributes:
        count, total: Number of affected items, and of all items.
        worst: Worst item and its value as text; may be empty.
    """

    subject: Subject
    what: str
    count: int
    total: int
    worst: str
    done: str


def findings_of(
    file: SceneFile,
    cameras: Sequence[Camera],
    style: Tensor | Style | None,
    *,
    near: float,
    survey: Survey | None = None,
) -> list[Finding]:
    """Return the findings about a scene read with `drop_invalid`, its views, and its style if given.

    Args:
        style: Style image [H, W, 3] or mixture; None skips the style.
        survey: Existing survey of the cameras; None surveys them.

    Raises:
        CameraError: If no camera sees a Gaussian.
        TooManyIntersectionsError: If a view cannot be rendered.
    """
    if survey is None:
        survey = survey_views(file.scene, cameras, make_rasterizer("cpu", file.scene, near=near))
    images = () if style is None else Style.of(style).images
    about_style = [finding for image in images for finding in style_findings(image, cameras)]
    return [*scene_findings(file), *view_findings(cameras, survey), *about_style]


def scene_findings(file: SceneFile) -> list[Finding]:
    """Return the findings about a scene read with `drop_invalid`; indices are rows of the file."""
    scene, total = file.scene, len(file.scene)
    center, extent = _scene_extent(scene)
    findings = [Finding("scene", note, total, total, "", "") for note in file.notes]
    if file.retained is not None:
        what, first = "NaN or infinite values, or no rotation", int(np.flatnonzero(~file.retained)[0])
        done = "stylize rejects the scene; --drop-invalid drops these Gaussians, from the result too"
        findings.append(Finding("scene", what, file.dropped, len(file.retained), f"first: Gaussian {first}", done))
    ratios = (scene.scales.amax(dim=1).double() - math.log(extent)).clamp(-700, 700).exp()
    covers = "each may cover all raster tiles of all views, which costs time and memory; remove them in an editor"
    findings += _extreme(file, "longer than the scene's extent (value: ratio)", ratios, LARGE_SCALE, covers)
    cubed = "unchanged; gradients grow with their third power, and a job stops if a gradient exceeds 1e19"
    reached = "--target-loss may be reached at once, because they raise the initial loss"
    what = f"DC SH coefficients above {LARGE_COEFFICIENT:g}"
    findings += _extreme(file, what, scene.sh_dc.abs().amax(dim=1), LARGE_COEFFICIENT, f"{cubed}; {reached}")
    far = float(center.norm()) / extent
    if far >= FAR_WORLD:
        step = float(np.spacing(np.float32(center.abs().max())))
        done = "float32 positions are too coarse here; subtract an offset from those of Gaussians and cameras"
        worst = f"center {far:.3g} extents away; positions are {step:.3g} apart, {step / extent:.1e} of the extent"
        findings.append(Finding("scene", "scene far from its origin", total, total, worst, done))
    return findings


def _extreme(file: SceneFile, what: str, values: Tensor, bound: float, done: str) -> list[Finding]:
    """Return a finding if a value [N] of a Gaussian is above the bound."""
    count, index = int((values > bound).sum()), int(values.argmax())
    if not count:
        return []
    row = index if file.retained is None else int(np.flatnonzero(file.retained)[index])
    return [Finding("scene", what, count, len(values), f"Gaussian {row}: {float(values[index]):.3g}", done)]


def _scene_extent(scene: Scene) -> tuple[Tensor, float]:
    """Return the scene's center and extent.

    The center is the median position [3] float64. The extent is the 98 % quantile of the distances to it, or 1 if that
    is 0.
    """
    points = scene.means[:: max(1, len(scene) // _SAMPLE)].double()
    center = points.median(dim=0).values
    extent = float(torch.quantile((points - center).norm(dim=1), 0.98))
    return center, extent or 1.0


def view_findings(cameras: Sequence[Camera], survey: Survey) -> list[Finding]:
    """Return a finding about the views that see nothing."""
    blind = [camera.name for index, camera in enumerate(cameras) if index not in survey.covered]
    if not blind:
        return []
    done = "skipped; a job needs at least one view that sees a Gaussian"
    return [Finding("views", "see no Gaussian", len(blind), len(cameras), f"first: {blind[0]!r}", done)]


def style_findings(style: Tensor, cameras: Sequence[Camera]) -> list[Finding]:
    """Return a finding about a style image [H, W, 3] that is too small for the views."""
    size = (int(style.shape[0]), int(style.shape[1]))
    height, width = min((style_size(size, (camera.height, camera.width)) for camera in cameras), key=min)
    if min(height, width) >= ALIGNMENT:
        return []
    done = f"feature layers without a cell are skipped in the loss; use an image of at least {ALIGNMENT} pixels"
    return [Finding("style", "too small for deep layers", 1, 1, f"used at {width} x {height}", done)]
