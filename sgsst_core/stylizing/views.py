"""Views of a job: colors, images and color gradients."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import Cache, tensor_bytes
from sgsst_core.features.partition import Rectangle
from sgsst_core.loss.tiling import Divider
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import ImageExchange, Shares
from sgsst_core.parallel.visible_gaussians import ShownGaussians
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors, view_colors_gradient
from sgsst_core.timing import Timer


class ViewColors:
    """Function that computes a view's colors; their part from higher SH degrees never changes, and is cached.

    Args:
        memory: Memory budget of the cache in bytes.
    """

    def __init__(self, scene: Scene, cameras: Sequence[Camera], device: torch.device, memory: int) -> None:
        self._cameras = cameras
        self._degree = scene.sh_degree
        self._sh_rest = scene.sh_rest.to(device)
        self._means = scene.means.to(device)
        self.cache: Cache[int, Tensor] = Cache(memory, tensor_bytes)

    def __call__(self, index: int, sh_dc: Tensor) -> Tensor:
        """Return the colors [N, 3] of a view for `sh_dc` [N, 3]."""
        if self._degree == 0:
            return view_colors(sh_dc, torch.zeros((), dtype=sh_dc.dtype, device=sh_dc.device))
        rest = self.cache.get(index, lambda: rest_colors(self._sh_rest, self._means, self._cameras[index]))
        return view_colors(sh_dc, rest)


class Views:
    """Renderer of a job's views. With several ranks, each renders a rectangle of every view.

    Args:
        scene: Scene that provides the frozen part of the colors.
        covered: Indices of the views that see anything.
        memory: See `limit`.
        clamp_aware_gradient: Whether to use the clamp-aware gradient (`view_colors_gradient`).
        regions: Rectangle of each view that contains all covered pixels; None if unknown.
        divider: Divider of each view among the ranks that render it together; None for a single rank.
        timer: Timer for `prepare` and `communication`; None for one of its own.

    Attributes:
        colors: Function that returns the colors [N, 3] of a view for `sh_dc` [N, 3].
        collectives: Collectives of the ranks that render each view together.
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
        divider: Divider | None = None,
        timer: Timer | None = None,
    ) -> None:
        self.scene = scene
        self.cameras = list(cameras)
        self.rasterizer = rasterizer
        self.covered = covered
        self.clamp_aware_gradient = clamp_aware_gradient
        self.collectives: Collectives = divider.collectives if divider else ALONE
        self.timer = timer or Timer()
        self._divider = divider
        self._regions = regions
        self._shares: dict[int, Shares] = {}
        self._shown: Cache[int, ShownGaussians] = Cache(0)
        self.colors = ViewColors(scene, self.cameras, rasterizer.device, memory)
        self.limit(memory)
        self._sh_dc = scene.sh_dc.to(rasterizer.device)

    @property
    def caches(self) -> dict[str, Cache[Any, Any]]:
        """Caches of data of the views by name, "weights" before "intersections"."""
        return {"colors": self.colors.cache, "shown": self._shown, **self.rasterizer.caches}

    def limit(self, memory: int) -> None:
        """Set the memory budget in bytes for everything that is cached about views; a quarter of it is for colors."""
        shown = memory // 16 if self.collectives.size > 1 else 0
        self._shown.limit(shown)
        self.colors.cache.limit(memory // 4 - shown)

    def __len__(self) -> int:
        return len(self.cameras)

    def render(self, index: int, colors: Tensor, rasterizer: Rasterizer | None = None) -> Tensor:
        """Return the image of a view; with several ranks, of the rectangle [h, w, 3] that this rank renders.

        Args:
            colors: [N, 3], colors of the view.
            rasterizer: Replacement for the views' own rasterizer.
        """
        chosen = rasterizer or self.rasterizer
        return self.window(index, lambda camera: chosen.render(colors, camera), 3)

    def unstylized(self, index: int) -> Tensor:
        """Return the `render` of a view of the unstylized scene.

        It does not depend on which blend weights are cached, because it is cached itself over many steps.
        """
        return self.render(index, self.colors(index, self._sh_dc), self.rasterizer.repeatable)

    def window(self, index: int, make: Callable[[Camera], Tensor], *shape: int) -> Tensor:
        """Return this rank's rectangle [h, w, *shape] of a view, from a function of its camera.

        The function is not called if the rectangle is empty.
        """
        camera = self._own_camera(index)
        return self._nothing(0, 0, *shape) if camera is None else make(camera)

    def whole(self, index: int, window: Tensor) -> Tensor:
        """Return the whole view [H, W, ...] from every rank's rectangle [h, w, ...]; 0 where no rank renders."""
        shares = self.shares(index)
        if shares is None:
            return window
        rank = self.collectives.rank
        own = window[shares.parts[rank].within(shares.windows[rank]).slices]
        image = own.new_zeros((*shares.size, *own.shape[2:]))
        with self.timer("communication"):
            everything = Rectangle(0, 0, *shares.size)
            exchange = ImageExchange(shares.parts, [everything] * self.collectives.size)
            self.collectives.gather_parts([exchange], [own], [image])
        return image

    def shares(self, index: int) -> Shares | None:
        """Return the rectangles of a view that the ranks render; None for a single rank."""
        if self._divider is None or self.collectives.size == 1:
            return None
        if index not in self._shares:
            camera = self.cameras[index]
            region = self._regions[index] if self._regions else None
            self._shares[index] = self._divider.shares((camera.height, camera.width), region)
        return self._shares[index]

    def forget_shares(self) -> None:
        """Clear what depends on the rectangles that the ranks render, because they are about to change."""
        self._shares.clear()
        self._shown.clear()
        self.rasterizer.forget_views()

    def gradient(self, index: int, image_gradient: Tensor, colors: Tensor) -> Tensor:
        """Return dL/dsh_dc [N, 3].

        Args:
            image_gradient: [h, w, 3], this rank's summand of dL/dimage in the rectangle that it renders.
            colors: [N, 3], colors that were rendered.
        """
        camera = self._own_camera(index)
        if camera is None:
            gradient = self._nothing(len(colors), 3)
        else:
            gradient = self.rasterizer.color_gradient(image_gradient, camera)
        gradient = self._sum(gradient, self._shown_by(index))
        # After the sum, because which colors pass the clamp depends on the sign of their total gradient.
        return view_colors_gradient(gradient, colors, clamp_aware_gradient=self.clamp_aware_gradient)

    def cache_weights(self, index: int) -> None:
        """Cache the blend weights of this rank's rectangle of a view, if the rasterizer supports it and they fit.

        Only steps do so: renders between steps happen at varying times, and must not affect the results of steps.
        """
        camera = self._own_camera(index)
        if camera is not None:
            self.rasterizer.cache_weights(camera)

    def temporary_weights(self, index: int) -> AbstractContextManager[None]:
        """Use in a `with` block the blend weights that `cache_weights` would cache, even if they are not cached."""
        camera = self._own_camera(index)
        return nullcontext() if camera is None else self.rasterizer.temporary_weights(camera)

    def _sum(self, gradient: Tensor, shown: ShownGaussians | None) -> Tensor:
        """Return the sum [N, 3] of all ranks' gradients, which are 0 for all Gaussians but those in `shown`."""
        with self.timer("communication"):
            if shown is None or not shown.sparse:
                return self.collectives.all_reduce(gradient)
            indices = shown.indices()
            return gradient.index_copy_(0, indices, self.collectives.all_reduce(gradient.index_select(0, indices)))

    def _shown_by(self, index: int) -> ShownGaussians | None:
        """Return the Gaussians that any rank's rectangle of a view shows.

        Ranks agree on them at the first visit, using the same blend weights as gradients do. Blend weights of another
        rasterizer, or of the whole view instead of its rectangles, may differ by rounding at the smallest opacity.

        Returns:
            The Gaussians; None if there is only one rank, or if they do not fit in the cache.
        """
        size = ShownGaussians.nbytes(len(self.scene))
        if self.collectives.size == 1 or (index not in self._shown and not self._shown.has_space(size)):
            return None

        def find() -> ShownGaussians:
            mask = torch.zeros(len(self.scene), dtype=torch.bool, device=self.rasterizer.device)
            with self.timer("prepare"):
                camera = self._own_camera(index)
                if camera is not None:  # weights are never negative, so their sum is 0 only if all are
                    ones = torch.ones((camera.height, camera.width, 3))
                    mask = self.rasterizer.color_gradient(ones, camera)[:, 0] > 0
            with self.timer("communication"):
                return ShownGaussians(self.collectives.union(mask))

        return self._shown.get(index, find, size)

    def _nothing(self, *shape: int) -> Tensor:
        """Return zeros: the contribution of a rank that has no pixels of a view."""
        return torch.zeros(shape, dtype=self.rasterizer.dtype, device=self.rasterizer.device)

    def _own_camera(self, index: int) -> Camera | None:
        """Return the camera of this rank's rectangle of a view; None if it is empty."""
        shares = self.shares(index)
        if shares is None:
            return self.cameras[index]
        window = shares.windows[self.collectives.rank]
        if not window.pixels:
            return None
        return self.cameras[index].cropped(window.top, window.left, window.bottom, window.right)
