"""Rasterizers: one small protocol and its implementations for CPU and GPU.

Geometry is frozen, so the image of a view is linear in the colors c: image = W c + T_final * background, where W are
the blend weights and T_final is the final transmittance. The gradient with respect to the colors is W^T dL/dimage.
"""

from __future__ import annotations

from typing import Any, Literal, Protocol

import torch
from torch import Tensor

from sgsst_core.constants import NEAR
from sgsst_core.errors import SettingsError
from sgsst_core.rasterizer.arguments import Rows
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

__all__ = ["Rasterizer", "RasterizerName", "Rows", "make_rasterizer"]

RasterizerName = Literal["reference", "cpu", "cached", "triton", "cuda"]


class Rasterizer(Protocol):
    """Renderer of a scene with frozen geometry and arbitrary colors.

    `rows` is a half-open band (start, stop) of pixel rows; None is the whole view. `colors` are the colors of one
    view, after spherical harmonics and clamping. Arguments may have any floating dtype and be on any device; results
    are on `device`, in `dtype`. A wrong shape raises ValueError.

    Images have the full size of the camera (`scale` 0), except in `coarse`: there, they are box averages over
    2^scale x 2^scale pixels, and heights, widths and rows refer to this scale.
    """

    name: str
    scale: int
    device: torch.device
    dtype: torch.dtype

    def render(self, colors: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return the image [h, width, 3] of colors [N, 3] over the background."""
        ...

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return 1 - T_final, [h, width] in [0, 1]: how much of each pixel the Gaussians cover."""
        ...

    def color_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return W^T dL/dimage, [N, 3], given the image gradient [h, width, 3] of the rows."""
        ...

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, width] of the whole view, and each Gaussian's blend weight summed over all pixels [N]."""
        ...


def make_rasterizer(
    name: str,
    scene: Scene,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = NEAR,
    device: torch.device | str | None = None,
    **options: Any,
) -> Rasterizer:
    """Create the rasterizer of a given name for a scene.

    Args:
        name: `cpu` computes blend weights in every call; `cached` stores them (its options are `precision`, `max_bytes`
            and `uncached`); `triton` runs on GPUs; `cuda` uses gsplat; `reference` is slow and float64.
        scene: Scene, whose geometry must not change during the rasterizer's lifetime.
        background: RGB color behind pixels that Gaussians leave uncovered.
        near: Near plane in world units.
        device: Device for `cached`, `triton` and `cuda`. None selects the CPU for `cached` (or the device of its option
            `uncached`), and the current GPU for `triton` and `cuda`.
        options: Further arguments of the implementation's constructor.

    Raises:
        SettingsError: If the name is unknown, the rasterizer cannot use the device, or `cuda` lacks gsplat or a GPU.
    """
    settings: dict[str, Any] = {"background": background, "near": near, **options}
    if name in ("reference", "cpu"):
        if device is not None and torch.device(device).type != "cpu":
            raise SettingsError(f"rasterizer {name!r} runs on the CPU, not on {device}: choose 'cached' or 'cuda'")
        if name == "cpu":
            from sgsst_core.rasterizer.cpu import CpuRasterizer

            return CpuRasterizer(scene, **settings)
        from sgsst_core.rasterizer.reference import ReferenceRasterizer

        return ReferenceRasterizer(scene, **settings)
    if name == "cached":
        from sgsst_core.rasterizer.cached import CachedRasterizer

        return CachedRasterizer(scene, device=device or "cpu", **settings)
    if name == "triton":
        from sgsst_core.rasterizer.triton import TritonRasterizer

        return TritonRasterizer(scene, device=device, **settings)
    if name == "cuda":
        from sgsst_core.rasterizer.cuda import CudaRasterizer

        return CudaRasterizer(scene, device=device or "cuda", **settings)
    raise SettingsError(f"no rasterizer is called {name!r}: choose reference, cpu, cached, triton or cuda")
