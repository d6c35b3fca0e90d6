"""`cpu`: float32 rasterizer on all CPU cores.

Tile intersections are cached per view. Blend weights are recomputed in every call, unless `cached` stores them: then
they are held per half raster tile and applied with SIMD, in the order of operations of `cpu`. With float32 weights,
images are therefore bit-identical. See `kernels` for the layout.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.compiled import kernel_threads
from sgsst_core.constants import ALPHA_MAX, RASTER_TILE
from sgsst_core.rasterizer import kernels
from sgsst_core.rasterizer.base import CountedWeights, Precision
from sgsst_core.rasterizer.projection import Shapes
from sgsst_core.rasterizer.tile_intersections import (
    TileIntersections,
    build_tile_intersections,
    intersections_of_subset,
    run_starts,
)
from sgsst_core.rasterizer.tiled import TiledRasterizer, cache_of_intersections
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


class CpuRasterizer(TiledRasterizer[TileIntersections]):
    """Rasterizer in compiled float32 code.

    The order of summation is fixed, so results are bit-identical for any number of threads.
    """

    name = "cpu"
    title = "compiled code"
    caches_exactly = True
    default_intersection_bytes = 1 << 30  # 15 to 20 bytes per pair of Gaussian and tile

    def __init__(self, scene: Scene, **options: Any) -> None:
        super().__init__(scene, **options)
        self._shapes: Shapes | None = None

    def for_subset(self, scene: Scene, rows: Tensor, memory: int) -> CpuRasterizer:
        """Return a rasterizer of a subset of the Gaussians, see `Rasterizer.for_subset`.

        The new rasterizer takes over the cached tile intersections. Those of a view are restricted to the subset when
        the view is first used.
        """
        if len(scene) != int(rows.sum()) or len(rows) != len(self.scene):
            raise ValueError(f"{len(scene)} Gaussians are not the {int(rows.sum())} chosen ones of {len(self.scene)}")
        subset = self.for_scene(scene, **self.options(memory))
        indices = torch.where(rows, rows.cumsum(0, dtype=torch.int32) - 1, -1).to(torch.int32).numpy()
        subset._intersections = cache_of_intersections(
            memory, previous=self._intersections, adapt=lambda isects: intersections_of_subset(isects, indices)
        )
        self._shapes = None
        return subset

    def _build(self, camera: Camera) -> TileIntersections:
        if self._shapes is None:
            self._shapes = Shapes.of(self.scene)
        return build_tile_intersections(self.scene, camera, near=self.near, shapes=self._shapes)

    def count_weights(self, camera: Camera) -> CountedWeights:
        """Count a view's weights without storing them; takes about as long as one render."""
        return CountedStrips(self, camera)

    def _render(self, colors: Tensor, camera: Camera) -> Tensor:
        return self._blend(colors.numpy(), camera)[0]

    def _coverage(self, camera: Camera) -> Tensor:
        return 1 - self._blend(np.zeros((len(self.scene), 3), dtype=np.float32), camera)[1]

    def _color_gradient(self, image_gradient: Tensor, camera: Camera) -> Tensor:
        isects = self.intersections(camera)
        projection = isects.projection
        slot_gradients = np.empty((len(isects.ranks), 3), dtype=np.float32)
        gradient = np.zeros((len(self.scene), 3), dtype=np.float32)
        with kernel_threads():
            kernels.color_gradient(
                isects.ranks,
                isects.slots,
                isects.starts,
                projection.values,
                image_gradient.numpy(),
                ALPHA_MAX,
                slot_gradients,
            )
            kernels.add_slots(slot_gradients, isects.first_slots, projection.gaussians, gradient)
        return torch.from_numpy(gradient)

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [h, w], and each Gaussian's blend weight summed over all pixels [N], in one pass.

        Bit-identical to `coverage`, and to a column of `color_gradient` for an image gradient of ones.
        """
        isects = self.intersections(camera)
        slot_weights = np.empty(len(isects.ranks), dtype=np.float32)
        weights = np.zeros(len(self.scene), dtype=np.float32)
        transmittance = np.empty((camera.height, camera.width), dtype=np.float32)
        values = isects.projection.values
        with kernel_threads():
            kernels.survey(isects.ranks, isects.slots, isects.starts, values, ALPHA_MAX, slot_weights, transmittance)
            kernels.add_slot_weights(slot_weights, isects.first_slots, isects.projection.gaussians, weights)
        return 1 - torch.from_numpy(transmittance), torch.from_numpy(weights)

    def _blend(self, colors: NDArray[np.float32], camera: Camera) -> tuple[Tensor, Tensor]:
        """Return the image and the final transmittance of a view."""
        isects = self.intersections(camera)
        image = np.empty((camera.height, camera.width, 3), dtype=np.float32)
        transmittance = np.empty((camera.height, camera.width), dtype=np.float32)
        with kernel_threads():
            kernels.render(
                isects.ranks,
                isects.starts,
                isects.projection.values,
                isects.projection.gaussians,
                colors,
                self.background.numpy(),
                ALPHA_MAX,
                image,
                transmittance,
            )
        return torch.from_numpy(image), torch.from_numpy(transmittance)


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
            kernels.count_weights(*tiles, camera.height, camera.width, ALPHA_MAX, *counts)

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
            kernels.store_weights(*tiles, ALPHA_MAX, slot_starts, self.strips, transmittance)

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
