"""`cuda`: rasterizer on gsplat's kernels (extra `[cuda]`), for gsplat 1.5.3 and 1.6.

It calls the public stages of gsplat's `rasterization` separately. Geometry is frozen, so projection and tile
intersections are computed once per view.

Cropped cameras are exact, because Gaussians are always projected onto the whole view, to whose frustum slopes are
clamped. The projected centers are then shifted to the crop, and tiles outside it are dropped.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from sgsst_core.constants import RASTER_TILE
from sgsst_core.errors import SettingsError
from sgsst_core.rasterizer.base import CameraKey, Rasterizer, camera_key
from sgsst_core.rasterizer.tile_intersections import tile_grid
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


def load_gsplat() -> ModuleType:
    """Import gsplat.

    Raises:
        SettingsError: If gsplat is not installed or cannot be loaded.
    """
    try:
        module = importlib.import_module("gsplat")
    except (ImportError, OSError) as error:
        raise SettingsError(
            f"rasterizer 'cuda' needs gsplat, which cannot be imported ({error}): install the extra, "
            "pip install 'sgsst-service[cuda]', on a machine with a CUDA GPU, or choose rasterizer 'cpu' or 'cached'"
        ) from error
    return module


def gsplat_alpha_max(version: str) -> float:
    """Return gsplat's upper limit of alpha, which cannot be set: 0.99 from version 1.6 on, 0.999 before."""
    major, minor = (int("".join(filter(str.isdigit, part)) or 0) for part in version.split(".")[:2])
    return 0.99 if (major, minor) >= (1, 6) else 0.999


@dataclass(frozen=True)
class _Splats:
    """Projected Gaussians and tile intersections of a view in gsplat's format, with a batch dimension of 1."""

    means: Tensor
    conics: Tensor
    opacities: Tensor
    tile_offsets: Tensor
    flat_ids: Tensor


class CudaRasterizer(Rasterizer):
    """Rasterizer that calls gsplat on one GPU.

    Results are gsplat's in float32. Its backward pass uses atomics, so gradients are reproducible only up to rounding.
    Projection and tile intersections of the latest view are cached.

    Args:
        scene, background, near: As in `Rasterizer`.
        device: CUDA device; None for the current one.

    Raises:
        SettingsError: If gsplat or the GPU is missing.
    """

    name = "cuda"
    title = "gsplat"
    on_gpu = True

    def __init__(self, scene: Scene, **common: Any) -> None:
        self._gsplat = load_gsplat()
        super().__init__(scene, **common)
        self.alpha_max = gsplat_alpha_max(self._gsplat.__version__)
        self._means = scene.means.to(self.device)
        self._quats = scene.quats.to(self.device)
        self._scales = scene.scales.to(self.device).exp()
        self._opacities = scene.opacities.to(self.device).sigmoid()
        self._latest: tuple[CameraKey, _Splats] | None = None

    @classmethod
    def usable_device(cls, device: torch.device | str | None) -> torch.device:
        """Validate a CUDA device and return it.

        Raises:
            SettingsError: If `device` is not a GPU, or this machine has no GPU.
        """
        chosen = torch.device(device or "cuda")
        if chosen.type != "cuda" or not torch.cuda.is_available():
            raise SettingsError(
                f"rasterizer 'cuda' on device {str(chosen)!r}: PyTorch sees no CUDA GPU; choose 'cpu' or 'cached'"
            )
        return chosen

    @torch.no_grad()
    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        image, alpha = self._rasterize(colors, camera)
        return image + (1 - alpha) * self.background

    @torch.no_grad()
    def _coverage(self, camera: Camera) -> Tensor:
        nothing = torch.zeros(len(self.scene), 3, device=self.device)
        return self._rasterize(nothing, camera)[1][..., 0]

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        # The image is linear in the colors, so the gradient of <image, image_gradient> is the same at any colors.
        with torch.enable_grad():
            colors = torch.zeros(len(self.scene), 3, device=self.device, requires_grad=True)
            image, _ = self._rasterize(colors, camera)
            (gradient,) = torch.autograd.grad(image, colors, image_gradient)
        return gradient

    def _rasterize(self, colors: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the image [h, w, 3] over black, and 1 - T_final [h, w, 1]."""
        splats = self._splats(camera)
        image, alpha = self._gsplat.rasterize_to_pixels(
            splats.means,
            splats.conics,
            colors[None],
            splats.opacities,
            camera.width,
            camera.height,
            RASTER_TILE,
            splats.tile_offsets,
            splats.flat_ids,
        )
        return image[0], alpha[0]

    def _splats(self, camera: Camera) -> _Splats:
        """Return the projection of a view and its tile intersections."""
        key = camera_key(camera)
        if self._latest is None or self._latest[0] != key:
            self._latest = None  # free its memory before the next one is built
            self._latest = (key, self._project(camera))
        return self._latest[1]

    @torch.no_grad()
    def _project(self, camera: Camera) -> _Splats:
        whole = camera.whole or camera
        pose = camera.world_to_camera.to(device=self.device, dtype=torch.float32)[None]
        intrinsics = torch.tensor(
            [[whole.fx, 0, whole.cx], [0, whole.fy, whole.cy], [0, 0, 1]], dtype=torch.float32, device=self.device
        )[None]
        rendering, opacities = self.scene.rendering, self._opacities[None]
        radii, means, depths, conics, compensations = self._gsplat.fully_fused_projection(
            self._means,
            None,
            self._quats,
            self._scales,
            pose,
            intrinsics,
            whole.width,
            whole.height,
            eps2d=rendering.eps2d,
            near_plane=self.near,
            calc_compensations=rendering.antialiased,
            opacities=self._opacities,
        )
        if rendering.antialiased:
            opacities = opacities * compensations
        means = means - means.new_tensor([whole.cx - camera.cx, whole.cy - camera.cy])
        across, down = tile_grid(camera)
        _, ids, flat_ids = self._gsplat.isect_tiles(means, radii, depths, RASTER_TILE, across, down)
        offsets = self._gsplat.isect_offset_encode(ids, 1, across, down)
        return _Splats(means, conics, opacities, offsets.reshape(1, down, across), flat_ids)
