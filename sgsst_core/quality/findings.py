"""Warnings about extreme values in a scene, its views and its style, shown before a long job.

Each finding has a count, the worst case and its consequence. What has no consequence, such as needles and long
quaternions, is not reported. Findings are not errors: the file readers reject unusable input.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from sgsst_core.constants import ALPHA_MIN, FRUSTUM_MARGIN
from sgsst_core.features.vgg import ALIGNMENT
from sgsst_core.files.scene_file import SceneFile
from sgsst_core.planning.survey import Survey, survey_views
from sgsst_core.quality.measure import scene_psnr
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.rasterizer.cpu import Column, Shapes, project
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.colors import style_size
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC, Rendering
from sgsst_core.style import Style

#: Size relative to the scene's extent above which a Gaussian is larger than the scene.
LARGE_SCALE = 1.0
#: Log scale above which the determinant of the projected covariance overflows: exp(177)^4 exceeds float64.
OVERFLOW_SCALE = 177.0
#: SH coefficients of trained scenes stay within a few units; 20 corresponds to a color of 6.
LARGE_COEFFICIENT = 20.0
#: Distance from the world's origin, in scene extents, at which float32 positions have a spacing of about a thousandth
#: of the extent.
FAR_WORLD = 1e4
#: Total blend weight below which a Gaussian changes no view by a gray level.
HARDLY_SEEN = 1.0 / 255.0
#: Total blend weight below which a Gaussian is in no view; sums of weights are 0 or much larger.
_NO_WEIGHT = 1e-300
#: Field of view in degrees above which perspective varies so much within one Gaussian that its linear approximation is
#: inaccurate.
WIDE = 140.0
#: Uncovered fraction of a view above which the view is reported.
UNCOVERED = 0.01
#: Aspect ratio of a style image beyond which it is reported.
LONG_STYLE = 4.0
#: Standard deviation below which a style image counts as untextured: one gray level.
FLAT_STYLE = 1.0 / 255.0
#: Number of Gaussians from which the scene's extent is estimated.
_SAMPLE = 50_000
#: Number of Gaussians processed at a time. Each takes a few tens of bytes in float64.
_PART = 1 << 17
#: Number of views that are compared between render modes.
_VIEWS = 8
#: Opacity above which a Gaussian counts as opaque, and factor of compensation below which it is small: at 0.5, its area
#: is about a third of that of the blur.
_OPAQUE, _SMALL = 0.5, 0.5
#: Fraction of small ones among the opaque Gaussians of a view, above which a scene that states no mode is reported.
_MANY = 0.2

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
    findings = [*scene_findings(file), *view_findings(file, cameras, survey, near=near)]
    images = () if style is None else Style.of(style).images
    return [*findings, *(finding for image in images for finding in style_findings(image, cameras))]


@dataclass(frozen=True)
class _Question:
    """Property of Gaussians that is extreme above a bound, or below it.

    Attributes:
        value: Function that returns the values [n] of a slice of n Gaussians. NaN is never extreme.
    """

    what: str
    done: str
    value: Callable[[slice], Tensor]
    bound: float
    below: bool = False


def scene_findings(file: SceneFile) -> list[Finding]:
    """Return the findings about a scene read with `drop_invalid`; indices are rows of the file."""
    scene, total = file.scene, len(file.scene)
    center, extent = _scene_extent(scene)
    findings = [Finding("scene", note, total, total, "", "") for note in file.notes]
    if file.retained is not None:
        what, first = "NaN or infinite values, or no rotation", int(np.flatnonzero(~file.retained)[0])
        done = "stylize rejects the scene; --drop-invalid drops these Gaussians, from the result too"
        findings.append(Finding("scene", what, file.dropped, len(file.retained), f"first: Gaussian {first}", done))
    if file.clamped:
        done = "read as almost 0 or 1, as in compressed formats; the stylized PLY keeps them"
        findings.append(Finding("scene", "infinite opacity", file.clamped, total, "", done))
    for question in _questions(scene, extent):
        findings += _asked("scene", file, question)
    return findings + _far_from_origin(file, center, extent)


def _questions(scene: Scene, extent: float) -> list[_Question]:
    def longest(part: slice) -> Tensor:
        return scene.scales[part].double().amax(dim=1)

    def relative(part: slice) -> Tensor:
        lengths = longest(part)
        ratios = (lengths - math.log(extent)).clamp(-700, 700).exp()
        return torch.where(lengths <= OVERFLOW_SCALE, ratios, math.nan)

    def opacity(part: slice) -> Tensor:
        return scene.opacities[part].double().sigmoid()

    def dc(part: slice) -> Tensor:
        return scene.sh_dc[part].abs().amax(dim=1)

    covers = "drawn; each may cover all raster tiles of all views, which costs time and memory"
    cubed = "unchanged; gradients grow with their third power, and a job stops if a gradient exceeds 1e19"
    reached = "; --target-loss may be reached at once, because they raise the initial loss"
    return [
        _Question("size that overflows (value: its logarithm)", "never drawn", longest, OVERFLOW_SCALE),
        _Question("longer than the scene's extent (value: ratio)", covers, relative, LARGE_SCALE),
        _Question("opacity below 1/255", "neither drawn nor optimized", opacity, ALPHA_MIN, below=True),
        _Question(f"DC SH coefficients above {LARGE_COEFFICIENT:g}", cubed + reached, dc, LARGE_COEFFICIENT),
    ]


def _asked(subject: Subject, file: SceneFile, question: _Question) -> list[Finding]:
    """Return a finding if at least one Gaussian is extreme. Slices avoid a float64 copy of the whole scene."""
    sign = -1.0 if question.below else 1.0
    count, worst, index = 0, -math.inf, -1
    for part in _parts(len(file.scene)):
        values = sign * question.value(part).double()
        values = torch.where(values > sign * question.bound, values, -math.inf)
        count += int((values > -math.inf).sum())
        largest = int(values.argmax())
        if float(values[largest]) > worst:
            worst, index = float(values[largest]), part.start + largest
    if not count:
        return []
    row = index if file.retained is None else int(np.flatnonzero(file.retained)[index])
    text = f"Gaussian {row}: {sign * worst:.3g}"
    return [Finding(subject, question.what, count, len(file.scene), text, question.done)]


def _far_from_origin(file: SceneFile, center: Tensor, extent: float) -> list[Finding]:
    far, total = float(center.norm()) / extent, len(file.scene)
    if far < FAR_WORLD:
        return []
    step = float(np.spacing(np.float32(center.abs().max())))
    done = "float32 positions are too coarse here; subtract an offset from those of Gaussians and cameras"
    worst = f"center {far:.3g} extents away; positions are {step:.3g} apart, {step / extent:.1e} of the extent"
    return [Finding("scene", "scene far from its origin", total, total, worst, done)]


def _scene_extent(scene: Scene) -> tuple[Tensor, float]:
    """Return the scene's center and extent.

    The center is the median position [3] float64. The extent is the 98 % quantile of the distances to it, or 1 if that
    is 0.
    """
    points = scene.means[:: max(1, len(scene) // _SAMPLE)].double()
    center = points.median(dim=0).values
    extent = float(torch.quantile((points - center).norm(dim=1), 0.98))
    return center, extent or 1.0


def view_findings(file: SceneFile, cameras: Sequence[Camera], survey: Survey, *, near: float) -> list[Finding]:
    """Return the findings about the views, and about Gaussians that the views hardly or never show."""
    return [
        *_placed(file.scene, cameras, near),
        *_uncovered(survey.uncovered, cameras),
        *_seldom_seen(file, survey.total_blend_weights),
    ]


def _of_views(
    what: str, values: list[float], extreme: list[bool], done: str, cameras: Sequence[Camera]
) -> list[Finding]:
    """Return a finding that names the extreme view with the largest value; empty if no view is extreme."""
    if not any(extreme):
        return []
    index = max((i for i, is_extreme in enumerate(extreme) if is_extreme), key=lambda i: values[i])
    worst = f"{cameras[index].name!r}: {values[index]:.4g}"
    return [Finding("views", what, sum(extreme), len(cameras), worst, done)]


def _placed(scene: Scene, cameras: Sequence[Camera], near: float) -> list[Finding]:
    """Report lenses and sizes of views, and cameras with Gaussians closer than the near plane."""
    angles = [
        max(math.degrees(2 * math.atan(side / 2 / focal)) for side, focal in ((c.width, c.fx), (c.height, c.fy)))
        for c in cameras
    ]
    small = [float(min(c.width, c.height)) for c in cameras]
    centers = torch.cat([torch.zeros(0, 3, dtype=torch.float64), *(camera.center[None].double() for camera in cameras)])
    close = [float(count) for count in closer(scene.means, centers, near)]
    linearized = (
        f"drawn; the perspective is linearized at each Gaussian's center, or at most {FRUSTUM_MARGIN:.0%} of half the "
        "view's width outside the view"
    )
    skipped = "feature layers without a cell are skipped in its loss"
    behind = "not drawn if they are in front of the near plane; use --near to move it"
    inside = f"camera inside the scene: Gaussians within {near:g} of it (value: count)"
    rows = [
        (f"field of view above {WIDE:g} degrees", angles, [angle > WIDE for angle in angles], linearized),
        (f"fewer than {ALIGNMENT} pixels on a side", small, [value < ALIGNMENT for value in small], skipped),
        (inside, close, [count > 0 for count in close], behind),
    ]
    return [finding for row in rows for finding in _of_views(*row, cameras)]


def closer(means: Tensor, centers: Tensor, distance: float) -> list[int]:
    """Count the points [N, 3] within a distance of each center [V, 3] float64.

    Points are first filtered by their x distance alone, which excludes almost all of them.
    """
    along = centers[:, 0].sort().values.contiguous()
    counts = [0] * len(centers)
    for part in _parts(len(means)):
        points = means[part].double()
        x = points[:, 0].contiguous()
        reach = distance * (1 + 1e-9) + 1e-12 * x.abs()  # includes a margin for rounding
        points = points[torch.searchsorted(along, x + reach, right=True) > torch.searchsorted(along, x - reach)]
        for view in range(len(centers) if len(points) else 0):
            counts[view] += int(((points - centers[view]).norm(dim=1) < distance).sum())
    return counts


def _uncovered(fractions: list[float], cameras: Sequence[Camera]) -> list[Finding]:
    """Report views that see nothing or leave pixels uncovered, given each view's fraction of uncovered pixels."""
    blind, partly = [fraction == 1 for fraction in fractions], [UNCOVERED < fraction < 1 for fraction in fractions]
    skipped = "skipped; a job needs at least one view that sees a Gaussian"
    what = f"more than {UNCOVERED:.0%} uncovered (value: fraction)"
    done = "statistics are weighted by coverage if the mean over all views exceeds 1 % (--position-weights auto)"
    return [
        *_of_views("see no Gaussian", fractions, blind, skipped, cameras),
        *_of_views(what, fractions, partly, done, cameras),
    ]


