"""`triton`: float32 rasterizer on a GPU, without requiring a compiler.

The same source runs on the CPU in Triton's interpreter.

Tile intersections are computed on the device: a projection kernel, a sort of the Gaussians by depth, and a sort of the
(Gaussian, raster tile) pairs by tile. Both sorts are PyTorch's radix sorts. The second sort is stable, so its key can
be the tile alone, because pairs are generated in depth order. This takes half the bits of a combined key, and Gaussians
of equal float32 depth keep the order of their float64 depths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from sgsst_core.constants import (
    ALPHA_MIN,
    LOG2_ALPHA_MIN,
    TO_POWER_OF_TWO,
    TRANSMITTANCE_MIN,
)
from sgsst_core.devices import on_device
from sgsst_core.errors import SettingsError
from sgsst_core.rasterizer.base import CountedWeights, RenderCost
from sgsst_core.rasterizer.tile_intersections import check_intersections, tile_grid
from sgsst_core.rasterizer.tiled import TiledRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


@dataclass(frozen=True)
class DeviceIntersections:
    """Tile intersections on the device, with V visible Gaussians and E pairs of Gaussian and raster tile.

    Attributes:
        gaussians: [V] int64, indices into the scene, front to back.
        values: [V, 8] float64, see `projection.Column`.
        starts: [tiles + 1] int64, first entry of each tile.
        ranks: [E] int32, rank (index into `gaussians`) of each entry, front to back within a tile.
        slots: [E] int32, slot of each entry; the slots of one Gaussian are contiguous.
        first_slots: [V + 1] int64, first slot of each rank.
    """

    gaussians: Tensor
    values: Tensor
    starts: Tensor
    ranks: Tensor
    slots: Tensor
    first_slots: Tensor

    @property
    def nbytes(self) -> int:
        """Size on the device in bytes."""
        return sum(
            tensor.nbytes
            for tensor in (self.gaussians, self.values, self.starts, self.ranks, self.slots, self.first_slots)
        )


class TritonRasterizer(TiledRasterizer[DeviceIntersections]):
    """Rasterizer in float32 Triton kernels.

    Color gradients are reproducible bit for bit on one machine: every pair of Gaussian and tile has a separate slot,
    and slots are added in a fixed order.

    Args:
        scene, options: As in `TiledRasterizer`. `device` is a GPU, or the CPU if Triton's interpreter is enabled
            (TRITON_INTERPRET=1); None for the current GPU, or without a GPU for the interpreter.

    Raises:
        SettingsError: If Triton is missing or cannot run on the device.
    """

    name = "triton"
    title = "Triton"
    on_gpu = True
    default_intersection_bytes = 4 << 30  # 80 bytes per visible Gaussian, and 8 per pair of Gaussian and tile

    def __init__(self, scene: Scene, **options: Any) -> None:
        super().__init__(scene, **options)
        self._geometry = [
            tensor.to(self.device).float().contiguous()
            for tensor in (scene.means, scene.quats, scene.scales, scene.opacities)
        ]

    @classmethod
    def usable_device(cls, device: torch.device | str | None) -> torch.device:
        """Validate the device and return it; a GPU is returned with its index.

        Raises:
            SettingsError: If Triton is missing or cannot run on the device.
        """
        try:
            import triton
        except ImportError as error:
            raise SettingsError(
                f"rasterizer 'triton' needs Triton, which cannot be imported ({error}). PyTorch's CUDA and ROCm builds "
                "bring it; choose 'cpu' or 'cached' elsewhere."
            ) from error
        interpreted = triton.knobs.runtime.interpret
        if device is None:
            device = "cpu" if interpreted and not torch.cuda.is_available() else "cuda"
        chosen = torch.device(device)
        if chosen.type == "cuda":
            if not torch.cuda.is_available():
                raise SettingsError(f"rasterizer 'triton' on device {str(device)!r}: PyTorch sees no GPU; choose 'cpu'")
            return torch.device("cuda", torch.cuda.current_device() if chosen.index is None else chosen.index)
        if chosen.type == "cpu" and not interpreted:
            raise SettingsError(
                "rasterizer 'triton' runs on the CPU in Triton's interpreter only: set TRITON_INTERPRET=1 before the "
                "program starts, or choose 'cpu' or 'cached'."
            )
        return chosen

    def probe_cost(self, cameras: Sequence[Camera]) -> RenderCost:
        """Measure the cost of rendering some views with gradient, and the size of their tile intersections."""
        cost, built = super().probe_cost(cameras), [self.intersections(camera) for camera in cameras]
        pairs = max(len(isects.ranks) for isects in built)
        return replace(cost, preparation_bytes=sum(isects.nbytes for isects in built) // len(built), most_pairs=pairs)

    def count_weights(self, camera: Camera) -> CountedWeights:
        """Count a view's weights without storing them; takes about as long as one render."""
        from sgsst_core.rasterizer.triton_cached import CountedPieces

        return CountedPieces(self, camera)

    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        return self._blend(colors, camera)[0]

    def _coverage(self, camera: Camera) -> Tensor:
        return 1 - self._blend(torch.zeros((len(self.scene), 3), device=self.device), camera)[1]

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        from sgsst_core.rasterizer import triton_kernels as kernels

        gradient = torch.zeros((len(self.scene), 3), device=self.device)
        isects = self.intersections(camera)
        visible = len(isects.gaussians)
        if not visible:
            return gradient
        slots = torch.zeros((len(isects.ranks), 3), device=self.device)
        across, tiles = tiles_of(camera)
        with on_device(self.device):
            kernels.slot_gradients[(tiles,)](
                isects.ranks, isects.slots, isects.starts, isects.values, image_gradient, slots,
                camera.width, camera.height, across,
                **self.cuts(kernels.SUMMING_WARPS),
            )  # fmt: skip
        add_slots_(gradient, slots, isects.first_slots, isects.gaussians)
        return gradient

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, w], and each Gaussian's blend weight summed over all pixels [N], in one pass.

        Bit-identical to `coverage`, and to a column of `color_gradient` for an image gradient of ones.
        """
        from sgsst_core.rasterizer import triton_kernels as kernels

        isects = self.intersections(camera)
        weights = torch.zeros(len(self.scene), device=self.device)
        slots = torch.zeros(len(isects.ranks), device=self.device)
        transmittance = torch.empty((camera.height, camera.width), device=self.device)
        across, tiles = tiles_of(camera)
        with on_device(self.device):
            kernels.survey[(tiles,)](
                isects.ranks, isects.slots, isects.starts, isects.values, slots, transmittance,
                camera.width, camera.height, across,
                **self.cuts(kernels.SUMMING_WARPS),
            )  # fmt: skip
        visible, block = len(isects.gaussians), kernels.ADDED.value
        if visible:
            with on_device(self.device):
                kernels.add_slot_weights[(-(-visible // block),)](
                    slots, isects.first_slots, isects.gaussians, weights, visible,
                    BLOCK=block, SLOTS=kernels.SLOTS.value,
                )  # fmt: skip
        return 1 - transmittance, weights

    def _blend(self, colors: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the image and the final transmittance of a view."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        isects = self.intersections(camera)
        image = torch.empty((camera.height, camera.width, 3), device=self.device)
        transmittance = torch.empty((camera.height, camera.width), device=self.device)
        across, tiles = tiles_of(camera)
        with on_device(self.device):
            kernels.render[(tiles,)](
                isects.ranks, isects.starts, isects.gaussians, isects.values, colors, self.background,
                image, transmittance, camera.width, camera.height, across,
                **self.cuts(kernels.PIXEL_WARPS),
            )  # fmt: skip
        return image, transmittance

    def cuts(self, warps: int) -> dict[str, float | int]:
        """Return the compile-time constants of a compositing kernel with this number of warps per program."""
        return {"ALPHA_MAX": self.alpha_max, "ALPHA_MIN": ALPHA_MIN, "STOP": TRANSMITTANCE_MIN, "num_warps": warps}

    def _build(self, camera: Camera) -> DeviceIntersections:
        """Project and sort the Gaussians and compute tile intersections; synchronizes with the device once."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        count, block = len(self.scene), kernels.PROJECTED.value
        view = torch.tensor(_numbers(camera, self.near), dtype=torch.float64).to(self.device, non_blocking=True)
        values = torch.empty((count, 8), dtype=torch.float64, device=self.device)
        depths = torch.empty(count, dtype=torch.float64, device=self.device)
        counts = torch.empty(count, dtype=torch.int32, device=self.device)
        if count:
            rendering = self.scene.rendering
            with on_device(self.device):
                kernels.project[(-(-count // block),)](
                    *self._geometry, view, values, depths, counts, count,
                    EPS2D=rendering.eps2d, ANTIALIASED=rendering.antialiased,
                    SUPPORT=-LOG2_ALPHA_MIN, POWER=TO_POWER_OF_TWO, BLOCK=block,
                )  # fmt: skip
        ordered, order = torch.sort(depths, stable=True)
        first_slots = torch.zeros(count + 1, dtype=torch.int64, device=self.device)
        torch.cumsum(counts[order], 0, out=first_slots[1:])
        visible, total = torch.stack([ordered.isfinite().sum(), first_slots[-1]]).tolist()
        check_intersections(total, visible, camera)
        order, first_slots = order[:visible].clone(), first_slots[: visible + 1].clone()
        tiles = torch.empty(total, dtype=torch.int32, device=self.device)
        ranks = torch.empty(total, dtype=torch.int32, device=self.device)
        if visible:
            with on_device(self.device):
                kernels.list_tiles[(-(-visible // block),)](
                    order, values, first_slots, view, tiles, ranks, visible, SUPPORT=-LOG2_ALPHA_MIN, BLOCK=block
                )
        tiles, slots = torch.sort(tiles, stable=True)
        across, down = tile_grid(camera)
        edges = torch.arange(across * down + 1, dtype=torch.int32, device=self.device)
        starts = torch.searchsorted(tiles, edges)
        return DeviceIntersections(order, values[order], starts, ranks[slots], slots.to(torch.int32), first_slots)


def add_slots_(gradient: Tensor, slots: Tensor, first_slots: Tensor, gaussians: Tensor) -> None:
    """Write the sum of each Gaussian's slots, added in a fixed order, to its row of `gradient`.

    Args:
        gradient: [N, 3] float32.
        slots: [E, 3] float32; the slots of one Gaussian are contiguous.
        first_slots: [V + 1] integers, first slot of each visible Gaussian, in depth order.
        gaussians: [V] integers, row of `gradient` of each visible Gaussian, in depth order.
    """
    from sgsst_core.rasterizer import triton_kernels as kernels

    block = kernels.ADDED.value
    with on_device(slots.device):
        kernels.add_slots[(-(-len(gaussians) // block),)](
            slots, first_slots, gaussians, gradient, len(gaussians), BLOCK=block, SLOTS=kernels.SLOTS.value
        )


def _numbers(camera: Camera, near: float) -> list[float]:
    """Return the camera parameters in the order that the projection kernel expects."""
    pose = camera.world_to_camera.double()[:3].flatten().tolist()
    return [
        *pose,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        float(camera.width),
        float(camera.height),
        near,
        *camera.slope_limits,
    ]


def tiles_of(camera: Camera) -> tuple[int, int]:
    """Return the number of raster tiles per tile row, and in the whole view."""
    across, down = tile_grid(camera)
    return across, across * down
