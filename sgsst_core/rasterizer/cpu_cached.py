"""Cached blend weights on the CPU, stored per half raster tile and applied with SIMD.

With float32 weights, images are bit-identical to those of `cpu`, because the order of operations is the same. See
`kernels` for the layout.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.compiled import kernel_threads
from sgsst_core.constants import RASTER_TILE
from sgsst_core.rasterizer import kernels
from sgsst_core.rasterizer.base import Precision
from sgsst_core.rasterizer.cpu import CpuRasterizer
from sgsst_core.rasterizer.tile_intersections import run_starts
from sgsst_core.scene.camera import Camera

_ITEM_BYTES = 20  # Gaussian index, slot, gradient
_PIECE_BYTES = 4  # item index


class CountedStrips:
    """Sizes of a view's weights, counted before the weights are stored. Counting takes about as long as one render.

    Attributes:
        items: [strips], number of items in each strip.
        pieces: [4 * strips], number of 32-weight pieces in each block.
        slot_items: [E], number of items of each pair of Gaussian and raster tile.
    """

    def __init__(self, rasterizer: CpuRasterizer, camera: Camera) -> None:
        self.rasterizer, self.camera = rasterizer, camera
        self.intersections = isects = rasterizer.intersections(camera)
        strips = (len(isects.starts) - 1) * (RASTER_TILE // kernels.STRIP)
        sizes = (strips, strips * kernels.BLOCKS, len(isects.ranks))
        self.items, self.pieces, self.slot_items = (np.zeros(size, dtype=np.int64) for size in sizes)
        tiles = (isects.ranks, isects.slots, isects.starts, isects.projection.values)
        counts = (self.items, self.pieces, self.slot_items)
        with kernel_threads():
            kernels.count_weights(*tiles, camera.height, camera.width, rasterizer.alpha_max, *counts)

    def nbytes(self, precision: Precision) -> int:
        """Return the size of the weights in bytes."""
        pixels = self.camera.height * self.camera.width
        index = self.items.nbytes + self.pieces.nbytes + 4 * pixels + _ITEM_BYTES * int(self.items.sum())
        piece = _PIECE_BYTES + kernels.PIECE * (4 if precision == "float32" else 2)
        return index + int(self.pieces.sum()) * piece

    def store(self, precision: Precision) -> WeightStrips:
        """Compute the weights again and store them."""
        return WeightStrips(self, precision)


class WeightStrips:
    """Cached blend weights of a view.

    A strip is 8 columns by 16 rows. Weights are stored in float32 or float16, for those blocks of 4 rows of a strip in
    which a Gaussian has weights.
    """

    def __init__(self, counted: CountedStrips, precision: Precision) -> None:
        rasterizer, isects = counted.rasterizer, counted.intersections
        self.background = rasterizer.background.numpy()
        self.gaussians = isects.projection.gaussians
        self.nbytes = counted.nbytes(precision)
        self._total = len(rasterizer.scene)
        slot_starts = run_starts(counted.slot_items)
        self.first_slots = slot_starts[isects.first_slots]
        items, pieces = int(counted.items.sum()), int(counted.pieces.sum())
        weights: NDArray[np.float32] | NDArray[np.uint16]
        if precision == "float32":
            weights = np.empty(pieces * kernels.PIECE, dtype=np.float32)
        else:
            weights = np.empty(pieces * kernels.PIECE, dtype=np.uint16)
        self.strips = kernels.Strips(
            item_starts=run_starts(counted.items),
            piece_starts=run_starts(counted.pieces),
            gaussians=np.empty(items, dtype=np.int32),
            slots=np.empty(items, dtype=np.int32),
            items=np.empty(pieces, dtype=np.int32),
            weights=weights,
        )
        transmittance = np.ones((counted.camera.height, counted.camera.width), dtype=np.float32)
        self.transmittance = torch.from_numpy(transmittance)
        # This buffer can be reused, because `kernel_threads` lets only one thread run kernels at a time.
        self._slot_gradients = np.empty((items, 3), dtype=np.float32)
        tiles = (isects.ranks, isects.slots, isects.starts, isects.projection.values, self.gaussians)
        with kernel_threads():
            kernels.store_weights(*tiles, rasterizer.alpha_max, slot_starts, self.strips, transmittance)

    def render(self, colors: Tensor) -> Tensor:
        """Return the image [h, w, 3] of colors [N, 3] over the background."""
        transmittance = self.transmittance.numpy()
        image = np.empty((*transmittance.shape, 3), dtype=np.float32)
        with kernel_threads():
            kernels.apply_weights(self.strips, colors.numpy(), self.background, transmittance, image)
        return torch.from_numpy(image)

    def color_gradient(self, image_gradient: Tensor) -> Tensor:
        """Return W^T dL/dimage, [N, 3], given the image gradient [h, w, 3]."""
        gradient = np.zeros((self._total, 3), dtype=np.float32)
        pixels = image_gradient.numpy()
        with kernel_threads():
            kernels.apply_transposed_weights(self.strips, pixels, self._slot_gradients)
            kernels.add_slots(self._slot_gradients, self.first_slots, self.gaussians, gradient)
        return torch.from_numpy(gradient)
