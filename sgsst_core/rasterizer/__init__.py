"""Rasterizers: one small protocol, six implementations.

Geometry is frozen, so a view's image is linear in its colors: image = W c + T_final * background,
and the gradient with respect to the colors is W^T dL/dimage.
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
    """Renders one scene's frozen geometry with any colors.

    `rows` is a half-open band (start, stop) of pixel rows; None is the whole view. `colors` are the
    colors of one view, after spherical harmonics and clamp. Arguments may come in any floating dtype and from any
    device; results are on `device`, in `dtype`. A wrong shape is a ValueError.

    Images are of full size (`scale` 0) but for `coarse`, whose images are 2^scale x 2^scale box averages of the
    camera's: heights, widths and rows are those at its scale.
    """

    name: str
    scale: int
    device: torch.device
    dtype: torch.dtype

    def render(self, colors: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Image [h, width, 3] of colors [N, 3] in the camera's rows, over the background."""
        ...

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """1 - T_final, [h, width] in [0, 1]: how much of each pixel the Gaussians cover."""
        ...

    def color_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """W^T dL/dimage, [N, 3], of image_gradient [h, width, 3] in the camera's rows."""
        ...

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Coverage [h, width] of the whole view, and each Gaussian's blend weights summed over all its pixels [N]."""
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
    """The rasterizer called `name` (`reference`, `cpu`, `cached`, `triton` or `cuda`) for a scene.

    Args:
        name: `cpu` computes blend weights in every call, `cached` keeps them (its options `precision`, `max_bytes` and
            `uncached`), `triton` runs on GPUs, `cuda` is gsplat, `reference` is slow and float64.
        scene: its geometry must not change while the rasterizer lives.
        background: three values added where Gaussians leave pixels uncovered.
        near: near plane in world units.
        device: for `cached`, `triton` and `cuda`; None is the CPU for the first, or the device of its option
            `uncached`, and the current GPU for the others.
        options: of the implementation's own constructor.

    Raises:
        SettingsError: no such rasterizer, a device it cannot use, or gsplat or a GPU missing for `cuda`.
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
