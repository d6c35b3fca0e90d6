"""Survey of all views before the job, and checks whether scene, cameras and photos belong together.

The survey takes one pass of the rasterizer per view (`Rasterizer.survey`) and does not use the feature network. Views
are distributed among ranks. The thresholds of the checks separate real captures from rotated, scaled and cropped ones
(`benchmarks/results/README.md`).
"""

import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import mean, median

import torch
from torch import Tensor

from sgsst_core.errors import CameraError
from sgsst_core.features.partition import Rectangle, covered_region
from sgsst_core.files.images import Photo, load_photo
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.progress import Decision, Progress
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.scene.camera import Camera, resized, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors

#: Below this coverage, the color of a pixel is invisible in 8 bits.
SEEN_COVERAGE = 1 / 255


#: Callback for the progress of the stages before the steps.
ShowPlanning = Callable[[Progress], None]


def progress_of(surveyed: int, total: int, ranks: int, stage: str = "planning") -> Progress:
    """Return the progress of all ranks, assuming that they are as fast as this one.

    Args:
        surveyed: Number of views that this rank has surveyed.
        total: Number of views that all ranks survey.
    """
    return Progress(stage=stage, step=min(total, surveyed * ranks), total=total)


def sees_something(coverage: Tensor) -> bool:
    """Return whether anything is visible in a view, given its coverage [H, W]."""
    return float(coverage.amax()) > SEEN_COVERAGE


@dataclass(frozen=True)
class Survey:
    """Result of surveying the views.

    Attributes:
        total_blend_weights: [N] float64, blend weights of each Gaussian summed over all pixels of all views.
        covered: Indices of the views that see anything.
        regions: Rectangle of each view that contains all covered pixels.
        uncovered_fraction: Fraction of uncovered pixels in the views that see anything.
    """

    total_blend_weights: Tensor
    covered: list[int]
    regions: list[Rectangle]
    uncovered_fraction: float


def survey_views(
    scene: Scene,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    collectives: Collectives = ALONE,
    show: ShowPlanning | None = None,
    visit: Callable[[Camera, Tensor], None] | None = None,
) -> Survey:
    """Survey every view once; all ranks get the same result.

    Args:
        show: Callback, called before the first view of this rank and after each view.
        visit: Callback for each view of this rank that sees anything: its camera, and blend weights [N] on the CPU.

    Raises:
        CameraError: If no camera sees a Gaussian.
    """
    weights = torch.zeros(len(scene), dtype=torch.float64, device=rasterizer.device)
    views: dict[int, tuple[Rectangle, float, bool]] = {}  # region, uncovered pixels, whether anything is seen
    indices = range(collectives.rank, len(cameras), collectives.size)
    for done, index in enumerate([*indices, None]):
        if show:
            show(progress_of(done, len(cameras), collectives.size))
        if index is not None:
            coverage, summed = rasterizer.survey(cameras[index])
            uncovered, seen = float((1 - coverage).sum(dtype=torch.float64)), sees_something(coverage)
            views[index] = covered_region(coverage), uncovered, seen
            if seen:
                weights += summed.double()
                if visit:
                    visit(cameras[index], summed.cpu())
    for others in collectives.all_gather(views):
        views |= others
    pixels = [camera.width * camera.height for camera in cameras]
    covered = [index for index in range(len(cameras)) if views[index][2]]
    if not covered:
        raise nothing_seen(scene.means, cameras, rasterizer.near)
    return Survey(
        collectives.all_reduce(weights).cpu(),
        covered,
        [views[index][0] for index in range(len(cameras))],
        sum(views[index][1] for index in covered) / sum(pixels[index] for index in covered),
    )


#: Gaussians and cameras that are looked at.
_GAUSSIANS, _CAMERAS = 20_000, 200
#: Least fraction of the Gaussians in a frame, and of all, that the near plane hides if it is reported. Captures in
#: meters have nearly none.
_MUCH_OF_FRAMES, _MUCH_OF_SCENE = 0.1, 0.01
#: Fraction of the Gaussians in the frames that a suggested near plane may hide.
_NEAREST = 0.01


