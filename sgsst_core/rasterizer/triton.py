"""`triton`: float32 on a GPU, without a compiler to install; the same source runs in Triton's interpreter on the CPU.

Lists are built on the device: one projection kernel, one sort of the Gaussians by depth and one of the pairs of
Gaussian and raster tile by tile, both radix sorts of PyTorch. The second one is stable and takes the tile alone as its
key, because pairs are listed in order of depth: half the bits of a key that holds both, and Gaussians of equal float32
depth keep the order of their float64 depths.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.constants import ALPHA_MAX, ALPHA_MIN, EPS2D, FRUSTUM_MARGIN, NEAR, RASTER_TILE, TRANSMITTANCE_MIN
from sgsst_core.errors import SettingsError
from sgsst_core.rasterizer.arguments import (
    Rows,
    check_colors,
    check_image_gradient,
    check_rows,
)
from sgsst_core.rasterizer.kept_lists import KeptLists
from sgsst_core.rasterizer.raster_lists import check_intersections, tile_grid
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: exp(-power) = 2^-(u^2 + w^2) when u and w are scaled by this, as in `projection`.
_TO_POWER_OF_TWO = math.sqrt(0.5 * math.log2(math.e))
_SUPPORT_BITS = -math.log2(ALPHA_MIN)
#: Bytes of kept lists, unless told otherwise: some 80 a visible Gaussian and 8 a pair of Gaussian and tile.
DEFAULT_LIST_BYTES = 4 << 30


@dataclass(frozen=True)
class DeviceLists:
    """`raster_lists.RasterLists` on the device; V visible Gaussians, E pairs of Gaussian and raster tile.

    Attributes:
        gaussians: [V] int64 indices into the scene, front to back.
        values: [V, 8] float64, see `projection.Column`.
        starts: [tiles + 1] int64, where each tile's entries begin.
        ranks: [E] int32, entry -> rank, front to back within a tile.
        slots: [E] int32, entry -> slot; the slots of one Gaussian lie side by side.
        first_slots: [V + 1] int64, rank -> first slot.
    """

    gaussians: Tensor
    values: Tensor
    starts: Tensor
    ranks: Tensor
    slots: Tensor
    first_slots: Tensor

    @property
    def nbytes(self) -> int:
        """Bytes that the lists keep on the device."""
        return sum(
            tensor.nbytes
            for tensor in (self.gaussians, self.values, self.starts, self.ranks, self.slots, self.first_slots)
        )


class TritonRasterizer:
    """The protocol of `sgsst_core.rasterizer.Rasterizer` in Triton kernels.

    Color gradients repeat to the bit on one machine: every pair of Gaussian and tile has a slot of its own, and slots
    are added in a fixed order. Bands of rows put together are the same bits as the whole view. Lists of views are kept
    until `max_list_bytes` are reached (`KeptLists`).

    Args:
        scene: its geometry must not change while this object lives.
        background: three values added where Gaussians leave pixels uncovered.
        near: near plane in world units.
        device: a GPU, or the CPU where Triton's interpreter is on (TRITON_INTERPRET=1); None takes the GPU where there
            is one.
        alpha_max: clamp of alpha.
        max_list_bytes: see above.
        beside: one in whose bytes for lists this one keeps its own, as far as they are left; in place of the above.

    Raises:
        SettingsError: Triton is missing, or cannot run on the device.
    """

    name = "triton"
    scale = 0
    dtype = torch.float32

    def __init__(
        self,
        scene: Scene,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        near: float = NEAR,
        device: torch.device | str | None = None,
        alpha_max: float = ALPHA_MAX,
        max_list_bytes: int = DEFAULT_LIST_BYTES,
        beside: TritonRasterizer | None = None,
    ) -> None:
        if not near > 0:
            raise ValueError(f"near plane {near}: must be positive")
        self.device = _usable_device(device)
        self.scene = scene
        self.near = near
        self.alpha_max = alpha_max
        self.background = torch.tensor(background, dtype=torch.float32, device=self.device)
        self._geometry = [
            tensor.to(self.device).float().contiguous()
            for tensor in (scene.means, scene.quats, scene.scales, scene.opacities)
        ]
        host = None if beside is None else beside._lists
        self._lists: KeptLists[DeviceLists] = KeptLists(self._build, max_list_bytes, host=host)

    def lists(self, camera: Camera) -> DeviceLists:
        """The view's Gaussians by raster tile, kept or new.

        Raises:
            TooManyIntersectionsError: more pairs of Gaussian and tile than 32-bit positions can address.
        """
        return self._lists.of(camera)

    def render(self, colors: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Image [h, width, 3] float32 of colors [N, 3] in the camera's rows, over the background."""
        values = check_colors(colors, len(self.scene), torch.float32, self.device)
        return self._render(values, camera, check_rows(camera, rows))[0]

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """1 - T_final, [h, width] float32 in [0, 1]: how much of each pixel the Gaussians cover."""
        nothing = torch.zeros((len(self.scene), 3), device=self.device)
        return 1 - self._render(nothing, camera, check_rows(camera, rows))[1]

    def color_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """W^T dL/dimage, [N, 3] float32, of image_gradient [h, width, 3] in the camera's rows."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        band = check_rows(camera, rows)
        pixels = check_image_gradient(image_gradient, camera, band, torch.float32, self.device)
        gradient = torch.zeros((len(self.scene), 3), device=self.device)
        lists = self.lists(camera)
        visible = len(lists.gaussians)
        if not visible:
            return gradient
        slots = torch.zeros((len(lists.ranks), 3), device=self.device)
        across, tiles = tiles_of(camera, band)
        kernels.slot_gradients[(tiles,)](
            lists.ranks, lists.slots, lists.starts, lists.values, pixels, slots, camera.width, *band, across,
            **self.cuts(),
        )  # fmt: skip
        add_slots_(gradient, slots, lists.first_slots, lists.gaussians)
        return gradient

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Coverage [height, width] and each Gaussian's blend weights summed over all pixels [N], float32, in one pass.

        The same bits as `coverage`, and as a column of `color_gradient` of ones.
        """
        from sgsst_core.rasterizer import triton_kernels as kernels

        lists = self.lists(camera)
        weights = torch.zeros(len(self.scene), device=self.device)
        slots = torch.zeros(len(lists.ranks), device=self.device)
        transmittance = torch.empty((camera.height, camera.width), device=self.device)
        across, tiles = tiles_of(camera, (0, camera.height))
        kernels.survey[(tiles,)](
            lists.ranks, lists.slots, lists.starts, lists.values, slots, transmittance,
            camera.width, camera.height, across,
            **self.cuts(),
        )  # fmt: skip
        visible, block = len(lists.gaussians), kernels.ADDED.value
        if visible:
            kernels.add_slot_weights[(-(-visible // block),)](
                slots, lists.first_slots, lists.gaussians, weights, visible, BLOCK=block, SLOTS=kernels.SLOTS.value
            )
        return 1 - transmittance, weights

    def _render(self, colors: Tensor, camera: Camera, band: Rows) -> tuple[Tensor, Tensor]:
        """Image and final transmittance of a band."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        lists = self.lists(camera)
        height = band[1] - band[0]
        image = torch.empty((height, camera.width, 3), device=self.device)
        transmittance = torch.empty((height, camera.width), device=self.device)
        across, tiles = tiles_of(camera, band)
        kernels.render[(tiles,)](
            lists.ranks, lists.starts, lists.gaussians, lists.values, colors, self.background, image, transmittance,
            camera.width, *band, across,
            **self.cuts(),
        )  # fmt: skip
        return image, transmittance

    def cuts(self) -> dict[str, float | int]:
        """What the kernels that blend are compiled with."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        return {
            "ALPHA_MAX": self.alpha_max,
            "ALPHA_MIN": ALPHA_MIN,
            "STOP": TRANSMITTANCE_MIN,
            "K": kernels.BLENDED.value,
            "num_warps": 8,
        }

    def _build(self, camera: Camera) -> DeviceLists:
        """Project, sort by depth, list the Gaussians of every raster tile; waits for the device once."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        count, block = len(self.scene), kernels.PROJECTED.value
        view = torch.tensor(_numbers(camera, self.near), dtype=torch.float64).to(self.device, non_blocking=True)
        values = torch.empty((count, 8), dtype=torch.float64, device=self.device)
        depths = torch.empty(count, dtype=torch.float64, device=self.device)
        counts = torch.empty(count, dtype=torch.int32, device=self.device)
        if count:
            kernels.project[(-(-count // block),)](
                *self._geometry, view, values, depths, counts, count,
                EPS2D=EPS2D, MARGIN=FRUSTUM_MARGIN, SUPPORT=_SUPPORT_BITS, POWER=_TO_POWER_OF_TWO, BLOCK=block,
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
            kernels.list_tiles[(-(-visible // block),)](
                order, values, first_slots, view, tiles, ranks, visible, SUPPORT=_SUPPORT_BITS, BLOCK=block
            )
        tiles, slots = torch.sort(tiles, stable=True)
        across, down = tile_grid(camera)
        edges = torch.arange(across * down + 1, dtype=torch.int32, device=self.device)
        starts = torch.searchsorted(tiles, edges)
        return DeviceLists(order, values[order], starts, ranks[slots], slots.to(torch.int32), first_slots)


def add_slots_(gradient: Tensor, slots: Tensor, first_slots: Tensor, gaussians: Tensor) -> None:
    """Write the sum of each Gaussian's slots, in a fixed order, into its row of `gradient`.

    Args:
        gradient: [N, 3] float32.
        slots: [E, 3] float32; the slots of one Gaussian lie side by side.
        first_slots: [V + 1] integers, rank -> first slot.
        gaussians: [V] integers, rank -> row of `gradient`.
    """
    from sgsst_core.rasterizer import triton_kernels as kernels

    block = kernels.ADDED.value
    kernels.add_slots[(-(-len(gaussians) // block),)](
        slots, first_slots, gaussians, gradient, len(gaussians), BLOCK=block, SLOTS=kernels.SLOTS.value
    )


def _usable_device(device: torch.device | str | None) -> torch.device:
    """The device, with its index.

    Raises:
        SettingsError: Triton is missing, or cannot run there.
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
    found = torch.device(device)
    if found.type == "cuda":
        if not torch.cuda.is_available():
            raise SettingsError(f"rasterizer 'triton' on device {str(device)!r}: PyTorch sees no GPU; choose 'cpu'")
        return torch.device("cuda", torch.cuda.current_device() if found.index is None else found.index)
    if found.type == "cpu" and not interpreted:
        raise SettingsError(
            "rasterizer 'triton' runs on the CPU in Triton's interpreter only: set TRITON_INTERPRET=1 before the "
            "program starts, or choose 'cpu' or 'cached'."
        )
    return found


def _numbers(camera: Camera, near: float) -> list[float]:
    """What the projection kernel needs of a camera, in its order."""
    pose = camera.world_to_camera.double()[:3].flatten().tolist()
    return [*pose, camera.fx, camera.fy, camera.cx, camera.cy, float(camera.width), float(camera.height), near]


def tiles_of(camera: Camera, band: Rows) -> tuple[int, int]:
    """Raster tiles across the view, and in the rows of tiles that a band touches."""
    across = tile_grid(camera)[0]
    return across, across * (-(-band[1] // RASTER_TILE) - band[0] // RASTER_TILE)