def _seldom_seen(file: SceneFile, blend_weights: Tensor) -> list[Finding]:
    """Report Gaussians that are hardly or never seen, given their total blend weights [N]."""
    unseen = "neither drawn nor optimized; their colors follow their neighbors' at the end (preset paper: unchanged)"
    what = "hardly seen: blend weights of all pixels sum to less than 1/255 (value: sum)"
    done = "optimized at the same rate as all others; their colors may be extreme from other viewpoints"
    seen = torch.where(blend_weights > 0, blend_weights, math.nan)
    questions = [
        _Question("in no view", unseen, lambda part: blend_weights[part], _NO_WEIGHT, below=True),
        _Question(what, done, lambda part: seen[part], HARDLY_SEEN, below=True),
    ]
    return [finding for question in questions for finding in _asked("views", file, question)]


def style_findings(style: Tensor, cameras: Sequence[Camera]) -> list[Finding]:
    """Return the findings about a style image [H, W, 3]."""
    height, width = int(style.shape[0]), int(style.shape[1])
    findings = []
    spread = float(style.double().std(dim=(0, 1), correction=0).max())
    if spread < FLAT_STYLE:
        done = "its features hardly vary, so the scene is pulled toward one flat color"
        findings.append(Finding("style", "one color throughout", 1, 1, f"standard deviation {spread:.2g}", done))
    aspect = max(height, width) / min(height, width)
    if aspect > LONG_STYLE:
        done = "used as a whole; its shorter side determines its size in the loss"
        findings.append(Finding("style", "extreme aspect ratio", 1, 1, f"{width} x {height}", done))
    used = [style_size((height, width), (camera.height, camera.width)) for camera in cameras]
    tiny = [size for size in used if min(size) < ALIGNMENT]
    if tiny:
        done = f"feature layers without a cell are skipped in the loss; use an image of at least {ALIGNMENT} pixels"
        smallest = min(tiny, key=min)
        findings.append(
            Finding("style", "too small for deep layers", 1, 1, f"used at {smallest[1]} x {smallest[0]}", done)
        )
    return findings


def _parts(count: int) -> list[slice]:
    """Split `count` rows into slices."""
    return [slice(start, min(start + _PART, count)) for start in range(0, count, _PART)]


def render_mode_findings(file: SceneFile, cameras: Sequence[Camera], *, near: float) -> list[Finding]:
    """Return what an antialiased mode changes in views, and whether a scene that states no mode may need it."""
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
    psnr = scene_psnr(scene, replace(scene, rendering=rendering), views, near=near)
    differ = "the same renders as" if psnr is None else f"{psnr:.1f} dB PSNR against"
    return f"{differ} {rendering.text}, in {len(views)} views"
