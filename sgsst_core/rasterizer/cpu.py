"""`cpu`: float32 rasterizer on all CPU cores.

Tile intersections are cached per view. Blend weights are recomputed in every call: storing them would save 0.6 % of a
step.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.compiled import kernel_threads
from sgsst_core.constants import ALPHA_MAX
from sgsst_core.rasterizer import kernels
from sgsst_core.rasterizer.base import TiledRasterizer
from sgsst_core.rasterizer.projection import (
    Shapes,
    TileIntersections,
    build_tile_intersections,
)
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene


class CpuRasterizer(TiledRasterizer[TileIntersections]):
    """Rasterizer in compiled float32 code.

    The order of summation is fixed, so results are bit-identical for any number of threads.
    """

    name = "cpu"
    title = "compiled code"
    default_intersection_bytes = 1 << 30  # 15 to 20 bytes per pair of Gaussian and tile

    def __init__(self, scene: Scene, **options: Any) -> None:
        super().__init__(scene, **options)
        self._shapes: Shapes | None = None

    def _build(self, camera: Camera) -> TileIntersections:
        if self._shapes is None:
            self._shapes = Shapes.of(self.scene)
        return build_tile_intersections(self.scene, camera, near=self.near, shapes=self._shapes)

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
