"""`reference`: plain PyTorch, float64 by default, written from the formulas and independent of the compiled code.

The fast rasterizers are tested against it. In float32 it is also the benchmark's baseline, as a vectorized PyTorch
rasterizer: raster tiles are batched by the number of their Gaussians, and each batch takes a few tensor operations.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sgsst_core.constants import ALPHA_MAX, ALPHA_MIN, NEAR, RASTER_TILE, TRANSMITTANCE_MIN
from sgsst_core.rasterizer.base import CameraKey, Rasterizer, camera_key
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene, unit_rotations

#: Number of (pixel, Gaussian) pairs per batch; a batch holds about ten tensors of this size.
_BATCH_PAIRS = 1 << 20


@dataclass(frozen=True)
class Splats:
    """Gaussians on the image plane, front to back. All fields are [V], float64.

    The power is (u^2 + w^2) / 2 with w = dx / sqrt(p), u = (dy - (q / p) dx) sqrt(p / det) for a covariance [[p, q],
    [q, r]].
    """

    gaussians: Tensor  # int64, indices into the scene
    x: Tensor
    y: Tensor
    w_scale: Tensor  # 1 / sqrt(p)
    skew: Tensor  # q / p
    u_scale: Tensor  # sqrt(p / det)
    opacity: Tensor  # in this view: compensated for the blur if the scene is antialiased
    extent_x: Tensor  # half extents in pixels of the area where alpha >= ALPHA_MIN
    extent_y: Tensor


def perspective_derivative(centers: Tensor, camera: Camera) -> Tensor:
    """Return the Jacobian [N, 2, 3] of the projection at camera-space centers [N, 3].

    Slopes are clamped to the frustum plus a margin.
    """
    x, y, z = centers.unbind(-1)
    left, right, top, bottom = camera.slope_limits
    slope_x, slope_y = (x / z).clamp(left, right), (y / z).clamp(top, bottom)
    zero = torch.zeros_like(z)
    along_x = torch.stack([camera.fx / z, zero, -camera.fx * slope_x / z], dim=-1)
    along_y = torch.stack([zero, camera.fy / z, -camera.fy * slope_y / z], dim=-1)
    return torch.stack([along_x, along_y], dim=-2)


def splat(scene: Scene, camera: Camera, *, near: float = NEAR) -> Splats:
    """Project Gaussians (EWA, Zwicker et al. 2002) in float64.

    Gaussians closer than the near plane, with an opacity in the view below ALPHA_MIN, or with non-finite values are
    dropped.
    """
    pose = camera.world_to_camera.double()
    centers = scene.means.double() @ pose[:3, :3].T + pose[:3, 3]
    index = torch.nonzero(centers[:, 2] >= near)[:, 0]
    centers = centers[index]
    quats = scene.quats[index].double()
    rotations = unit_rotations(quats / quats.norm(dim=-1, keepdim=True))
    factor = perspective_derivative(centers, camera) @ pose[:3, :3] @ rotations
    factor = factor * scene.scales[index].double().exp()[:, None, :]  # covariance without blur is factor factor^T
    m0, m1 = factor[:, 0], factor[:, 1]
    eps2d = scene.rendering.eps2d
    p, q, r = (m0 * m0).sum(-1) + eps2d, (m0 * m1).sum(-1), (m1 * m1).sum(-1) + eps2d
    minors = torch.linalg.cross(m0, m1).square().sum(-1)
    det = minors + eps2d * (p + r - eps2d)  # Cauchy-Binet; p and r already include the blur
    opacity = scene.opacities[index].double().sigmoid()
    if scene.rendering.antialiased:
        opacity = opacity * (minors / det).sqrt()
    reach = (2 * (opacity / ALPHA_MIN).log()).clamp_min(0).sqrt()
    columns = torch.stack(
        [
            camera.fx * centers[:, 0] / centers[:, 2] + camera.cx,
            camera.fy * centers[:, 1] / centers[:, 2] + camera.cy,
            p.rsqrt(),
            q / p,
            (p / det).sqrt(),
            opacity,
            reach * p.sqrt(),
            reach * r.sqrt(),
        ]
    )
    # If the determinant overflows, u_scale is 0, which is finite. So test the determinant too, as `projection` does.
    usable = columns.isfinite().all(0) & det.isfinite()
    order = torch.nonzero(usable & (opacity >= ALPHA_MIN))[:, 0]
    order = order[torch.sort(centers[order, 2], stable=True).indices]
    return Splats(index[order], *columns[:, order])


class ReferenceRasterizer(Rasterizer):
    """Rasterizer in plain PyTorch on the CPU.

    Memory is bounded by batches of about a million (pixel, Gaussian) pairs, for views and scenes of any size.
    Projection and tile intersections of the last camera are cached, because they do not depend on colors.

    Args:
        scene, background, near, device: As in `Rasterizer`.
        dtype: Dtype of blending, image and gradient; the projection is always float64.
    """

    name = "reference"
    title = "the float64 reference"

    def __init__(self, scene: Scene, *, dtype: torch.dtype = torch.float64, **common: Any) -> None:
        self.dtype = dtype
        super().__init__(scene, dtype=dtype, **common)
        self._prepared: tuple[CameraKey, Splats, Tensor, Tensor] | None = None

    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        image = self.background.expand(camera.height * camera.width + 1, 3).clone()
        for pixels, gaussians, weights, left in self._blended(camera):
            image[pixels] = torch.bmm(weights, colors[gaussians]) + left[..., None] * self.background
        return image[:-1].view(camera.height, camera.width, 3)

    def _coverage(self, camera: Camera) -> Tensor:
        coverage = torch.zeros(camera.height * camera.width + 1, dtype=self.dtype)
        for pixels, _, _, left in self._blended(camera):
            coverage[pixels] = 1 - left
        return coverage[:-1].view(camera.height, camera.width)

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        flat = torch.cat([image_gradient.view(-1, 3), image_gradient.new_zeros(1, 3)])
        gradient = torch.zeros(len(self.scene), 3, dtype=self.dtype)
        for pixels, gaussians, weights, _ in self._blended(camera):
            gradient.index_add_(0, gaussians.flatten(), torch.bmm(weights.mT, flat[pixels]).flatten(0, 1))
        return gradient

    def near_cutoff(self, camera: Camera, tolerance: float) -> Tensor:
        """Return the mask [h, width] bool of pixels with an alpha or a transmittance close to its cutoff.

        Close means within a relative `tolerance`. Only in these pixels can a rasterizer with other rounding skip a
        Gaussian that this rasterizer blends, or the reverse.
        """
        doubtful = torch.zeros(camera.height * camera.width + 1, dtype=torch.bool)
        for pixels, splats in self._batches(camera):
            alpha = self._alpha(splats, pixels, camera)
            after = (1 - torch.where(alpha >= ALPHA_MIN, alpha, 0)).cumprod(-1)
            before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], dim=-1)
            at_alpha = (alpha / ALPHA_MIN - 1).abs() < tolerance
            at_end = (after / TRANSMITTANCE_MIN - 1).abs() < tolerance
            running = before > TRANSMITTANCE_MIN * (1 - tolerance)
            doubtful[pixels] = ((at_alpha | at_end) & running).any(-1)
        return doubtful[:-1].view(camera.height, camera.width)

    def _blended(self, camera: Camera) -> Iterator[tuple[Tensor, Tensor, Tensor, Tensor]]:
        """Yield batches of pixel indices [b, n], Gaussians [b, k], weights [b, n, k] and T_final [b, n]."""
        for pixels, splats in self._batches(camera):
            alpha = self._alpha(splats, pixels, camera)
            alpha = torch.where(alpha >= ALPHA_MIN, alpha, 0)
            after = (1 - alpha).cumprod(-1)
            unfinished = after > TRANSMITTANCE_MIN
            before = torch.cat([torch.ones_like(after[..., :1]), after[..., :-1]], dim=-1)
            weights = torch.where(unfinished, alpha * before, 0)
            # transmittance only decreases, so its last value is its minimum
            left = torch.where(unfinished, after, 1).amin(-1)
            yield pixels, splats.gaussians, weights, left

    def _alpha(self, splats: Splats, pixels: Tensor, camera: Camera) -> Tensor:
        """Return the clamped alpha [b, n, k] of splats [b, k] at pixels [b, n]."""
        dx = (pixels % camera.width + 0.5).to(self.dtype)[..., None] - splats.x[:, None]
        dy = (pixels // camera.width + 0.5).to(self.dtype)[..., None] - splats.y[:, None]
        w = dx * splats.w_scale[:, None]
        u = (dy - splats.skew[:, None] * dx) * splats.u_scale[:, None]
        return (splats.opacity[:, None] * ((u * u + w * w) * -0.5).exp()).clamp_max(ALPHA_MAX)

    def _batches(self, camera: Camera) -> Iterator[tuple[Tensor, Splats]]:
        """Yield the pixels [b, n] of b raster tiles with the splats [b, k] to blend, padded with empty splats."""
        splats, ranks, counts = self._intersections(camera)
        starts = counts.cumsum(0) - counts
        order = torch.nonzero(counts)[:, 0]
        order = order[counts[order].argsort(descending=True)]
        while len(order) > 0:
            longest = int(counts[order[0]])
            tiles, order = order.tensor_split([max(1, _BATCH_PAIRS // (longest * RASTER_TILE**2))])
            position = torch.arange(longest)
            listed = ranks[torch.where(position < counts[tiles, None], starts[tiles, None] + position, len(ranks) - 1)]
            batch = Splats(*(getattr(splats, field)[listed] for field in Splats.__dataclass_fields__))
            at_once = max(1, _BATCH_PAIRS // (longest * len(tiles)))
            for pixels in tile_pixels(tiles, camera).split(at_once, dim=1):
                yield pixels, batch

    def _intersections(self, camera: Camera) -> tuple[Splats, Tensor, Tensor]:
        """Return the tile intersections of a camera.

        Returns:
            Splats with an empty one appended; depth-order indices of the splats in each raster tile, followed by the
                index of the empty splat; and number of splats per tile.
        """
        key = camera_key(camera)
        if self._prepared is None or self._prepared[0] != key:
            splats = splat(self.scene, camera, near=self.near)
            ranks, counts = tile_intersections(splats, camera)
            empty = len(splats.gaussians)
            ranks = torch.cat([ranks, torch.tensor([empty])])
            fields = (getattr(splats, field) for field in Splats.__dataclass_fields__)
            padded = Splats(*(torch.cat([f, f.new_zeros(1)]) for f in fields))
            values = {f: getattr(padded, f).to(self.dtype) for f in Splats.__dataclass_fields__ if f != "gaussians"}
            self._prepared = (key, Splats(padded.gaussians, **values), ranks, counts)
        return self._prepared[1:]


def tile_intersections(splats: Splats, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the depth-order indices of the splats in each raster tile, and the number of splats per tile [tiles].

    Extents are enlarged by one pixel as a safety margin.
    """
    across, down = -(-camera.width // RASTER_TILE), -(-camera.height // RASTER_TILE)

    def tiles(center: Tensor, extent: Tensor, limit: int) -> tuple[Tensor, Tensor]:
        first = ((center - extent - 1) / RASTER_TILE).floor().clamp(0, limit).long()
        end = ((center + extent + 1) / RASTER_TILE).ceil().clamp(0, limit).long()
        return first, (end - first).clamp_min(0)

    left, width = tiles(splats.x, splats.extent_x, across)
    top, height = tiles(splats.y, splats.extent_y, down)
    touched = width * height
    ranks = torch.arange(len(touched)).repeat_interleave(touched)
    offset = torch.arange(len(ranks)) - (touched.cumsum(0) - touched)[ranks]
    tile = (top[ranks] + offset // width[ranks]) * across + left[ranks] + offset % width[ranks]
    tile, order = torch.sort(tile, stable=True)
    return ranks[order], torch.bincount(tile, minlength=across * down)


def tile_pixels(tiles: Tensor, camera: Camera) -> Tensor:
    """Return the pixels [b, 256] of raster tiles as indices into the view.

    Pixels outside the view get the index one past the end.
    """
    across = -(-camera.width // RASTER_TILE)
    offset = torch.arange(RASTER_TILE**2)
    x = (tiles % across * RASTER_TILE)[:, None] + offset % RASTER_TILE
    y = (tiles // across * RASTER_TILE)[:, None] + offset // RASTER_TILE
    inside = (x < camera.width) & (y < camera.height)
    return torch.where(inside, y * camera.width + x, camera.height * camera.width)
