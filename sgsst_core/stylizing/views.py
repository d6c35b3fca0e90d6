"""Views of a job: colors, images and color gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.features.partition import Rectangle
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import divide_rows
from sgsst_core.parallel.shown import ShownGaussians
from sgsst_core.rasterizer import Rasterizer, Rows
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import view_colors_gradient
from sgsst_core.stylizing.view_colors import ViewColors
from sgsst_core.timing import Timer


class Views:
    """Renderer of a job's views. With several ranks, each renders a band of rows.

    Args:
        scene: Scene that provides the frozen part of the colors.
        cameras: One camera per view.
        rasterizer: Rasterizer of the views.
        covered: Indices of the views that see anything.
        memory: Memory budget in bytes for everything that is cached about views; a quarter of it is for colors.
        clamp_aware_gradient: Whether to use the clamp-aware gradient (`view_colors_gradient`).
        regions: Rectangle of each view that contains all covered pixels; None if unknown.
        collectives: Ranks that render each view together.
        timer: Timer for `prepare` and `communication`; None for one of its own.

    Attributes:
        colors: Function that returns the colors [N, 3] of a view for `sh_dc` [N, 3].
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        rasterizer: Rasterizer,
        *,
        covered: list[int],
        memory: int = 1 << 30,
        clamp_aware_gradient: bool = False,
        regions: Sequence[Rectangle] | None = None,
        collectives: Collectives = ALONE,
        timer: Timer | None = None,
    ) -> None:
        self.scene = scene
        self.cameras = list(cameras)
        self.rasterizer = rasterizer
        self.covered = covered
        self.clamp_aware_gradient = clamp_aware_gradient
        self.collectives = collectives
        self.timer = timer or Timer()
        self._bands = [
            divide_rows(
                camera.height, collectives.size, (regions[index].top, regions[index].bottom) if regions else None
            )
            for index, camera in enumerate(cameras)
        ]
        shown = memory // 16 if collectives.size > 1 else 0
        self._shown: Cache[int, ShownGaussians] = Cache(shown)
        self.colors = ViewColors(scene, self.cameras, rasterizer.device, memory // 4 - shown)
        self._sh_dc = scene.sh_dc.to(rasterizer.device)

    def __len__(self) -> int:
        return len(self.cameras)

    def render(self, index: int, colors: Tensor, rasterizer: Rasterizer | None = None) -> Tensor:
        """Return the image [h, w, 3] of a view.

        Args:
            index: Index of the view.
            colors: [N, 3], colors of the view.
            rasterizer: Replacement for the views' own rasterizer.
        """
        chosen = rasterizer or self.rasterizer
        rows = self.own_rows(index, lambda camera, band: chosen.render(colors, camera, band), 3)
        with self.timer("communication"):
            return self.gathered(index, rows)

    def unstylized(self, index: int) -> Tensor:
        """Return the image [h, w, 3] of a view of the unstylized scene.

        It does not depend on which blend weights are cached, because it is cached itself over many steps.
        """
        return self.render(index, self.colors(index, self._sh_dc), self.rasterizer.repeatable)

    def own_rows(self, index: int, make: Callable[[Camera, Rows], Tensor], *shape: int) -> Tensor:
        """Return this rank's band of a view, [h, w, *shape], from a function of camera and band.

        The function is not called if the band has no rows.
        """
        camera, band = self.cameras[index], self._own_band(index)
        return make(camera, band) if band[0] < band[1] else self._nothing(0, camera.width, *shape)

    def gathered(self, index: int, rows: Tensor) -> Tensor:
        """Return the whole view [H, w, ...] from all ranks' bands [h, w, ...]."""
        return self.collectives.all_gather_rows(rows, self._bands[index])

    def gradient(self, index: int, image_gradient: Tensor, colors: Tensor) -> Tensor:
        """Return dL/dsh_dc [N, 3].

        Args:
            index: Index of the view.
            image_gradient: [h, w, 3], this rank's summand of dL/dimage.
            colors: [N, 3], colors that were rendered.
        """
        camera, band = self.cameras[index], self._own_band(index)
        with self.timer("communication"):
            rows = self.collectives.reduce_scatter_rows(image_gradient, self._bands[index])
        some = len(rows) > 0
        gradient = self.rasterizer.color_gradient(rows, camera, band) if some else self._nothing(len(colors), 3)
        gradient = self._sum(gradient, self._shown_by(index, rows, band))
        # After the sum, because which colors pass the clamp depends on the sign of their total gradient.
        return view_colors_gradient(gradient, colors, clamp_aware_gradient=self.clamp_aware_gradient)

    def cache_weights(self, index: int) -> None:
        """Cache the blend weights of this rank's band of a view, if the rasterizer can cache them and they fit."""
        band = self._own_band(index)
        if band[0] < band[1]:
            self.rasterizer.cache_weights(self.cameras[index], band)

    def temporary_weights(self, index: int) -> AbstractContextManager[None]:
        """Use in a `with` block the blend weights that `cache_weights` would cache, even if they are not cached."""
        band = self._own_band(index)
        if band[0] < band[1]:
            return self.rasterizer.temporary_weights(self.cameras[index], band)
        return nullcontext()

    def _sum(self, gradient: Tensor, shown: ShownGaussians | None) -> Tensor:
        """Return the sum [N, 3] of all ranks' gradients, which are 0 for all Gaussians but those in `shown`."""
        with self.timer("communication"):
            if shown is None or not shown.sparse:
                return self.collectives.all_reduce(gradient)
            indices = shown.indices()
            return gradient.index_copy_(0, indices, self.collectives.all_reduce(gradient.index_select(0, indices)))

    def _shown_by(self, index: int, rows: Tensor, band: Rows) -> ShownGaussians | None:
        """Return the Gaussians that any rank's band of a view shows.

        Ranks agree on them at the first visit, using the same blend weights as gradients do. Blend weights of another
        rasterizer, or of the whole view instead of its bands, may differ by rounding at the smallest opacity.

        Args:
            index: Index of the view.
            rows: [h, w, 3], image gradient of this rank's band, used for its shape.
            band: Rows of the band.

        Returns:
            The Gaussians; None if there is only one rank, or if they do not fit in the cache.
        """
        size = ShownGaussians.nbytes(len(self.scene))
        if self.collectives.size == 1 or not self._shown.holds(index, size):
            return None

        def find() -> ShownGaussians:
            mask = torch.zeros(len(self.scene), dtype=torch.bool, device=self.rasterizer.device)
            with self.timer("prepare"):
                if len(rows):  # weights are never negative, so their sum is 0 only if all are
                    mask = self.rasterizer.color_gradient(torch.ones_like(rows), self.cameras[index], band)[:, 0] > 0
            with self.timer("communication"):
                return ShownGaussians(self.collectives.union(mask))

        return self._shown.get(index, find, size)

    def _nothing(self, *shape: int) -> Tensor:
        """Return zeros: the contribution of a rank that has no rows of a view."""
        return torch.zeros(shape, dtype=self.rasterizer.dtype, device=self.rasterizer.device)

    def _own_band(self, index: int) -> Rows:
        return self._bands[index][self.collectives.rank]
