"""`triton`: float32 rasterizer on a GPU, without requiring a compiler; `cached`: its cached blend weights.

The same source runs on the CPU in Triton's interpreter.

Tile intersections are computed on the device: a projection kernel, a sort of the Gaussians by depth, and a sort of the
(Gaussian, raster tile) pairs by tile. Both sorts are PyTorch's radix sorts. The second sort is stable, so its key can
be the tile alone, because pairs are generated in depth order. This takes half the bits of a combined key, and Gaussians
of equal float32 depth keep the order of their float64 depths.

Cached blend weights are pieces of 4 x 4 pixels; see `triton_kernels` for the layout. A piece takes 40 bytes in half
precision and 72 in float32. Including data per tile, Gaussian and pixel, a weight takes 3.0 to 3.4 bytes in half
precision and 5.3 to 6.1 bytes in float32 for a scene of large Gaussians, and 7.1 and 12.2 bytes for a scene whose
Gaussians cover few pixels.

`cached` stores the blend weights of a view and reapplies them in every step. Geometry is frozen, so the blend weights W
of a view never change: an image is W c + T_final background, the color gradient is W^T dL/dimage, and rasterization is
reduced to reading W from memory. Weights are stored on the device that applies them, in a layout for this device.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.constants import ALPHA_MAX, ALPHA_MIN, LOG2_ALPHA_MIN, TO_POWER_OF_TWO, TRANSMITTANCE_MIN
from sgsst_core.devices import on_device
from sgsst_core.errors import SettingsError
from sgsst_core.rasterizer.base import CameraKey, Precision, Rasterizer, TiledRasterizer, camera_key
from sgsst_core.rasterizer.cpu import check_intersections, tile_grid
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Compile-time constants of the compositing kernels.
_CUTS = {"ALPHA_MAX": ALPHA_MAX, "ALPHA_MIN": ALPHA_MIN, "STOP": TRANSMITTANCE_MIN}


@dataclass(frozen=True)
class DeviceIntersections:
    """Tile intersections on the device, with V visible Gaussians and E pairs of Gaussian and raster tile.

    Attributes:
        gaussians: [V] int64, indices into the scene, front to back.
        values: [V, 8] float64, see `cpu.Projection`.
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
        return sum(tensor.nbytes for tensor in vars(self).values())


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
    on_gpu = can_cache = True
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

    def count_weights(self, camera: Camera) -> "CountedPieces":
        """Count a view's weights without storing them; takes about as long as one render."""
        return CountedPieces(self, camera)

    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        return self._blend(colors, camera)[0]

    def coverage(self, camera: Camera) -> Tensor:
        """Return 1 - T_final, [h, w]."""
        return 1 - self._blend(torch.zeros((len(self.scene), 3), device=self.device), camera)[1]

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        from sgsst_core.rasterizer import triton_kernels as kernels

        gradient = torch.zeros((len(self.scene), 3), device=self.device)
        isects = self.intersections(camera)
        visible = len(isects.gaussians)
        if not visible:
            return gradient
        slots = torch.zeros((len(isects.ranks), 3), device=self.device)
        across, down = tile_grid(camera)
        with on_device(self.device):
            kernels.slot_gradients[(across * down,)](
                isects.ranks, isects.slots, isects.starts, isects.values, image_gradient, slots,
                camera.width, camera.height, across,
                **_CUTS, num_warps=kernels.SUMMING_WARPS,
            )  # fmt: skip
        add_slots_(gradient, slots, isects.first_slots, isects.gaussians)
        return gradient

    def _blend(self, colors: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the image and the final transmittance of a view."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        isects = self.intersections(camera)
        image = torch.empty((camera.height, camera.width, 3), device=self.device)
        transmittance = torch.empty((camera.height, camera.width), device=self.device)
        across, down = tile_grid(camera)
        with on_device(self.device):
            kernels.render[(across * down,)](
                isects.ranks, isects.starts, isects.gaussians, isects.values, colors, self.background,
                image, transmittance, camera.width, camera.height, across,
                **_CUTS, num_warps=kernels.PIXEL_WARPS,
            )  # fmt: skip
        return image, transmittance

    def _build(self, camera: Camera) -> DeviceIntersections:
        """Project and sort the Gaussians and compute tile intersections; synchronizes with the device once."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        count, block = len(self.scene), kernels.PROJECTED.value
        intrinsics = camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height
        numbers = [
            *camera.world_to_camera.double()[:3].flatten().tolist(),
            *intrinsics,
            self.near,
            *camera.slope_limits,
        ]
        view = torch.tensor(numbers, dtype=torch.float64).to(self.device, non_blocking=True)
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
        first_slots = _offsets(counts[order], torch.int64)
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


_DTYPES: dict[Precision, torch.dtype] = {"float32": torch.float32, "half": torch.float16}


class CountedPieces:
    """Sizes of a view's weights, counted before the weights are stored.

    Counting takes one pass over the view and one synchronization with the device.

    Attributes:
        pieces: P, number of pieces.
        index_type: Integer dtype for piece and slot indices.
        slot_pieces: [E] int32, number of pieces of each pair of Gaussian and raster tile.
        block_pieces: [16 tiles] int32, pieces of every block.
        masks: [E] int32, bit mask of the blocks of its tile in which each pair has weights.
        ends: [tiles] int64, entry of each tile after which all of its pixels are finished.
    """

    def __init__(self, rasterizer: TritonRasterizer, camera: Camera) -> None:
        from sgsst_core.rasterizer import triton_kernels as kernels

        self.rasterizer, self.camera = rasterizer, camera
        self.intersections = isects = rasterizer.intersections(camera)
        device = rasterizer.device
        across, down = tile_grid(camera)
        self.view, self.tiles = (camera.width, camera.height, across), across * down
        self.masks = torch.zeros(len(isects.ranks), dtype=torch.int32, device=device)
        self.slot_pieces = torch.zeros_like(self.masks)
        self.block_pieces = torch.empty(self.tiles * kernels.BLOCKS.value, dtype=torch.int32, device=device)
        self.ends = torch.empty(self.tiles, dtype=torch.int64, device=device)
        with on_device(device):
            kernels.count_pieces[(self.tiles,)](
                isects.ranks, isects.slots, isects.starts, isects.values, self.masks, self.slot_pieces,
                self.block_pieces, self.ends, *self.view,
                **_CUTS, num_warps=kernels.SUMMING_WARPS,
            )  # fmt: skip
        self.pieces = int(self.block_pieces.sum())
        self.index_type = torch.int32 if self.pieces < 2**31 else torch.int64

    def nbytes(self, precision: Precision) -> int:
        """Return the size of the weights in bytes."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        index, visible = self.index_type.itemsize, len(self.intersections.gaussians)
        pixels = self.camera.height * self.camera.width
        piece = 4 + index + kernels.PIECE.value * _DTYPES[precision].itemsize
        starts = len(self.block_pieces) + 1 + visible + 1
        return int(self.pieces * piece + starts * index + 4 * (visible + pixels))


class WeightPieces:
    """Cached blend weights of a view, with P pieces and V visible Gaussians.

    Attributes:
        block_starts: [16 tiles + 1], first piece of each block.
        piece_gaussians: [P] int32, indices into the scene.
        piece_slots: [P], slot of each piece's gradient; the slots of one Gaussian are contiguous.
        weights: [16 P] float32, or float16 multiplied by `triton_kernels.HALF_SCALE`.
        first_slots: [V + 1], first slot of each rank.
        gaussians: [V] int32, index into the scene of each rank.
        transmittance: [h, w] float32, final transmittance.
    """

    def __init__(self, counted: CountedPieces, precision: Precision) -> None:
        from sgsst_core.rasterizer import triton_kernels as kernels

        rasterizer, isects, index_type = counted.rasterizer, counted.intersections, counted.index_type
        #: Launch grid, one program per block; and kernel arguments: width, height, and raster tiles per row.
        self._grid, self._view = (len(counted.block_pieces),), counted.view
        self._rasterizer, self.camera = rasterizer, counted.camera
        self.scale = kernels.HALF_SCALE if precision == "half" else 1.0
        slot_starts = _offsets(counted.slot_pieces, index_type)
        self.block_starts = _offsets(counted.block_pieces, index_type)
        self.first_slots = slot_starts[isects.first_slots]
        self.gaussians = isects.gaussians.to(torch.int32)

        def empty(*shape: int, dtype: torch.dtype) -> Tensor:
            return torch.empty(shape, dtype=dtype, device=rasterizer.device)

        self.piece_gaussians = empty(counted.pieces, dtype=torch.int32)
        self.piece_slots = empty(counted.pieces, dtype=index_type)
        self.weights = empty(counted.pieces * kernels.PIECE.value, dtype=_DTYPES[precision])
        self.transmittance = empty(self.camera.height, self.camera.width, dtype=torch.float32)
        with on_device(rasterizer.device):
            kernels.store_pieces[(counted.tiles,)](
                isects.ranks, isects.slots, isects.starts, isects.values, isects.gaussians, counted.masks, counted.ends,
                slot_starts, self.block_starts, self.piece_gaussians, self.piece_slots, self.weights,
                self.transmittance, *self._view,
                **_CUTS, num_warps=kernels.PIXEL_WARPS, SCALE=self.scale,
            )  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Size of the weights on the device in bytes."""
        return sum(value.nbytes for value in vars(self).values() if isinstance(value, Tensor))

    def render(self, colors: Tensor) -> Tensor:
        """Return the image [h, w, 3] of colors [N, 3] over the background."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        image = torch.empty((*self.transmittance.shape, 3), device=colors.device)
        with on_device(colors.device):
            kernels.apply_pieces[self._grid](
                self.block_starts, self.piece_gaussians, self.weights, colors, self._rasterizer.background,
                self.transmittance, image, *self._view,
                SCALE=self.scale, P=kernels.PIECES.value, num_warps=1,
            )  # fmt: skip
        return image

    def color_gradient(self, image_gradient: Tensor) -> Tensor:
        """Return W^T dL/dimage, [N, 3], given the image gradient [h, w, 3]."""
        from sgsst_core.rasterizer import triton_kernels as kernels

        gradient = torch.zeros((len(self._rasterizer.scene), 3), device=image_gradient.device)
        if not len(self.piece_slots):
            return gradient
        slots = torch.empty((len(self.piece_slots), 3), device=image_gradient.device)
        with on_device(image_gradient.device):
            kernels.piece_gradients[self._grid](
                self.block_starts, self.piece_slots, self.weights, image_gradient, slots, *self._view,
                SCALE=self.scale, P=kernels.PIECES.value, num_warps=1,
            )  # fmt: skip
        add_slots_(gradient, slots, self.first_slots, self.gaussians)
        return gradient


def _offsets(counts: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the start offsets of consecutive runs with these lengths, and the end of the last one."""
    starts = torch.zeros(len(counts) + 1, dtype=dtype, device=counts.device)
    torch.cumsum(counts, 0, out=starts[1:])
    return starts


class CachedRasterizer(Rasterizer):
    """Rasterizer whose blend weights are computed once per view by another one.

    Weights are cached in the order of the views' first use, or of the calls of `cache_weights`, until the next weights
    would exceed `max_bytes`. Nothing is ever evicted: views are visited in rounds, so evicted weights would be needed
    again before the remaining ones.

    If a view has no cached weights, `uncached` computes it in every call. Images and gradients are then equal up to
    rounding, for float32 weights. Color gradients are reproducible bit for bit.

    Args:
        scene: Scene, whose geometry must not change during this object's lifetime.
        precision: Precision of the cached weights. `half` takes half the memory, with a relative error of at most 2^-11
            per weight.
        max_bytes: Memory budget for weights; None for no limit. Tile intersections of `uncached` may use the rest.
            Those of a view are dropped once the weights of the view are cached.
        min_intersection_bytes: Minimum budget for these tile intersections, regardless of the size of the weights.
        at_first_use: Whether to cache weights at first use. If False, only `cache_weights` does, and rendering
            other views does not affect later results.
        device: Device for the default of `uncached`; None for the current GPU.
        uncached: Rasterizer of the same scene that computes the weights, and renders if there are no cached weights;
            its class must have `can_cache`. None to create `triton`.
        options: Further options of the default of `uncached`.

    Raises:
        SettingsError: If Triton cannot run on `device`.
    """

    name = "cached"
    title = "cached blend weights"

    def __init__(
        self,
        scene: Scene,
        *,
        precision: Precision = "float32",
        max_bytes: int | None = None,
        min_intersection_bytes: int = 0,
        at_first_use: bool = True,
        device: torch.device | str | None = None,
        uncached: Rasterizer | None = None,
        **options: Any,
    ) -> None:
        if uncached is None:
            uncached = TritonRasterizer(scene, device=device, **options)
        self._uncached = uncached
        self.scene, self.device, self.near = scene, uncached.device, uncached.near
        self.precision: Precision = precision
        self.max_bytes = max_bytes
        self.min_intersection_bytes = min_intersection_bytes
        self._at_first_use = at_first_use
        self._cached: Cache[CameraKey, WeightPieces] = Cache(max_bytes)

    @classmethod
    def options(cls, memory: int) -> dict[str, Any]:
        """Return constructor options for a memory budget in bytes."""
        return {"max_bytes": memory}

    @property
    def uncached(self) -> Rasterizer:
        """Rasterizer that computes blend weights in every call."""
        return self._uncached

    def cache_weights(self, camera: Camera) -> None:
        """Cache a view's weights if they fit.

        The first call for a view decides whether its weights fit; later calls do not reconsider this.
        """
        self._cached.add(camera_key(camera), lambda: self._counted(camera))

    @property
    def caches(self) -> dict[str, Cache[CameraKey, Any]]:
        """Caches of blend weights, "weights", and those of the uncached rasterizer."""
        return {"weights": self._cached, **self.uncached.caches}

    def forget_views(self) -> None:
        """Drop the weights and the tile intersections of all views."""
        self._cached.clear()
        self.uncached.forget_views()

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, w], and each Gaussian's blend weight summed over all pixels [N].

        Does not cache any weights.
        """
        return self.uncached.survey(camera)

    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        cached = self._cached_for(camera)
        return self.uncached.render(colors, camera) if cached is None else cached.render(colors)

    def coverage(self, camera: Camera) -> Tensor:
        """Return 1 - T_final, [h, w]."""
        cached = self._cached_for(camera)
        return self.uncached.coverage(camera) if cached is None else 1 - cached.transmittance

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        cached = self._cached_for(camera)
        if cached is None:
            return self.uncached.color_gradient(image_gradient, camera)
        return cached.color_gradient(image_gradient)

    def _cached_for(self, camera: Camera) -> WeightPieces | None:
        """Return the cached weights for a view, or None. With `at_first_use` they are computed first, if they fit."""
        if self._at_first_use:
            self.cache_weights(camera)
        return self._cached.values.get(camera_key(camera))

    def _counted(self, camera: Camera) -> tuple[int, Callable[[], WeightPieces]]:
        """Return the size in bytes of a view's weights, and a function that computes them."""
        counted = self.uncached.count_weights(camera)

        def make() -> WeightPieces:
            weights = WeightPieces(counted, self.precision)
            if self.max_bytes is not None:
                left = self.max_bytes - self._cached.used - weights.nbytes
                self.uncached.release_view(camera, max(left, self.min_intersection_bytes))
            return weights

        return counted.nbytes(self.precision), make
