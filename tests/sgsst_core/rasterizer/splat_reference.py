"""`reference`: plain PyTorch in float64, written from the formulas and independent of the compiled code.

The fast rasterizers are tested against it. It is not in `RASTERIZERS`.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.constants import ALPHA_MAX, ALPHA_MIN, NEAR, TRANSMITTANCE_MIN
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene, unit_rotations

#: Side in pixels of the areas that are blended at once, and number of (pixel, Gaussian) pairs above which an area is
#: divided.
_SIDE, _PAIRS = 32, 1 << 20
#: Rows and columns of a view.
Area = tuple[slice, slice]


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
    # If the determinant overflows, u_scale is 0, which is finite. So test the determinant too, as `cpu.project` does.
    usable = columns.isfinite().all(0) & det.isfinite()
    order = torch.nonzero(usable & (opacity >= ALPHA_MIN))[:, 0]
    order = order[torch.sort(centers[order, 2], stable=True).indices]
    return Splats(index[order], *columns[:, order])


class ReferenceRasterizer(Rasterizer):
    """Rasterizer in plain PyTorch on the CPU: alpha is evaluated for all Gaussians that come near an area."""

    name = "reference"
    title = "the float64 reference"
    dtype = torch.float64

    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        image = torch.empty(camera.height, camera.width, 3, dtype=self.dtype)
        for area, gaussians, alpha in self._alphas(camera):
            weights, left = _blended(alpha)
            image[area] = weights @ colors[gaussians] + left[..., None] * self.background
        return image

    def coverage(self, camera: Camera) -> Tensor:
        """Return 1 - T_final, [h, w]."""
        coverage = torch.empty(camera.height, camera.width, dtype=self.dtype)
        for area, _, alpha in self._alphas(camera):
            coverage[area] = 1 - _blended(alpha)[1]
        return coverage

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        gradient = torch.zeros(len(self.scene), 3, dtype=self.dtype)
        for area, gaussians, alpha in self._alphas(camera):
            weights = _blended(alpha)[0].flatten(0, 1)
            gradient.index_add_(0, gaussians, weights.T @ image_gradient[area].flatten(0, 1))
        return gradient

    def near_cutoff(self, camera: Camera, tolerance: float) -> Tensor:
        """Return the mask [h, width] bool of pixels with an alpha or a transmittance close to its cutoff.

        Close means within a relative `tolerance`. Only in these pixels can a rasterizer with other rounding skip a
        Gaussian that this rasterizer blends, or the reverse.
        """
        doubtful = torch.zeros(camera.height, camera.width, dtype=torch.bool)
        for area, _, alpha in self._alphas(camera):
            transmittance = _transmittance(alpha)
            at_alpha = (alpha / ALPHA_MIN - 1).abs() < tolerance
            at_end = (transmittance[..., 1:] / TRANSMITTANCE_MIN - 1).abs() < tolerance
            running = transmittance[..., :-1] > TRANSMITTANCE_MIN * (1 - tolerance)
            doubtful[area] = ((at_alpha | at_end) & running).any(-1)
        return doubtful

    def _alphas(self, camera: Camera) -> Iterator[tuple[Area, Tensor, Tensor]]:
        """Yield areas, the indices [k] of the Gaussians that come near them, front to back, and their alpha [h, w, k].

        Alpha is clamped, but not yet cut off. Extents are enlarged by one pixel as a safety margin.
        """
        splats = splat(self.scene, camera, near=self.near)
        tops, lefts = range(0, camera.height, _SIDE), range(0, camera.width, _SIDE)
        for top, left in itertools.product(tops, lefts):
            bottom, right = min(top + _SIDE, camera.height), min(left + _SIDE, camera.width)
            near = (splats.x - splats.extent_x < right + 1) & (splats.x + splats.extent_x > left - 1)
            near &= (splats.y - splats.extent_y < bottom + 1) & (splats.y + splats.extent_y > top - 1)
            own = Splats(*(values[near] for values in vars(splats).values()))
            rows = max(1, _PAIRS // max((right - left) * len(own.gaussians), 1))
            dx = torch.arange(left, right, dtype=self.dtype)[:, None] + 0.5 - own.x
            w = dx * own.w_scale
            for first in range(top, bottom, rows):
                end = min(first + rows, bottom)
                dy = torch.arange(first, end, dtype=self.dtype)[:, None, None] + 0.5 - own.y
                u = (dy - own.skew * dx) * own.u_scale
                alpha = (own.opacity * ((u * u + w * w) * -0.5).exp()).clamp_max(ALPHA_MAX)
                yield (slice(first, end), slice(left, right)), own.gaussians, alpha


def _transmittance(alpha: Tensor) -> Tensor:
    """Return the transmittance [h, w, k + 1] before each of k Gaussians, and after the last one, if all are blended."""
    after = (1 - torch.where(alpha >= ALPHA_MIN, alpha, 0)).cumprod(-1)
    return torch.cat([torch.ones_like(after.sum(-1, keepdim=True)), after], dim=-1)


def _blended(alpha: Tensor) -> tuple[Tensor, Tensor]:
    """Return the weights [h, w, k] and the final transmittance [h, w]."""
    transmittance = _transmittance(alpha)
    unfinished = transmittance > TRANSMITTANCE_MIN
    weights = torch.where(unfinished[..., 1:] & (alpha >= ALPHA_MIN), alpha * transmittance[..., :-1], 0)
    # Transmittance only decreases, so its last value is its minimum.
    return weights, torch.where(unfinished, transmittance, 1).amin(-1)
