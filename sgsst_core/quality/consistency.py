"""Multi-view consistency: how much the images of two cameras differ where both see the same surface.

View j is warped into view i using rendered depth. The images are then compared over the pixels where both views see the
same surface, by RMSE and by LPIPS averaged over these pixels. Short range compares adjacent views; long range compares
views 7 apart (the two ranges of Huang et al., "Learning to Stylize Novel Views", ICCV 2021).

Even the views of an unstylized scene differ, for three reasons: colors depend on the view, interpolation smooths the
warped view a little, and depth is a mean over translucent Gaussians. Compare the values before and after stylization.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.errors import SettingsError
from sgsst_core.quality.lpips import MIN_SIDE, Lpips
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera, spread
from sgsst_core.scene.gaussians import Scene

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
#: Number of pixels warped at a time. Each takes memory for about twenty values.
_BAND_PIXELS = 1 << 20
#: Number of Gaussians whose depths are computed at a time.
_GAUSSIANS = 1 << 18


@dataclass(frozen=True)
class PairConsistency:
    """Consistency of one pair of views.

    Attributes:
        first, second: Indices of the views; the second is warped into the first.
        compared: Fraction of the first view's pixels that could be compared.
        rmse: Root mean square difference of the colors (0 to 1) over those pixels; None if there are too few.
        lpips: LPIPS averaged over those pixels; None if there are too few, the view is too small, or LPIPS is off.
    """

    first: int
    second: int
    compared: float
    rmse: float | None
    lpips: float | None


@dataclass(frozen=True)
class Consistency:
    """Consistency of all pairs of views `gap` apart, ordered by first view. Means skip pairs without a value."""

    gap: int
    pairs: list[PairConsistency]

    @property
    def rmse(self) -> float | None:
        """Mean RMSE, or None if no pair could be compared."""
        return _mean([pair.rmse for pair in self.pairs])

    @property
    def lpips(self) -> float | None:
        """Mean LPIPS, or None if no pair has an LPIPS value."""
        return _mean([pair.lpips for pair in self.pairs])

    @property
    def compared(self) -> float:
        """Mean fraction of pixels that could be compared, over all pairs; 0 if there are no pairs."""
        return _mean([pair.compared for pair in self.pairs]) or 0.0

    def as_dict(self) -> dict[str, float | None]:
        """Return the means as JSON-serializable values."""
        means = {name: getattr(self, name) for name in ("compared", "rmse", "lpips")}
        return {"gap": self.gap, "pairs": len(self.pairs), **means}


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
    """Compute the consistency of pairs of views `gap` apart.

    Args:
        image: Function that returns the image [H, W, 3] of a view as a screen shows it (`shown`).
        warp: Function that returns the warp of a pair's second view into the first one.
        lpips: LPIPS network; None skips LPIPS.
    """
    results = []
    for first, second in pairs:
        warped, valid = warp(first, second).apply(image(second))
        results.append(compare(first, second, image(first), warped, valid, lpips))
    return Consistency(gap, results)


def view_pairs(count: int, gap: int, at_most: int | None = None) -> list[tuple[int, int]]:
    """Return all pairs (i, i + gap) of `count` views, or at most `at_most` evenly spread ones.

    Raises:
        SettingsError: If `gap` or `at_most` is below 1.
    """
    if gap < 1 or (at_most is not None and at_most < 1):
        raise SettingsError(f"Pairs of views {gap} apart, at most {at_most}: both numbers must be at least 1.")
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
    """Return an image [H, W, 3] of a view as a screen shows it: clamped to 0 to 1, on the given device.

    Raises:
        ValueError: If the image does not have the camera's size, or contains NaN or infinity.
    """
    image = image.detach().to(device)
    if tuple(image.shape) != (camera.height, camera.width, 3):
        raise ValueError(
            f"image of view {camera.name!r}: shape {tuple(image.shape)}, not {(camera.height, camera.width, 3)}"
        )
    if not bool(image.isfinite().all()):
        raise ValueError(f"image of view {camera.name!r}: holds NaN or infinity")
    return image.clamp(0, 1).contiguous()


def compare(
    first: int, second: int, image: Tensor, warped: Tensor, valid: Tensor, lpips: Lpips | None
) -> PairConsistency:
    """Compare a view's image [H, W, 3] with another view's warped image, where the mask `valid` [H, W] is true."""
    count = int(valid.sum())
    compared = count / valid.numel()
    if count == 0 or compared < MINIMUM_COMPARED:
        return PairConsistency(first, second, compared, None, None)
    rmse = float((image[valid].double() - warped[valid].double()).square().mean().sqrt())
    distance = None
    if lpips is not None and min(valid.shape) >= MIN_SIDE:
        # Fill invalid pixels with the view's own image: holes would add edges to the features of valid pixels.
        filled = torch.where(valid[..., None], warped, image)
        distances = lpips.distance(image, filled).map
        distance = float(distances[valid.to(distances.device)].mean(dtype=torch.float64))
    return PairConsistency(first, second, compared, rmse, distance)


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None