@dataclass(frozen=True)
class Shown:
    """Fractions of a scene's Gaussians whose centers are in the frames of cameras.

    Attributes:
        typical: Fraction in one frame, median over the cameras.
        together: Fraction in at least one frame.
    """

    typical: float
    together: float


def shown_by(means: Tensor, cameras: Sequence[Camera], near: float) -> Shown:
    """Return how much of a scene cameras show, from samples of both.

    Args:
        means: Centers of the Gaussians, [N, 3].
        cameras: At least one camera.
        near: Distance of the near plane in world units.
    """
    points = means[:: max(1, len(means) // _GAUSSIANS)].double()
    together, fractions = torch.zeros(len(points), dtype=torch.bool), []
    for camera in spread(cameras, _CAMERAS):
        x, y, z = (points @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).unbind(1)
        across, down = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside = (z > near) & (across >= 0) & (across < camera.width) & (down >= 0) & (down < camera.height)
        together |= inside
        fractions.append(float(inside.double().mean()))
    return Shown(median(fractions), float(together.double().mean()))


def near_plane(means: Tensor, cameras: Sequence[Camera], near: float) -> tuple[str, float] | None:
    """Return how many Gaussians the near plane hides in the frames of cameras, and one that hides nearly none.

    The arguments are those of `shown_by`. The result is None if the near plane hides few.
    """
    drawn, in_frames = (shown_by(means, cameras, each).together for each in (near, 0.0))
    if in_frames - drawn < max(_MUCH_OF_SCENE, _MUCH_OF_FRAMES * in_frames):
        return None
    nearer = (near / 10.0**power for power in range(1, 30))
    enough = (each for each in nearer if shown_by(means, cameras, each).together >= (1 - _NEAREST) * in_frames)
    count = round((in_frames - drawn) * len(means))
    text = f"{count:,} of {len(means):,} Gaussians are in their frames, but nearer than the near plane at {near:g}"
    return text, next(enough, near / 1e30)


def nothing_seen(means: Tensor, cameras: Sequence[Camera], near: float) -> CameraError:
    """Return the error for cameras that see no Gaussian, which names the near plane if that is the cause.

    The arguments are those of `shown_by`.
    """
    none = f"None of the {len(cameras)} cameras sees a Gaussian"
    if hidden := near_plane(means, cameras, near):
        return CameraError(f"{none}: {hidden[0]}. Add --near {hidden[1]:g}, which suits the scene's units.")
    return CameraError(
        f"{none}. Check that cameras and scene belong together (same training run, same world), or let an orbit make "
        "the cameras."
    )


#: A typical view of a capture shows more of the Gaussians than this, or few uncovered pixels.
_LITTLE_SHOWN, _MUCH_UNCOVERED = 0.25, 0.1
#: Cameras that together see less than half of the scene are refused if a typical view is nearly empty.
_NEARLY_NOTHING, _MOSTLY_UNCOVERED, _HALF = 0.01, 0.4, 0.5
#: Start of the warning about cameras that show little of the scene.
OTHER_FRAME = "warning: they may be in another coordinate frame"
#: What no real capture has: a text, the value of a camera, the scene's center [3] and extent, and its bounds. Telephoto
#: lenses have 30 times the width of their sensors, anamorphic ones a ratio of 2.
_BOUNDS: tuple[tuple[str, Callable[[Camera, Tensor, float], float], float, float], ...] = (
    ("a focal length, relative to the image's side,", lambda camera, *_: camera.fx / camera.width, 0.1, 30.0),
    ("a ratio of both focal lengths", lambda camera, *_: camera.fx / camera.fy, 0.45, 2.2),
    ("a principal point, relative to the image's width,", lambda camera, *_: camera.cx / camera.width, 0.0, 1.0),
    ("a principal point, relative to the image's height,", lambda camera, *_: camera.cy / camera.height, 0.0, 1.0),
    (
        "a distance from the scene, relative to its extent,",
        lambda camera, center, extent: float((camera.center - center).norm()) / extent,
        0.0,
        1000.0,
    ),
)
#: Gaussians from which center and extent are estimated, and the part of them that lies within.
_SAMPLE, _WITHIN = 20_000, 0.9
#: PSNR in dB below which photos are reported. Right photos have 26 to 31; cropped by 10 %, 20.
_UNLIKE_PSNR = 22.0
#: Rendered views that are looked at.
_VIEWS = 4
#: Longer side in pixels of rendered views, and of those that are compared. Comparing averages of pixels matters: small
#: Gaussians are wider and brighter in small renders.
_SIDE, _COMPARED_SIDE = 256, 128
#: Coverage of pixels that are compared, and least fraction of them in a view. A scan has no background, its photos do.
_COVERED, _LEAST_COMPARED = 0.98, 0.02
#: Added to squared errors, so that equal images have a finite PSNR.
_TINY = 1e-12


def frame_warnings(scene: Scene, cameras: Sequence[Camera], near: float) -> list[Decision]:
    """Return a warning if the near plane hides much, or cameras seem to be in another coordinate frame than the scene.

    Views are rendered only if they show few Gaussians. Panoramas say nothing about the frame: together, the faces of
    one show every Gaussian in any frame.

    Raises:
        CameraError: If the cameras show almost nothing of the scene.
    """
    single = [camera for camera in cameras if camera.panorama is None]
    shown = shown_by(scene.means, single or cameras, near)
    hidden = [
        Decision("cameras", f"warning: {text}", f"they are not drawn; add --near {closer:g} to draw them")
        for text, closer in filter(None, [near_plane(scene.means, single or cameras, near)])
    ]
    if not single or shown.typical >= _LITTLE_SHOWN or (hidden and shown.together):
        return hidden
    rasterizer = make_rasterizer("cpu", scene, near=near)
    views = [resized(camera, _SIDE) for camera in spread(single, _VIEWS)]
    uncovered = mean(float(1 - rasterizer.coverage(view).mean(dtype=torch.float64)) for view in views)
    if uncovered == 1:
        raise nothing_seen(scene.means, single, near)
    if uncovered <= _MUCH_UNCOVERED or hidden:
        return hidden
    text = (
        f"a typical view has {shown.typical:.1%} of the Gaussians in its frame and shows nothing in {uncovered:.0%} of "
        "its pixels"
    )
    advice = (
        "use the cameras of the scene's own training run and world. With nerfstudio, put the run's "
        "dataparser_transforms.json beside transforms.json; for a scene trained on COLMAP's model, give that model"
    )
    if shown.typical < _NEARLY_NOTHING and shown.together < _HALF and uncovered > _MOSTLY_UNCOVERED:
        raise CameraError(
            f"Cameras and scene have different coordinate frames: {text}, and all {len(single)} views together reach "
            f"{shown.together:.1%}. Instead, {advice}."
        )
    return [Decision("cameras", f"{OTHER_FRAME}: {text}", advice)]


def implausible(means: Tensor, cameras: Sequence[Camera]) -> Iterator[Decision]:
    """Yield warnings about values of cameras that no real capture has.

    Args:
        means: Positions of the scene, [N, 3].
    """
    points = means[:: max(1, len(means) // _SAMPLE)].double()
    center = points.median(dim=0).values
    extent = max(float((points - center).norm(dim=1).quantile(_WITHIN)), _TINY)
    for text, value_of, low, high in _BOUNDS:
        values = [(value_of(camera, center, extent), camera.name) for camera in cameras]
        wrong = [(value, name) for value, name in values if not low <= value <= high]
        if wrong:
            warning = f"warning: {len(wrong)} of {len(cameras)} have {text} that no real capture has"
            reason = f"{wrong[0][1]} has {wrong[0][0]:.3g}; expected {low:g} to {high:g}. Export the cameras again"
            yield Decision("cameras", warning, f"{reason}, with the sizes of their images and the scene's units")


def compare_photos(
    scene: Scene, cameras: Sequence[Camera], photos: Sequence[Photo], near: float
) -> tuple[list[Photo], list[Decision]]:
    """Compare some photos with renders of the scene, without differences of exposure and white balance.

    Returns:
        Photos, those that fit in both orientations in the better one; and the decisions about them.

    Raises:
        ImageError: If a photo cannot be read.
    """
    likeness = functools.partial(_likeness, scene, make_rasterizer("cpu", scene, near=near))
    photos, decisions = list(photos), []
    doubtful = [index for index, photo in enumerate(photos) if photo.ambiguous]
    if doubtful:
        some = spread(doubtful, _VIEWS)
        stored = mean(likeness(photos[index], cameras[index]) or 0.0 for index in some)
        oriented = mean(likeness(replace(photos[index], oriented=True), cameras[index]) or 0.0 for index in some)
        if oriented > stored:
            photos = [replace(photo, oriented=True) if photo.ambiguous else photo for photo in photos]
        used = f"the EXIF orientation of {len(doubtful)} photos is {'applied' if oriented > stored else 'ignored'}"
        reason = (
            f"PSNR against renders is {max(stored, oriented):.1f} dB so, and {min(stored, oriented):.1f} dB otherwise"
        )
        decisions.append(Decision("photos", used, reason))
    pairs = spread(list(zip(photos, cameras, strict=True)), _VIEWS)
    values = [likeness(photo, camera) for photo, camera in pairs]
    psnr = median([value for value in values if value is not None] or [math.inf])
    if psnr < _UNLIKE_PSNR:
        decisions.append(
            Decision(
                "photos",
                f"warning: they differ from the scene's renders ({psnr:.1f} dB PSNR; at least {_UNLIKE_PSNR:.0f} are "
                "expected)",
                "they may be cropped, belong to other cameras, or the scene is in another coordinate frame; compare "
                "them with the images of `sgsst render`",
            )
        )
    return photos, decisions


def _likeness(scene: Scene, rasterizer: Rasterizer, photo: Photo, camera: Camera) -> float | None:
    """Return the PSNR in dB of a photo against its view's render; None if the scene covers too little of it."""
    view = resized(camera, min(camera.side, _SIDE))
    compared = _averaged(rasterizer.coverage(view)[..., None])[..., 0] > _COVERED
    if float(compared.double().mean()) < _LEAST_COMPARED:
        return None
    render = _averaged(rasterizer.render(scene_colors(scene, view), view))
    return fitted_psnr(_averaged(load_photo(photo, view)), render, compared)


def _averaged(image: Tensor) -> Tensor:
    """Return an image [H, W, C] reduced to about `_COMPARED_SIDE` pixels, by averages of squares of pixels."""
    factor = max(1, max(image.shape[:2]) // _COMPARED_SIDE)
    if factor == 1 or min(image.shape[:2]) < factor:
        return image
    return torch.nn.functional.avg_pool2d(image.permute(2, 0, 1)[None], factor)[0].permute(1, 2, 0)


def fitted_psnr(photo: Tensor, render: Tensor, weight: Tensor) -> float:
    """Return the PSNR in dB of a photo after the affine map of each channel that brings it closest to the render.

    Args:
        photo: Image [H, W, 3].
        render: Image of the same size.
        weight: Weight of each pixel, [H, W].
    """
    w = weight.double().flatten()[:, None]
    x, y = photo.double().flatten(0, 1), render.double().flatten(0, 1)
    total = w.sum().clamp_min(_TINY)
    x, y = x - (w * x).sum(0) / total, y - (w * y).sum(0) / total
    variance, covariance = (w * x * x).sum(0), (w * x * y).sum(0)
    slope = (covariance / variance.clamp_min(_TINY)).clamp_min(0)  # an inverted photo is none of the scene
    error = float((w * (y - slope * x) ** 2).sum() / (3 * total))
    return -10 * math.log10(error + _TINY)


def psnr(error: float) -> float:
    """Return the PSNR in dB for a mean squared error of values in 0..1.

    Errors below 1e-14, the float32 resolution, count as 1e-14.
    """
    return -10 * math.log10(max(error, 1e-14))
