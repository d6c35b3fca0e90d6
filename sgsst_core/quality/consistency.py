"""Multi-view consistency: how much a scene's pictures differ where two cameras see the same point of it.

View j is warped into view i by the scene's own rendered depth and compared with it where both see the same surface:
RMSE, and LPIPS averaged over the same pixels. Short range compares neighbors, long range views 7 apart (the two ranges
of Huang et al., "Learning to Stylize Novel Views", ICCV 2021).

A scene without style has a distance above zero as well: view-dependent colors, interpolation (the warped view is
a little smoother), and depth that is a mean over translucent Gaussians. Numbers are to be read before and after
stylization.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.quality.lpips import Lpips
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Views between the two of a pair.
SHORT_RANGE, LONG_RANGE = 1, 7
#: A pixel has a depth where the Gaussians cover more of it than this; below, the background mixes into its color.
COVERED = 0.9
#: Depths of one surface in two views differ by no more than this share. On scans of objects the colors' error begins
#: to rise at 0.01, where one limb hides another; on a scene trained from few photos, whose translucent Gaussians have
#: no one depth, only at 0.05, and there a smaller value compares fewer pixels and gives nearly the same RMSE.
DEPTH_TOLERANCE = 0.02
#: Of an interpolated pixel, what may come from outside the view, from uncovered pixels or from another surface: enough
#: for rounding of a position that falls on a pixel center, too little to be seen in 8 bits.
_FOREIGN_SHARE = 1e-3
#: With a smaller share of pixels to compare, a pair says nothing about the scene.
MINIMUM_COMPARED = 0.01
#: Pixels warped at a time; some twenty values are held for each.
_BAND_PIXELS = 1 << 20
#: Gaussians whose depths are computed at a time.
_GAUSSIANS = 1 << 18

ImageSource = Callable[[int], Tensor]


@dataclass(frozen=True)
class PairConsistency:
    """One pair of views.

    Attributes:
        first, second: indices of the views; the second was warped into the first.
        compared: share of the first view's pixels that could be compared.
        rmse: root mean square difference of the colors (0..1) over those pixels; None where they are too few.
        lpips: LPIPS averaged over those pixels; None where they are too few, the view is too small for it, or it was
            not asked for.
    """

    first: int
    second: int
    compared: float
    rmse: float | None
    lpips: float | None


@dataclass(frozen=True)
class Consistency:
    """Pairs of views `gap` apart, ordered by their first view; means are over the pairs that have a value."""

    gap: int
    pairs: list[PairConsistency]

    @property
    def rmse(self) -> float | None:
        """Mean RMSE; None where no pair could be compared."""
        return _mean([pair.rmse for pair in self.pairs])

    @property
    def lpips(self) -> float | None:
        """Mean LPIPS; None where no pair has one."""
        return _mean([pair.lpips for pair in self.pairs])

    @property
    def compared(self) -> float:
        """Mean share of pixels that could be compared, over all pairs; 0 without pairs."""
        return _mean([pair.compared for pair in self.pairs]) or 0.0


@dataclass(frozen=True)
class DepthMap:
    """What is seen of a view's geometry.

    Attributes:
        depth: [H, W] float32, mean camera-space z of the Gaussians in a pixel weighted by their blend weights, world
            units; 1 where it is not known.
        known: [H, W] bool, covered by more than `COVERED`.
    """

    depth: Tensor
    known: Tensor


def consistency(
    images: ImageSource,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    scene: Scene,
    gap: int,
    lpips: Lpips | None = None,
    *,
    at_most: int | None = None,
) -> Consistency:
    """Consistency of a scene's pictures over all pairs of views (i, i + gap).

    Args:
        images: picture [H, W, 3] of a view by its index, compared as a screen shows it: clamped to 0..1.
        cameras: one for each view, neighbors in space being neighbors in the list.
        rasterizer: of the scene's geometry.
        scene: whose geometry says where views overlap.
        gap: `SHORT_RANGE`, `LONG_RANGE` or any other distance in the list, at least 1.
        lpips: evaluates LPIPS; None leaves it out.
        at_most: compare only so many pairs, evenly spread.

    Returns:
        One entry for each pair; none where there are no more views than `gap`.

    Raises:
        SettingsError: gap or at_most below 1.
        ValueError: a picture is not of its camera's size, or holds NaN or infinity.
    """
    views: dict[int, tuple[Tensor, DepthMap]] = {}
    results = []
    # Chain by chain (0, gap, 2 gap, ..., then 1, 1 + gap, ...): each pair shares a view with the one before it, so that
    # a view is rendered once and two are held, whatever the gap.
    for i, j in sorted(view_pairs(len(cameras), gap, at_most), key=lambda pair: (pair[0] % gap, pair[0])):
        views = {k: views.get(k) or _look(images(k), cameras[k], rasterizer, scene) for k in (i, j)}
        (image, depth), (other, other_depth) = views[i], views[j]
        warped, valid = warp(other, other_depth, cameras[j], depth, cameras[i])
        results.append(compare(i, j, image, warped, valid, lpips))
    return Consistency(gap, sorted(results, key=lambda pair: pair.first))


def view_pairs(count: int, gap: int, at_most: int | None = None) -> list[tuple[int, int]]:
    """Pairs (i, i + gap) of `count` views; at most so many, evenly spread.

    Raises:
        SettingsError: gap or at_most below 1.
    """
    if gap < 1 or (at_most is not None and at_most < 1):
        raise SettingsError(f"Pairs of views {gap} apart, at most {at_most}: both numbers must be at least 1.")
    total = max(count - gap, 0)
    parts = total if at_most is None else min(at_most, total)
    firsts = [(2 * part + 1) * total // (2 * parts) for part in range(parts)]  # the middle of each of equal parts
    return [(i, i + gap) for i in firsts]


def expected_depth(scene: Scene, camera: Camera, rasterizer: Rasterizer) -> DepthMap:
    """Depth of a view, from the rasterizer itself: it is linear in the colors, and z is a color like any other.

    Numerator (sum of w z) and denominator (sum of w) are channels of one image, so that whatever rounding the blend
    weights have falls out of their ratio. What the background adds is the image of black Gaussians.
    """
    pose = camera.world_to_camera.double()
    colors = torch.zeros((len(scene), 3), dtype=rasterizer.dtype)
    colors[:, 1] = 1
    for start in range(0, len(scene), _GAUSSIANS):
        part = slice(start, start + _GAUSSIANS)
        # float64: in a world moved far away both terms are large
        colors[part, 0] = (scene.means[part].double() @ pose[2, :3] + pose[2, 3]).to(rasterizer.dtype)
    sums = rasterizer.render(colors, camera) - rasterizer.render(torch.zeros_like(colors), camera)
    weighted, weights = sums[..., 0], sums[..., 1]
    known = (weights > COVERED) & weighted.isfinite() & (weighted > 0)
    depth = torch.where(known, weighted / torch.where(known, weights, 1.0), 1.0)
    return DepthMap(depth.float(), known)


def project_pixels(
    depth: Tensor,  # [h, W] of rows of the camera's view
    first_row: int,
    camera: Camera,
    other: Camera,
) -> tuple[Tensor, Tensor, Tensor]:
    """Where pixel centers at a depth lie in another view: x, y in pixels and z there, each [h, W] float64.

    x and y are without meaning where z <= 0, behind the other camera; they are finite there too.
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
    """The pixels of a view that another view sees as well, and how they are interpolated there.

    It follows from the geometry alone, and so is the same for all colors of a scene.

    Attributes:
        size: (H, W) of the view.
        pixels: [P] int64, which of its H W pixels, row by row.
        sources: [4, P] int32, the four pixels of the other view around each.
        weights: [4, P] float32, sum 1.
    """

    size: tuple[int, int]
    pixels: Tensor
    sources: Tensor
    weights: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes that it takes."""
        return sum(t.numel() * t.element_size() for t in (self.pixels, self.sources, self.weights))

    def apply(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """The other view's picture [H', W', 3] as the view would see it: [H, W, 3], and where that is valid, [H, W]."""
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
    """How another view's picture is brought into the view of `camera`.

    A pixel's point, from its own depth, is projected into the other view and the four pixels around it are
    interpolated. One of the four counts only if it lies within the view, has a known depth, and that depth agrees with
    the point's within the relative tolerance; otherwise the other view sees something else there (occlusion), or an
    edge runs between the four. Where more than a trace of the weight does not count, the pixel is left out.
    """
    pixels, sources, weights = [], [], []
    step = max(1, _BAND_PIXELS // camera.width)
    for top in range(0, camera.height, step):
        band = slice(top, top + step)
        x, y, z = project_pixels(depth.depth[band], top, camera, other)
        found = depth.known[band] & (z > 0) & (x >= 0) & (x <= other.width) & (y >= 0) & (y <= other.height)
        source, weight = _around(other_depth, x[found], y[found], z[found], tolerance)
        share = weight.sum(dim=0)
        agrees = share > 1 - _FOREIGN_SHARE
        pixels.append(found.view(-1).nonzero()[agrees, 0] + top * camera.width)
        sources.append(source[:, agrees])
        weights.append(weight[:, agrees] / share[agrees])
    return Warp((camera.height, camera.width), torch.cat(pixels), torch.cat(sources, dim=1), torch.cat(weights, dim=1))


def warp(
    image: Tensor,  # [H', W', 3] of the other view
    other_depth: DepthMap,
    other: Camera,
    depth: DepthMap,
    camera: Camera,
    *,
    tolerance: float = DEPTH_TOLERANCE,
) -> tuple[Tensor, Tensor]:
    """Another view's picture as `camera` would see it: [H, W, 3] in its dtype, and where that is valid, [H, W] bool.

    See `find_warp`; invalid pixels are 0.
    """
    return find_warp(other_depth, other, depth, camera, tolerance=tolerance).apply(image)


def _around(
    depth: DepthMap,
    x: Tensor,  # [P] float64, pixels, in 0..W
    y: Tensor,  # [P] float64, pixels, in 0..H
    z: Tensor,  # [P] float64
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """The four pixels around each position [4, P] int32 and their weights [4, P] float32: 0 where depths disagree."""
    height, width = depth.depth.shape
    left, top = (x - 0.5).floor(), (y - 0.5).floor()
    across, down = ((x - 0.5) - left).float(), ((y - 0.5) - top).float()
    nearest, farthest = z * (1 - tolerance), z * (1 + tolerance)
    sources, weights = [], []
    for right in (0, 1):
        for below in (0, 1):
            column, row = left.long() + right, top.long() + below
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            index = row.clamp(0, height - 1) * width + column.clamp(0, width - 1)
            its_depth = depth.depth.view(-1)[index]
            counts = inside & depth.known.view(-1)[index] & (its_depth >= nearest) & (its_depth <= farthest)
            weight = (across if right else 1 - across) * (down if below else 1 - down)
            sources.append(index.int())
            weights.append(torch.where(counts, weight, 0.0))
    return torch.stack(sources), torch.stack(weights)


def shown(image: Tensor, camera: Camera, device: torch.device) -> Tensor:
    """A picture [H, W, 3] of a view as a screen shows it, clamped to 0..1, on a device.

    Raises:
        ValueError: it is not of the camera's size, or holds NaN or infinity.
    """
    image = image.detach().to(device)
    if tuple(image.shape) != (camera.height, camera.width, 3):
        raise ValueError(
            f"picture of view {camera.name!r}: shape {tuple(image.shape)}, not {(camera.height, camera.width, 3)}"
        )
    if not bool(image.isfinite().all()):
        raise ValueError(f"picture of view {camera.name!r}: holds NaN or infinity")
    return image.clamp(0, 1).contiguous()


def compare(
    first: int, second: int, image: Tensor, warped: Tensor, valid: Tensor, lpips: Lpips | None
) -> PairConsistency:
    """Distances of a view's picture [H, W, 3] and another one warped into it, where that is valid, [H, W]."""
    count = int(valid.sum())
    compared = count / valid.numel()
    if count == 0 or compared < MINIMUM_COMPARED:
        return PairConsistency(first, second, compared, None, None)
    rmse = float((image[valid].double() - warped[valid].double()).square().mean().sqrt())
    distance = None
    if lpips is not None and min(valid.shape) >= lpips.minimum_side:
        # Elsewhere the view stands for itself: a hole's edge would be seen by the features of valid pixels beside it.
        filled = torch.where(valid[..., None], warped, image)
        distances = lpips.distance(image, filled).map
        distance = float(distances[valid.to(distances.device)].mean(dtype=torch.float64))
    return PairConsistency(first, second, compared, rmse, distance)


def _look(image: Tensor, camera: Camera, rasterizer: Rasterizer, scene: Scene) -> tuple[Tensor, DepthMap]:
    """Picture and depth of a view."""
    return shown(image, camera, rasterizer.device), expected_depth(scene, camera, rasterizer)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
