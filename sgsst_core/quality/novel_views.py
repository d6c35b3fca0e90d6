"""Measurements on novel views, which lie between the cameras of a job: Gram distance and multi-view consistency.

Consistency is how much the images of two cameras differ where both see the same surface. View j is warped into view i
using rendered depth. The images are then compared over the pixels where both views see the same surface, by RMSE and by
LPIPS averaged over these pixels. Short-range consistency compares adjacent views, long-range consistency views 7 apart
(Huang et al., "Learning to Stylize Novel Views", ICCV 2021).

Even the views of an unstylized scene differ, for three reasons: colors depend on the view, interpolation smooths the
warped view a little, and depth is a mean over translucent Gaussians. Compare the values before and after stylization.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import StyleTargets
from sgsst_core.planning.survey import sees_something
from sgsst_core.quality.judge import MIN_SIDE, Lpips, shown
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.regions import RegionMaps
from sgsst_core.scene.camera import Camera, between, moved, nearest_walk, resized, similarly_rotated, spread
from sgsst_core.scene.gaussians import Scene
from sgsst_core.stylizing.stylizer import ShowViews, show_nothing
from sgsst_core.stylizing.views import ViewColors

#: Maximum number of views whose Gram distance is measured, and of pairs compared per range.
MAX_VIEWS = 4
#: Longer side in pixels of the renders that show whether a view sees anything.
_SEEN_SIDE = 160


@dataclass(frozen=True)
class NovelViewMoment:
    """Measurement of the novel views after one step.

    Attributes:
        gram: Gram distance by scale: sum over layers of w_G mean((G - G_v)^2), averaged over views (see
            `sgsst_core.loss`).
        gram_relative: Mean of `gram` over scales, relative to the run's first measurement; None if there are no views.
        short, long: Consistency of pairs of views 1 and 7 apart; None if there is no such pair.
    """

    gram: dict[int, float]
    gram_relative: float | None
    short: Consistency | None
    long: Consistency | None

    def as_dict(self, step: int, seconds: float) -> dict[str, Any]:
        """Return the measurement after `step` steps and `seconds` of optimization as JSON-serializable values."""
        return {
            "step": step,
            "seconds": seconds,
            "gram": {str(scale): value for scale, value in self.gram.items()},
            "gram_relative": self.gram_relative,
            "consistency": {"short": self.short and asdict(self.short), "long": self.long and asdict(self.long)},
        }


class NovelViews:
    """Measurements on the novel views of one job.

    Args:
        covered: Indices of the cameras that see at least one Gaussian.
        scene: Scene to stylize. Gaussians missing from it are missing in the novel views too.
        rasterizer: Rasterizer of the scene, preferably not shared with the job: in a shared `cached` rasterizer, blend
            weights of novel views would evict those of the job's own views.
        loss: Loss that supplies network, memory budget and tile size. A separate loss with the same properties is
            evaluated, so the timer of this one does not run.
        style_targets: Function that returns the style targets of `loss` for views of a camera's size.
        weighted: Whether to weight statistics by rendered coverage, as the job does.
        lpips: LPIPS network; None skips LPIPS.
        most: Maximum number of views whose Gram distance is measured, and of pairs compared per range.
        memory: Memory budget in bytes for colors, warps and images. What does not fit is recomputed.
        maps: Region maps that match `style_targets`; None if the scene has no regions.

    Attributes:
        cameras: All novel views.
        views: Indices of the views whose Gram distance is measured, at most `most`. If empty, there is nothing to
            measure.
        pairs: Pairs of views to compare, at most `most`, by gap.
        first: `NovelViewMoment.gram` of the run's first measurement; None before it.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        covered: Sequence[int],
        scene: Scene,
        rasterizer: Rasterizer,
        loss: SosLoss,
        style_targets: Callable[[Camera], StyleTargets],
        *,
        weighted: bool,
        lpips: Lpips | None = None,
        most: int = MAX_VIEWS,
        memory: int = 1 << 29,
        maps: RegionMaps | None = None,
    ) -> None:
        self.scene = scene
        self.rasterizer = rasterizer
        self.lpips = lpips
        self.weighted = weighted
        self.first: dict[int, float] | None = None
        self._style_targets = style_targets
        self._maps = maps
        self._loss = SosLoss(
            loss.network,
            content_weight=0.0,
            memory=loss.memory,
            tile_size=loss.tiling.tile_size,
            coarsest=loss.tiling.coarsest,
            scales=loss.weights,
        )
        self.cameras = [between(*pair) for pair in neighbors([cameras[index] for index in covered])]
        chosen = {gap: view_pairs(len(self.cameras), gap, most) for gap in (SHORT_RANGE, LONG_RANGE)}
        # Use the first views of the short-range pairs: they are rendered anyway, and spread just as evenly.
        views = [first for first, _ in chosen[SHORT_RANGE]] or list(range(min(len(self.cameras), most)))
        used = {*views, *(index for pairs in chosen.values() for pair in pairs for index in pair)}
        small = {index: resized(self.cameras[index], min(_SEEN_SIDE, self.cameras[index].side)) for index in used}
        seeing = {index for index, camera in small.items() if sees_something(rasterizer.coverage(camera))}
        self.views = [index for index in views if index in seeing]
        self.pairs = {gap: [pair for pair in pairs if seeing.issuperset(pair)] for gap, pairs in chosen.items()}
        self._colors = ViewColors(scene, self.cameras, rasterizer.device, memory // 8)
        self._warps: Cache[tuple[int, int], Warp] = Cache(memory // 2, lambda warp: warp.nbytes)
        self._image_memory = memory // 4

    @torch.no_grad()
    def measure(self, sh_dc: Tensor, show: ShowViews = show_nothing) -> NovelViewMoment:
        """Measure the scene with colors `sh_dc` [N, 3]; `show` is called before each view.

        Raises:
            ValueError: If an image contains NaN or infinity.
        """
        images: Cache[int, Tensor] = Cache(self._image_memory)
        sh_dc = sh_dc.detach().to(self.rasterizer.device)

        def rendered(index: int) -> Tensor:
            camera, colors = self.cameras[index], self._colors(index, sh_dc)
            return shown(self.rasterizer.render(colors, camera), camera, self.rasterizer.device)

        def image(index: int) -> Tensor:
            return images.get(index, partial(rendered, index))

        gram = self._gram(image, show)
        self.first = self.first or gram
        start = _mean_gram(self.first)
        return NovelViewMoment(
            gram,
            _mean_gram(gram) / start if start else None,
            self._consistency(SHORT_RANGE, image),
            self._consistency(LONG_RANGE, image),
        )

    def _gram(self, image: Callable[[int], Tensor], show: ShowViews) -> dict[int, float]:
        """Compute the Gram distance by scale, as the mean over the views that have the scale."""
        values: dict[int, list[float]] = {}
        for done, index in enumerate(self.views):
            show(done, len(self.views))
            coverage = self.rasterizer.coverage(self.cameras[index]) if self.weighted else None
            target = self._loss.targets.of_view(image(index), coverage)
            if self._maps is not None:
                fractions = self._maps.render(self.cameras[index]).unbind(2)
                target.regions = [self._loss.targets.position_weights(fraction) for fraction in fractions]
            style = self._style_targets(self.cameras[index])
            for scale, terms in self._loss.evaluate(image(index), style, target, gradient=False).terms.items():
                values.setdefault(scale, []).append(terms["gram"])
        return {scale: sum(own) / len(own) for scale, own in sorted(values.items())}

    def _consistency(self, gap: int, image: Callable[[int], Tensor]) -> Consistency | None:
        if not self.pairs[gap]:
            return None

        def warp(first: int, second: int) -> Warp:
            return self._warps.get((first, second), partial(find, first, second))

        def find(i: int, j: int) -> Warp:
            depth, other = (expected_depth(self.scene, self.cameras[k], self.rasterizer) for k in (i, j))
            return find_warp(other, self.cameras[j], depth, self.cameras[i])

        return consistency(gap, self.pairs[gap], image, warp, self.lpips)


def _mean_gram(gram: dict[int, float]) -> float:
    return sum(gram.values()) / max(len(gram), 1)


#: Index difference of the two views of a pair.
SHORT_RANGE, LONG_RANGE = 1, 7
#: Coverage above which a pixel's depth counts as known. With less coverage, the background mixes into its color.
COVERED = 0.9
#: Maximum relative difference between the depths of one surface in two views. In object scans, values above 0.01
#: increase color errors where one limb occludes another. In scenes trained from few photos, whose translucent Gaussians
#: have no well-defined depth, only values above 0.05 increase them; smaller values compare fewer pixels at nearly the
#: same RMSE.
DEPTH_TOLERANCE = 0.02
#: Maximum interpolation weight of invalid source pixels (outside the view, uncovered, or on another surface) in a valid
#: pixel. It tolerates the rounding of positions at pixel centers, and is invisible in 8-bit images.
_FOREIGN_FRACTION = 1e-3
#: Fraction of comparable pixels below which a pair has no RMSE or LPIPS.
MINIMUM_COMPARED = 0.01
#: Number of pixels warped at a time. Each takes memory for about forty values.
_BAND_PIXELS = 1 << 19
#: Number of Gaussians whose depths are computed at a time.
_GAUSSIANS = 1 << 18


@dataclass(frozen=True)
class Consistency:
    """Consistency of pairs of views `gap` apart. Means skip pairs without a value.

    Attributes:
        pairs: Number of pairs.
        compared: Mean fraction of the first view's pixels that could be compared with the second one's.
        rmse: Mean root mean square difference of the colors (0 to 1) over those pixels; None if no pair has a value.
        lpips: Mean LPIPS, averaged over those pixels; None if no pair has a value.
    """

    gap: int
    pairs: int
    compared: float
    rmse: float | None
    lpips: float | None


@dataclass(frozen=True)
class DepthMap:
    """Rendered depth of a view.

    Attributes:
        depth: Mean camera-space z [H, W] of the Gaussians in each pixel, weighted by blend weight, in world units,
            float32; 1 where unknown.
        known: Mask [H, W] bool of the pixels whose coverage exceeds `COVERED`.
    """

    depth: Tensor
    known: Tensor


def consistency(
    gap: int,
    pairs: Sequence[tuple[int, int]],
    image: Callable[[int], Tensor],
    warp: Callable[[int, int], Warp],
    lpips: Lpips | None = None,
) -> Consistency:
    """Compute the consistency of at least one pair of views `gap` apart.

    Args:
        image: Function that returns the image [H, W, 3] of a view as a screen shows it (`shown`).
        warp: Function that returns the warp of a pair's second view into the first one.
        lpips: LPIPS network; None skips LPIPS.
    """
    results = [compare(image(first), *warp(first, second).apply(image(second)), lpips) for first, second in pairs]
    compared, rmse, distances = zip(*results, strict=True)
    return Consistency(gap, len(results), sum(compared) / len(results), _mean(rmse), _mean(distances))


def view_pairs(count: int, gap: int, at_most: int | None = None) -> list[tuple[int, int]]:
    """Return all pairs (i, i + gap) of `count` views, or at most `at_most` evenly spread ones."""
    firsts = range(max(count - gap, 0))
    return [(i, i + gap) for i in (firsts if at_most is None else spread(firsts, at_most))]


def expected_depth(scene: Scene, camera: Camera, rasterizer: Rasterizer) -> DepthMap:
    """Render the depth of a view.

    Rendering is linear in the colors, so z is rendered like a color. Two channels of one image hold the sum of z
    weighted by blend weights, and the sum of the blend weights. Rounding errors of the blend weights cancel in the
    ratio of both. The image of all-black Gaussians is subtracted to remove the background.
    """
    pose = camera.world_to_camera.double()
    colors = torch.zeros((len(scene), 3), dtype=rasterizer.dtype)
    colors[:, 1] = 1
    for start in range(0, len(scene), _GAUSSIANS):
        part = slice(start, start + _GAUSSIANS)
        # Computed in float64, because both terms are large if the scene is far from the origin.
        colors[part, 0] = (scene.means[part].double() @ pose[2, :3] + pose[2, 3]).to(rasterizer.dtype)
    sums = rasterizer.render(colors, camera) - rasterizer.render(torch.zeros_like(colors), camera)
    weighted, weights = sums[..., 0], sums[..., 1]
    known = (weights > COVERED) & weighted.isfinite() & (weighted > 0)
    depth = torch.where(known, weighted / torch.where(known, weights, 1.0), 1.0)
    return DepthMap(depth.float(), known)


def project_pixels(
    depth: Tensor,  # [h, W], rows of the camera's view
    first_row: int,
    camera: Camera,
    other: Camera,
) -> tuple[Tensor, Tensor, Tensor]:
    """Project pixel centers, at the given depths, into another view.

    Returns x and y in pixels, and z in the other camera's space, each [h, W] float64. Where z <= 0 (behind the other
    camera), x and y are finite but meaningless.
    """
    device = depth.device
    pose, other_pose = camera.world_to_camera.double(), other.world_to_camera.double()
    rotation = other_pose[:3, :3] @ pose[:3, :3].T
    translation = other_pose[:3, 3] - rotation @ pose[:3, 3]
    columns = (torch.arange(camera.width, dtype=torch.float64, device=device) + (0.5 - camera.cx)) / camera.fx
    rows = torch.arange(depth.shape[0], dtype=torch.float64, device=device)
    rows = (rows + (first_row + 0.5 - camera.cy)) / camera.fy
    rays = torch.stack(torch.broadcast_tensors(columns, rows[:, None], torch.ones_like(depth).double()), dim=-1)
    points = (rays * depth.double()[..., None]) @ rotation.T.to(device) + translation.to(device)
    x, y, z = points.unbind(-1)
    divisor = torch.where(z > 0, z, 1.0)
    return other.fx * x / divisor + other.cx, other.fy * y / divisor + other.cy, z


@dataclass(frozen=True)
class Warp:
    """Mapping from the pixels of a view to interpolated pixels of another view that sees the same surface.

    A warp depends only on geometry, so it can be reused when the colors of the scene change.

    Attributes:
        pixels: Row-major indices [P] of the view's pixels with a match in the other view, int64.
        sources: Row-major indices [4, P] of the four surrounding pixels in the other view, int32.
        weights: Interpolation weights [4, P] that sum to 1 for each pixel, float32.
    """

    size: tuple[int, int]
    pixels: Tensor
    sources: Tensor
    weights: Tensor

    @property
    def nbytes(self) -> int:
        """Memory use in bytes."""
        return sum(t.numel() * t.element_size() for t in (self.pixels, self.sources, self.weights))

    def apply(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Warp the other view's image [H', W', 3]; return an image [H, W, 3] and the mask [H, W] of valid pixels."""
        flat = image.reshape(-1, 3)
        colors = flat.new_zeros((len(self.pixels), 3))
        for source, weight in zip(self.sources, self.weights, strict=True):
            colors += weight[:, None].to(flat.dtype) * flat[source]
        height, width = self.size
        warped = flat.new_zeros((height * width, 3))
        warped[self.pixels] = colors
        valid = torch.zeros(height * width, dtype=torch.bool, device=flat.device)
        valid[self.pixels] = True
        return warped.view(height, width, 3), valid.view(height, width)


def find_warp(
    other_depth: DepthMap,
    other: Camera,
    depth: DepthMap,
    camera: Camera,
    *,
    tolerance: float = DEPTH_TOLERANCE,
) -> Warp:
    """Compute the warp of another view into the view of `camera`.

    Each pixel is unprojected by its depth and projected into the other view, where the four surrounding pixels are
    interpolated. A source pixel is valid if it lies within the other view, its depth is known, and its depth matches
    that of the projected point within the relative tolerance. A mismatch means that the other view sees another surface
    there (occlusion), or that a depth edge runs between the four pixels. If more than a negligible fraction of the
    interpolation weight falls on invalid source pixels, the pixel is omitted.
    """
    pixels, sources, weights = [], [], []
    step = max(1, _BAND_PIXELS // camera.width)
    for top in range(0, camera.height, step):
        band = slice(top, top + step)
        x, y, z = project_pixels(depth.depth[band], top, camera, other)
        projected = depth.known[band] & (z > 0) & (x >= 0) & (x <= other.width) & (y >= 0) & (y <= other.height)
        source, weight = _around(other_depth, x[projected], y[projected], z[projected], tolerance)
        fraction = weight.sum(dim=0)
        agrees = fraction > 1 - _FOREIGN_FRACTION
        pixels.append(projected.view(-1).nonzero()[agrees, 0] + top * camera.width)
        sources.append(source[:, agrees])
        weights.append(weight[:, agrees] / fraction[agrees])
    return Warp((camera.height, camera.width), torch.cat(pixels), torch.cat(sources, dim=1), torch.cat(weights, dim=1))


def _around(
    depth: DepthMap,
    x: Tensor,  # [P] float64, pixels, in 0..W
    y: Tensor,  # [P] float64, pixels, in 0..H
    z: Tensor,  # [P] float64
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """Return the indices [4, P] int32 and weights [4, P] float32 of the four pixels around each position.

    The weight of an invalid pixel is 0: outside the view, of unknown depth, or at a depth that differs from z.
    """
    height, width = depth.depth.shape
    right, below = torch.tensor([[0, 0, 1, 1], [0, 1, 0, 1]], device=x.device)[:, :, None]
    left, top = (x - 0.5).floor(), (y - 0.5).floor()
    across, down = ((x - 0.5) - left).float(), ((y - 0.5) - top).float()
    columns, rows = left.long() + right, top.long() + below
    inside = (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    index = rows.clamp(0, height - 1) * width + columns.clamp(0, width - 1)
    its_depth = depth.depth.view(-1)[index]
    agrees = (its_depth >= z * (1 - tolerance)) & (its_depth <= z * (1 + tolerance))
    weights = torch.where(right > 0, across, 1 - across) * torch.where(below > 0, down, 1 - down)
    return index.int(), torch.where(inside & depth.known.view(-1)[index] & agrees, weights, 0.0)


def compare(
    image: Tensor, warped: Tensor, valid: Tensor, lpips: Lpips | None
) -> tuple[float, float | None, float | None]:
    """Compare a view's image [H, W, 3] with another view's warped image, where the mask `valid` [H, W] is true.

    Returns:
        Fraction of the pixels that could be compared; their RMSE, None if there are too few; and their mean LPIPS, None
            if there are too few, the view is too small, or LPIPS is off.
    """
    count = int(valid.sum())
    compared = count / valid.numel()
    if count == 0 or compared < MINIMUM_COMPARED:
        return compared, None, None
    rmse = float((image[valid].double() - warped[valid].double()).square().mean().sqrt())
    distance = None
    if lpips is not None and min(valid.shape) >= MIN_SIDE:
        # Fill invalid pixels with the view's own image: holes would add edges to the features of valid pixels.
        filled = torch.where(valid[..., None], warped, image)
        distances = lpips.distance(image, filled)
        distance = float(distances[valid.to(distances.device)].mean(dtype=torch.float64))
    return compared, rmse, distance


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


#: Distance, relative to the median distance of consecutive cameras, beyond which two cameras are not neighbors. The
#: capture was probably interrupted between them.
JUMP = 4.0


def neighbors(cameras: list[Camera]) -> list[tuple[Camera, Camera]]:
    """Return the pairs of neighboring cameras between which novel cameras are placed.

    Adjacent cameras of the list are paired. If most of them are not neighbors (see `JUMP` and `LARGEST_ROTATION`), the
    list is assumed not to be in capture order, and a greedy walk to the nearest remaining camera replaces it. Pairs
    with the same pose are omitted. The result is empty for fewer than two cameras.
    """
    if len(cameras) < 2:
        return []
    centers = torch.stack([camera.center for camera in cameras])
    rotations = torch.stack([camera.world_to_camera[:3, :3].double() for camera in cameras])
    walk = nearest_walk(centers, rotations)
    steps = (centers[walk[1:]] - centers[walk[:-1]]).norm(dim=1)
    moves = steps[torch.from_numpy(moved(steps.numpy(), centers.numpy()))]
    reach = JUMP * float(moves.median()) if len(moves) else math.inf

    def pairs(order: Sequence[int]) -> list[tuple[Camera, Camera]]:
        return [
            (cameras[i], cameras[j])
            for i, j in itertools.pairwise(order)
            if float((centers[i] - centers[j]).norm()) <= reach
            and bool(similarly_rotated(rotations[i], rotations[j]))
            and not torch.allclose(cameras[i].world_to_camera, cameras[j].world_to_camera)
        ]

    in_order = pairs(range(len(cameras)))
    return in_order if 2 * len(in_order) >= len(cameras) - 1 else max(in_order, pairs(walk), key=len)
