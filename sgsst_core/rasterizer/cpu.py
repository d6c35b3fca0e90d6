"""`cpu`: float32 on all cores; blend weights are recomputed in every call, the lists of Gaussians a view are kept."""

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
from sgsst_core.rasterizer.kept_lists import KeptLists
from sgsst_core.rasterizer.projection import Shapes
from sgsst_core.rasterizer.raster_lists import RasterLists, build_raster_lists, lists_of_subset
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Lists are some 15 to 20 bytes for each Gaussian and tile: a few megabytes a view at 1280x720.
DEFAULT_LIST_BYTES = 1 << 30
_CPU = torch.device("cpu")


class CpuRasterizer:
    """The protocol of `sgsst_core.rasterizer.Rasterizer` in compiled float32 code.

    The order of summation is fixed, so results are the same bits for any number of threads, and bands of rows put
    together are the same bits as the whole view. Lists of views are kept until `max_list_bytes` are reached
    (`KeptLists`).

    Args:
        scene: its geometry must not change while this object lives.
        background: three values added where Gaussians leave pixels uncovered.
        near: near plane in world units.
        alpha_max: clamp of alpha.
        max_list_bytes: see above.
        beside: one in whose bytes for lists this one keeps its own, as far as they are left; in place of the above.
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
        max_list_bytes: int = DEFAULT_LIST_BYTES,
        beside: CpuRasterizer | None = None,
    ) -> None:
        self.scene = scene
        self.near = near
        self.alpha_max = alpha_max
        self.background: NDArray[np.float32] = np.asarray(background, dtype=np.float32)
        self._shapes: Shapes | None = None
        host = None if beside is None else beside._lists
        self._lists: KeptLists[RasterLists] = KeptLists(self._build, max_list_bytes, host=host)

    def of_subset(self, scene: Scene, rows: Tensor, *, max_list_bytes: int = DEFAULT_LIST_BYTES) -> CpuRasterizer:
        """A rasterizer of some of the Gaussians. Lists kept here are handed on to it, cut down when a view comes.

        Args:
            scene: of these Gaussians, their geometry unchanged.
            rows: [N] bool, which they are.
        """
        if len(scene) != int(rows.sum()) or len(rows) != len(self.scene):
            raise ValueError(f"{len(scene)} Gaussians are not the {int(rows.sum())} chosen ones of {len(self.scene)}")
        part = CpuRasterizer(scene, near=self.near, alpha_max=self.alpha_max, max_list_bytes=max_list_bytes)
        part.background = self.background
        places = torch.where(rows, rows.cumsum(0, dtype=torch.int32) - 1, -1).to(torch.int32).numpy()
        part._lists = KeptLists(part._build, max_list_bytes, self._lists, lambda lists: lists_of_subset(lists, places))
        self._shapes = None
        return part

    def _build(self, camera: Camera) -> RasterLists:
        if self._shapes is None:
            self._shapes = Shapes.of(self.scene)
        return build_raster_lists(self.scene, camera, near=self.near, shapes=self._shapes)

    def lists(self, camera: Camera) -> RasterLists:
        """The view's Gaussians by raster tile, kept or new.

        Raises:
            TooManyIntersectionsError: see `build_raster_lists`.
        """
        return self._lists.of(camera)

    def has_lists(self, camera: Camera) -> bool:
        """Whether the view's lists are kept, or handed on: no projection, no sorting."""
        return self._lists.holds(camera)

    def let_go_of_lists(self, camera: Camera, left: int) -> None:
        """Keep the view's lists no longer, and no more than `left` bytes of all others from now on."""
        self._lists.take(camera)
        self._lists.limit(left)

    def render(self, colors: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """Image [h, width, 3] float32 of colors [N, 3] in the camera's rows, over the background."""
        values = check_colors(colors, len(self.scene), torch.float32, _CPU).numpy()
        return self._render(values, camera, check_rows(camera, rows))[0]

    def coverage(self, camera: Camera, rows: Rows | None = None) -> Tensor:
        """1 - T_final, [h, width] float32 in [0, 1]: how much of each pixel the Gaussians cover."""
        nothing = np.zeros((len(self.scene), 3), dtype=np.float32)
        return 1 - self._render(nothing, camera, check_rows(camera, rows))[1]

    def color_gradient(self, image_gradient: Tensor, camera: Camera, rows: Rows | None = None) -> Tensor:
        """W^T dL/dimage, [N, 3] float32, of image_gradient [h, width, 3] in the camera's rows."""
        band = check_rows(camera, rows)
        pixels = check_image_gradient(image_gradient, camera, band, torch.float32, _CPU).numpy()
        lists = self.lists(camera)
        projection = lists.projection
        slot_gradients = np.empty((len(lists.ranks), 3), dtype=np.float32)
        gradient = np.zeros((len(self.scene), 3), dtype=np.float32)
        with kernel_threads():
            kernels.color_gradient(
                lists.ranks,
                lists.slots,
                lists.starts,
                projection.values,
                pixels,
                band[0],
                self.alpha_max,
                slot_gradients,
            )
            kernels.add_slots(slot_gradients, lists.first_slots, projection.gaussians, gradient)
        return torch.from_numpy(gradient)

    def survey(self, camera: Camera) -> tuple[Tensor, Tensor]:
        """Coverage [height, width] and each Gaussian's blend weights summed over all pixels [N], float32, in one pass.

        The same bits as `coverage`, and as a column of `color_gradient` of ones.
        """
        lists = self.lists(camera)
        slot_weights = np.empty(len(lists.ranks), dtype=np.float32)
        weights = np.zeros(len(self.scene), dtype=np.float32)
        transmittance = np.empty((camera.height, camera.width), dtype=np.float32)
        values = lists.projection.values
        with kernel_threads():
            kernels.survey(lists.ranks, lists.slots, lists.starts, values, self.alpha_max, slot_weights, transmittance)
            kernels.add_slot_weights(slot_weights, lists.first_slots, lists.projection.gaussians, weights)
        return 1 - torch.from_numpy(transmittance), torch.from_numpy(weights)

    def _render(self, colors: NDArray[np.float32], camera: Camera, band: Rows) -> tuple[Tensor, Tensor]:
        """Image and final transmittance of a band."""
        lists = self.lists(camera)
        height = band[1] - band[0]
        image = np.empty((height, camera.width, 3), dtype=np.float32)
        transmittance = np.empty((height, camera.width), dtype=np.float32)
        with kernel_threads():
            kernels.render(
                lists.ranks,
                lists.starts,
                lists.projection.values,
                lists.projection.gaussians,
                colors,
                self.background,
                band[0],
                self.alpha_max,
                image,
                transmittance,
            )
        return torch.from_numpy(image), torch.from_numpy(transmittance)
