"""Cached blend weights on a GPU: pieces of 4 x 4 pixels, computed and applied by Triton kernels.

See `triton_cached_kernels` for the layout. A piece takes 40 bytes in half precision and 72 in float32. Including data
per tile, Gaussian and pixel, a weight takes 3.0 to 3.4 bytes in half precision and 5.3 to 6.1 bytes in float32 for a
scene of large Gaussians, and 7.1 and 12.2 bytes for a scene whose Gaussians cover few pixels.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.devices import on_device
from sgsst_core.rasterizer.base import Precision
from sgsst_core.rasterizer.triton import TritonRasterizer, add_slots_, tiles_of
from sgsst_core.scene.camera import Camera

_DTYPES: dict[Precision, torch.dtype] = {"float32": torch.float32, "half": torch.float16}


class CountedPieces:
    """Sizes of a view's weights, counted before the weights are stored.

    Counting takes one pass over the view and one synchronization with the device.

    Attributes:
        pieces: P, number of pieces.
        slot_pieces: [E] int32, number of pieces of each pair of Gaussian and raster tile.
        block_pieces: [16 tiles] int32, pieces of every block.
        masks: [E] int32, bit mask of the blocks of its tile in which each pair has weights.
        ends: [tiles] int64, entry of each tile after which all of its pixels are finished.
    """

    def __init__(self, rasterizer: TritonRasterizer, camera: Camera) -> None:
        from sgsst_core.rasterizer import triton_cached_kernels as kernels
        from sgsst_core.rasterizer.triton_kernels import SUMMING_WARPS

        self.rasterizer, self.camera = rasterizer, camera
        self.intersections = isects = rasterizer.intersections(camera)
        device = rasterizer.device
        self.across, self.tiles = tiles_of(camera)
        self.masks = torch.zeros(len(isects.ranks), dtype=torch.int32, device=device)
        self.slot_pieces = torch.zeros_like(self.masks)
        self.block_pieces = torch.empty(self.tiles * kernels.BLOCKS.value, dtype=torch.int32, device=device)
        self.ends = torch.empty(self.tiles, dtype=torch.int64, device=device)
        with on_device(device):
            kernels.count_pieces[(self.tiles,)](
                isects.ranks, isects.slots, isects.starts, isects.values, self.masks, self.slot_pieces,
                self.block_pieces, self.ends, camera.width, camera.height, self.across,
                **rasterizer.cuts(SUMMING_WARPS),
            )  # fmt: skip
        self.pieces = int(self.block_pieces.sum())

    @property
    def index_type(self) -> torch.dtype:
        """Integer dtype for piece and slot indices."""
        return torch.int32 if self.pieces < 2**31 else torch.int64

    def nbytes(self, precision: Precision) -> int:
        """Return the size of the weights in bytes."""
        from sgsst_core.rasterizer import triton_cached_kernels as kernels

        index, visible = self.index_type.itemsize, len(self.intersections.gaussians)
        pixels = self.camera.height * self.camera.width
        piece = 4 + index + kernels.PIECE.value * _DTYPES[precision].itemsize
        starts = len(self.block_pieces) + 1 + visible + 1
        return int(self.pieces * piece + starts * index + 4 * (visible + pixels))

    def store(self, precision: Precision) -> WeightPieces:
        """Compute the weights again and store them."""
        return WeightPieces(self, precision)


class WeightPieces:
    """Cached blend weights of a view, with P pieces and V visible Gaussians.

    Attributes:
        block_starts: [16 tiles + 1], first piece of each block.
        piece_gaussians: [P] int32, indices into the scene.
        piece_slots: [P], slot of each piece's gradient; the slots of one Gaussian are contiguous.
        weights: [16 P] float32, or float16 multiplied by `triton_cached_kernels.HALF_SCALE`.
        first_slots: [V + 1], first slot of each rank.
        gaussians: [V] int32, index into the scene of each rank.
        transmittance: [h, w] float32, final transmittance.
    """

    def __init__(self, counted: CountedPieces, precision: Precision) -> None:
        from sgsst_core.rasterizer import triton_cached_kernels as kernels
        from sgsst_core.rasterizer.triton_kernels import PIXEL_WARPS

        rasterizer, isects, index_type = counted.rasterizer, counted.intersections, counted.index_type
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
                self.transmittance, *self._view_arguments(),
                **rasterizer.cuts(PIXEL_WARPS), SCALE=self.scale,
            )  # fmt: skip

    @property
    def nbytes(self) -> int:
        """Size of the weights on the device in bytes."""
        tensors = (
            *(self.block_starts, self.piece_gaussians, self.piece_slots, self.weights),
            *(self.first_slots, self.gaussians, self.transmittance),
        )
        return sum(tensor.nbytes for tensor in tensors)

    def render(self, colors: Tensor) -> Tensor:
        """Return the image [h, w, 3] of colors [N, 3] over the background."""
        from sgsst_core.rasterizer import triton_cached_kernels as kernels

        image = torch.empty((*self.transmittance.shape, 3), device=colors.device)
        with on_device(colors.device):
            kernels.apply_pieces[self._grid()](
                self.block_starts, self.piece_gaussians, self.weights, colors, self._rasterizer.background,
                self.transmittance, image, *self._view_arguments(),
                SCALE=self.scale, P=kernels.PIECES.value, num_warps=1,
            )  # fmt: skip
        return image

    def color_gradient(self, image_gradient: Tensor) -> Tensor:
        """Return W^T dL/dimage, [N, 3], given the image gradient [h, w, 3]."""
        from sgsst_core.rasterizer import triton_cached_kernels as kernels

        gradient = torch.zeros((len(self._rasterizer.scene), 3), device=image_gradient.device)
        if not len(self.piece_slots):
            return gradient
        slots = torch.empty((len(self.piece_slots), 3), device=image_gradient.device)
        with on_device(image_gradient.device):
            kernels.piece_gradients[self._grid()](
                self.block_starts, self.piece_slots, self.weights, image_gradient, slots, *self._view_arguments(),
                SCALE=self.scale, P=kernels.PIECES.value, num_warps=1,
            )  # fmt: skip
        add_slots_(gradient, slots, self.first_slots, self.gaussians)
        return gradient

    def _grid(self) -> tuple[int]:
        """Return the launch grid: one program per block."""
        return (len(self.block_starts) - 1,)

    def _view_arguments(self) -> tuple[int, int, int]:
        """Return the kernel arguments that describe the view: width, height, and raster tiles per row."""
        return self.camera.width, self.camera.height, tiles_of(self.camera)[0]


def _offsets(counts: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the start offsets of consecutive runs with these lengths, and the end of the last one."""
    starts = torch.zeros(len(counts) + 1, dtype=dtype, device=counts.device)
    torch.cumsum(counts, 0, out=starts[1:])
    return starts
