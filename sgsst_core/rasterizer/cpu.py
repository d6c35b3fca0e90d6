"""`cpu`: float32 rasterizer on all CPU cores.

Tile intersections are cached per view; blend weights are recomputed in every call.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.compiled import kernel_threads
from sgsst_core.constants import ALPHA_MAX, NEAR
from sgsst_core.rasterizer import kernels
from sgsst_core.rasterizer.arguments import (
    Rows,
    check_colors,
    check_image_gradient,
    check_rows,
)
from sgsst_core.rasterizer.projection import Shapes
from sgsst_core.rasterizer.tile_intersections import (
    TileIntersections,
    build_tile_intersections,
    intersections_of_subset,
)
from sgsst_core.rasterizer.view_cache import ViewCache
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Tile intersections take some 15 to 20 bytes per pair of Gaussian and tile: a few megabytes per view at 1280x720.
DEFAULT_INTERSECTION_BYTES = 1 << 30
_CPU = torch.device("cpu")


class CpuRasterizer:
    """Implementation of `sgsst_core.rasterizer.Rasterizer` in compiled float32 code.

    The order of summation is fixed. Results are therefore bit-identical for any number of threads, and the concatenated
    images of bands are bit-identical to that of the whole view. Tile intersections are cached within a budget
    (`ViewCache`).

    Args:
        scene: Scene, whose geometry must not change during this object's lifetime.
        background: RGB color behind pixels that Gaussians leave uncovered.
        near: Near plane in world units.
        alpha_max: Upper limit of alpha.
        max_intersection_bytes: Memory budget for tile intersections in bytes.
        beside: Rasterizer whose budget for tile intersections is shared, with lower priority, instead of using
            `max_intersection_bytes`; None for a separate budget.
    """

    name = "cpu"
    scale = 0
    dtype = torch.float32
    device = _CPU

    def __init__(
        self,
        scene: Scene,
        *,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
        near: float = NEAR,
        alpha_max: float = ALPHA_MAX,
        max_intersection_bytes: int = DEFAULT_INTERSECTION_BYTES,
        beside: CpuRasterizer | None = None,
    ) -> None:
        self.scene = scene
        self.near = near
        self.alpha_max = alpha_max
        self.background: NDArray[np.float32] = np.asarray(background, dtype=np.float32)
        self._shapes: Shapes | None = None
        host = None if beside is None else beside._intersections
        self._intersections: ViewCache[TileIntersections] = ViewCache(self._build, max_intersection_bytes, host=host)

    def of_subset(
        self, scene: Scene, rows: Tensor, *, max_intersection_bytes: int = DEFAULT_INTERSECTION_BYTES
    ) -> CpuRasterizer:
        """Return a rasterizer of a subset of the Gaussians.

        The new rasterizer takes over the cached tile intersections. Those of a view are restricted to the subset when
        the view is first used.

        Args:
            scene: Scene of the subset, with unchanged geometry.
            rows: [N] bool, mask of the subset.
            max_intersection_bytes: Memory budget of the new rasterizer for tile intersections, in bytes.
        """
        if len(scene) != int(rows.sum()) or len(rows) != len(self.scene):
            raise ValueError(f"{len(scene)} Gaussians are not the {int(rows.sum())} chosen ones of {len(self.scene)}")
        part = CpuRasterizer(
            scene, near=self.near, alpha_max=self.alpha_max, max_intersection_bytes=max_intersection_bytes
        )
        part.background = self.background
        places = torch.where(rows, rows.cumsum(0, dtype=torch.int32) - 1, -1).to(torch.int32).numpy()
        part._intersections = ViewCache(
            part._build,
            max_intersection_bytes,
            self._intersections,
            lambda isects: intersections_of_subset(isects, places),
        )
        self._shapes = None
        return part

    def _build(self, camera: Camera) -> TileIntersections:
        if self._shapes is None:
            self._shapes = Shapes.of(self.scene)
        return build_tile_intersections(self.scene, camera, near=self.near, shapes=self._shapes)

    def intersections(self, camera: Camera) -> TileIntersections:
        """Return the tile intersections of a view, cached or newly built.

        Raises:
            TooManyIntersectionsError: See `build_tile_intersections`.
        """
        return self._intersections.of(camera)

    def has_intersections(self, camera: Camera) -> bool:
        """Return whether the view's tile intersections are cached, so it needs no projection and no sorting."""
        return self._intersections.holds(camera)

    def drop_intersections(self, camera: Camera, left: int) -> None:
        """Drop the view's tile intersections, and set the budget for those of all other views to `left` bytes."""
        self._intersections.take(camera)
        self._intersections.limit(left)

    def render(self, colors: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return the float32 image [h, width, 3] of colors [N, 3] over the background."""
        values = check_colors(colors, len(self.scene), torch.float32, _CPU).numpy()
        return self._render(values, camera, check_rows(camera, rows))[0]

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return 1 - T_final, [h, width] float32 in [0, 1]: how much of each pixel the Gaussians cover."""
        nothing = np.zeros((len(self.scene), 3), dtype=np.float32)
        return 1 - self._render(nothing, camera, check_rows(camera, rows))[1]

    def color_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Return W^T dL/dimage, [N, 3] float32, given the image gradient [h, width, 3] of the rows."""
        band = check_rows(camera, rows)
        pixels = check_image_gradient(image_gradient, camera, band, torch.float32, _CPU).numpy()
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
                pixels,
                band[0],
                self.alpha_max,
                slot_gradients,
            )
            kernels.add_slots(slot_gradients, isects.first_slots, projection.gaussians, gradient)
        return torch.from_numpy(gradient)

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Return coverage [height, width], and each Gaussian's blend weight summed over all pixels [N], in one pass.

        Bit-identical to `coverage`, and to a column of `color_gradient` for an image gradient of ones.
        """
        isects = self.intersections(camera)
        slot_weights = np.empty(len(isects.ranks), dtype=np.float32)
        weights = np.zeros(len(self.scene), dtype=np.float32)
        transmittance = np.empty((camera.height, camera.width), dtype=np.float32)
        values = isects.projection.values
        with kernel_threads():
            kernels.survey(
                isects.ranks, isects.slots, isects.starts, values, self.alpha_max, slot_weights, transmittance
            )
            kernels.add_slot_weights(slot_weights, isects.first_slots, isects.projection.gaussians, weights)
        return 1 - torch.from_numpy(transmittance), torch.from_numpy(weights)

    def _render(self, colors: NDArray[np.float32], camera: Camera, band: Rows) -> tuple[Tensor, Tensor]:
        """Return the image and the final transmittance of a band."""
        isects = self.intersections(camera)
        height = band[1] - band[0]
        image = np.empty((height, camera.width, 3), dtype=np.float32)
        transmittance = np.empty((height, camera.width), dtype=np.float32)
        with kernel_threads():
            kernels.render(
                isects.ranks,
                isects.starts,
                isects.projection.values,
                isects.projection.gaussians,
                colors,
                self.background,
                band[0],
                self.alpha_max,
                image,
                transmittance,
            )
        return torch.from_numpy(image), torch.from_numpy(transmittance)
