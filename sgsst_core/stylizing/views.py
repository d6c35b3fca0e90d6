"""Views of a job: rendering, targets, and caches."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.features.partition import PartitionTile, Rectangle
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.targets import ContentFeatures, ViewTarget
from sgsst_core.loss.tiling import Division
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import Piece, divide_rows
from sgsst_core.parallel.shown import ShownGaussians
from sgsst_core.rasterizer import Rasterizer, Rows
from sgsst_core.regions.maps import RegionMaps
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import downscale
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors, view_colors_gradient
from sgsst_core.stylizing.ahead import PhotoLoader, PhotosAhead
from sgsst_core.stylizing.training_background import Color, put_behind


class Views:
    """Renderer of a job's views, which also prepares their targets at first use.

    With several ranks, each renders a band of rows. Preparing targets involves all ranks, so a view's targets must be
    cached on all ranks or on none. What is cached therefore depends only on sizes that are identical on all ranks.

    Args:
        scene: Scene that provides the frozen part of the colors and the content (the unstylized render).
        cameras: One camera per view.
        rasterizer: Rasterizer of the views.
        loss: Loss that prepares the targets.
        covered: Indices of the views that see anything.
        weighted: Whether statistics are weighted by rendered coverage.
        photos: Function that loads the content image [H, W, 3] of a view by its index; None for unstylized renders.
            With a GPU it is also called in a thread, see `look_ahead`.
        memory: Memory budget in bytes for content features, coverage and colors of views.
        keep_content: Whether to cache content features that fit; False recomputes them at each visit, for comparison.
        clamp_aware_gradient: Whether to use the clamp-aware gradient (`view_colors_gradient`).
        regions: Rectangle of each view that contains all covered pixels; None if unknown.
        background: Background color of the rasterizer.
        drawn: Whether the background color changes from step to step; content images are then cached instead of
            features.
        maps: Renderer of region maps; None if the scene has no regions.
        collectives: Ranks that render each view together, the same as in `loss`.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        rasterizer: Rasterizer,
        loss: SosLoss,
        *,
        covered: list[int],
        weighted: bool,
        photos: PhotoLoader | None = None,
        memory: int = 1 << 30,
        keep_content: bool = True,
        clamp_aware_gradient: bool = False,
        regions: Sequence[Rectangle] | None = None,
        background: Color = (0.0, 0.0, 0.0),
        drawn: bool = False,
        maps: RegionMaps | None = None,
        collectives: Collectives = ALONE,
    ) -> None:
        self.scene = scene
        self.cameras = list(cameras)
        self.rasterizer = rasterizer
        #: Rasterizer for values that are cached over many steps; its results do not depend on what is cached.
        self._repeatable = rasterizer.repeatable
        self.loss = loss
        self.collectives = collectives
        self._photos = photos
        device = loss.network.device
        self._ahead = PhotosAhead(photos, device) if photos is not None and device.type == "cuda" else None
        self._bands = [
            divide_rows(
                camera.height, collectives.size, (regions[index].top, regions[index].bottom) if regions else None
            )
            for index, camera in enumerate(cameras)
        ]
        self._regions = regions
        self._sh_dc = scene.sh_dc.to(rasterizer.device)
        self._sh_rest = scene.sh_rest.to(rasterizer.device)
        self._means = scene.means.to(rasterizer.device)
        shown = memory // 16 if collectives.size > 1 else 0
        self._shown: Cache[int, ShownGaussians] = Cache(shown)
        self._rest: Cache[int, Tensor] = Cache(memory // 4 - shown, _tensor_bytes)
        self._coverage: Cache[int, list[Tensor]] = Cache(memory // 4, _pyramid_bytes)
        #: Budget for content, half of which goes to region maps if there are any.
        content = memory // 2 if maps is None else memory // 4
        self._region_weights: Cache[int, list[list[Tensor]]] = Cache(
            0 if maps is None else memory // 4, lambda every: sum(map(_pyramid_bytes, every))
        )
        kept = content if keep_content else 0
        images = kept // 2 if drawn else 0
        self._images: Cache[_ImageKey, Tensor] = Cache(images, _tensor_bytes)
        self._content: Cache[_ContentKey, ContentFeatures] = Cache(kept - images)
        self._shares: dict[tuple[int, tuple[int, ...]], Division] = {}
        self.covered = covered
        self.weighted = weighted
        self.clamp_aware_gradient = clamp_aware_gradient
        self._background = background
        self._maps = maps
        self._drawn = drawn

    def __len__(self) -> int:
        return len(self.cameras)

    def colors(self, index: int, sh_dc: Tensor) -> Tensor:
        """Return the colors [N, 3] of a view."""
        if self.scene.sh_degree == 0:
            return view_colors(sh_dc, torch.zeros((), dtype=sh_dc.dtype, device=sh_dc.device))
        rest = self._rest.get(index, lambda: rest_colors(self._sh_rest, self._means, self.cameras[index]))
        return view_colors(sh_dc, rest)

    def render(self, index: int, colors: Tensor, rasterizer: Rasterizer | None = None) -> Tensor:
        """Return the image [h, w, 3] of a view.

        Args:
            index: Index of the view.
            colors: [N, 3], colors of the view.
            rasterizer: Replacement for the views' own rasterizer.
        """
        rasterizer, camera = rasterizer or self.rasterizer, self.cameras[index]
        band = self._own_band(index)
        some = band[0] < band[1]
        rows = rasterizer.render(colors, camera, band) if some else self._nothing(0, camera.width, 3)
        with self.loss.timer("communication"):
            return self.collectives.all_gather_rows(rows, self._bands[index])

    def gradient(self, index: int, image_gradient: Tensor, colors: Tensor) -> Tensor:
        """Return dL/dsh_dc [N, 3].

        Args:
            index: Index of the view.
            image_gradient: [h, w, 3], this rank's summand of dL/dimage.
            colors: [N, 3], colors that were rendered.
        """
        camera, band = self.cameras[index], self._own_band(index)
        with self.loss.timer("communication"):
            rows = self.collectives.reduce_scatter_rows(image_gradient, self._bands[index])
        some = len(rows) > 0
        gradient = self.rasterizer.color_gradient(rows, camera, band) if some else self._nothing(len(colors), 3)
        gradient = self._sum(gradient, self._shown_by(index, rows, band))
        # After the sum, because which colors pass the clamp depends on the sign of their total gradient.
        return view_colors_gradient(gradient, colors, clamp_aware_gradient=self.clamp_aware_gradient)

    def keep_weights(self, index: int) -> None:
        """Cache the blend weights of this rank's band of a view, if the rasterizer can cache them and they fit."""
        band = self._own_band(index)
        if band[0] < band[1]:
            self.rasterizer.cache_weights(self.cameras[index], band)

    def lending_weights(self, index: int) -> AbstractContextManager[None]:
        """Use in a `with` block the blend weights that `keep_weights` would cache, even if they are not cached."""
        band = self._own_band(index)
        if band[0] < band[1]:
            return self.rasterizer.temporary_weights(self.cameras[index], band)
        return nullcontext()

    def _sum(self, gradient: Tensor, shown: ShownGaussians | None) -> Tensor:
        """Return the sum [N, 3] of all ranks' gradients, which are 0 for all Gaussians but those in `shown`."""
        with self.loss.timer("communication"):
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

        def look() -> ShownGaussians:
            mask = torch.zeros(len(self.scene), dtype=torch.bool, device=self.rasterizer.device)
            with self.loss.timer("prepare"):
                if len(rows):  # weights are never negative, so their sum is 0 only if all are
                    mask = self.rasterizer.color_gradient(torch.ones_like(rows), self.cameras[index], band)[:, 0] > 0
            with self.loss.timer("communication"):
                return ShownGaussians(self.collectives.union(mask))

        return self._shown.get(index, look, size)

    def _nothing(self, *shape: int) -> Tensor:
        """Return zeros: the contribution of a rank that has no rows of a view."""
        return torch.zeros(shape, dtype=self.rasterizer.dtype, device=self.rasterizer.device)

    def _own_band(self, index: int) -> Rows:
        return self._bands[index][self.collectives.rank]

    def content(self, index: int) -> Tensor:
        """Return the content image [H, W, 3]: the photo, or the render of the unstylized scene.

        Photos are on the GPU if there is one.
        """
        if self._ahead is not None:
            return self._ahead(index)
        if self._photos is not None:
            return self._photos(index)
        return self.render(index, self.colors(index, self._sh_dc), self._repeatable)

    def look_ahead(self, index: int, scales: Sequence[int]) -> None:
        """Start reading, on a GPU, the photo of the view whose target is requested next, if it will be needed."""
        if self._ahead is not None and self._needs_content(index, scales):
            self._ahead.begin(index)

    def end_look_ahead(self) -> None:
        """Stop prefetching until the next call of `look_ahead`."""
        if self._ahead is not None:
            self._ahead.end()

    def _needs_content(self, index: int, scales: Sequence[int]) -> bool:
        """Return whether the content features of a view at some scales, or their images, are not cached."""
        if self._drawn:
            return bool(self.loss.content_weight) and any((index, scale) not in self._images for scale in scales)
        share = self._shares.get((index, tuple(scales)))  # features are cached only after their share is known
        kept = share is not None and all((index, scale, share.pieces[scale]) in self._content for scale in scales)
        return bool(self.loss.content_weight) and not kept

    def coverage(self, index: int) -> list[Tensor]:
        """Return the coverage [H >> k, W >> k] of a view at powers of two, on the network's device.

        It is cached if it fits.
        """
        return self._coverage.get(index, lambda: self._position_weights(index))

    def region_weights(self, index: int) -> list[list[Tensor]] | None:
        """Return the map of each region in a view, in the format of `coverage`; None if the scene has no regions."""
        maps = self._maps
        return None if maps is None else self._region_weights.get(index, lambda: self._rendered_regions(index, maps))

    def put_behind(self, index: int, image: Tensor, color: Color, scale: int = 0) -> Tensor:
        """Replace the background color of a view's image [h, w, 3] at a scale.

        The result is on the network's device.
        """
        return put_behind(image.to(self.loss.network.device), self.coverage(index)[scale], color, self._background)

    def target(self, index: int, scales: Sequence[int], behind: Color | None = None) -> ViewTarget:
        """Return the target of a view at some scales; cached if it fits.

        Features are computed only for requested scales: phase 1 needs those of one.

        Args:
            index: Index of the view.
            scales: Requested scales.
            behind: Background color, which the content gets too; None for the rasterizer's own. Features with a
                background color are used only once, so only the images they are computed from are cached.
        """
        coverage = self.coverage(index) if self.weighted else None
        share = self._share(index, scales, coverage)
        target = ViewTarget(coverage=coverage, division=share, regions=self.region_weights(index))
        if self.loss.content_weight and behind is not None:
            for scale, content in self._content_images(index, scales).items():
                over = self._content_behind(index, content, behind, scale)
                target.content[scale] = self.loss.targets.content_features(over, 0, share.tiles[scale])
        elif self.loss.content_weight:
            image = functools.cache(lambda: self.content(index))
            for scale in scales:
                pieces = share.pieces[scale]
                make = functools.partial(self._features, image, scale, share.tiles[scale])
                size = self.loss.targets.content_bytes(pieces)
                target.content[scale] = self._content.get((index, scale, pieces), make, size)
        return target

    def _content_images(self, index: int, scales: Sequence[int]) -> dict[int, Tensor]:
        """Return the content of a view at some scales, [H >> s, W >> s, 3] on the network's device."""
        whole = functools.cache(lambda: self.content(index).to(self.loss.network.device))

        def scaled(scale: int) -> Tensor:
            return downscale(whole(), scale)

        return {scale: self._images.get((index, scale), functools.partial(scaled, scale)) for scale in scales}

    def _content_behind(self, index: int, image: Tensor, behind: Color, scale: int) -> Tensor:
        """Return the content of a view at a scale with another background color.

        In a photo, the color replaces everything that no Gaussian covers.
        """
        if self._photos is None:
            return self.put_behind(index, image, behind, scale)
        coverage = self.coverage(index)[scale]
        return put_behind(image * coverage[..., None].to(image.dtype), coverage, behind, (0.0, 0.0, 0.0))

    def uncached_fraction(self) -> None:
        """Clear the caches that depend on the division of work, because it is about to change."""
        self._content.clear()
        self._shares.clear()

    def _share(self, index: int, scales: Sequence[int], coverage: list[Tensor] | None) -> Division:
        """Return the division of work on some scales of a view.

        It is computed once, because it requires reading the coverage.
        """
        key = (index, tuple(scales))
        if key not in self._shares:
            camera = self.cameras[index]
            sizes = {scale: (camera.height >> scale, camera.width >> scale) for scale in scales}
            known = self._regions[index] if self._regions and self.loss.network.device.type != "cpu" else None
            self._shares[key] = self.loss.divider.divide(sizes, coverage, known)
        return self._shares[key]

    def _position_weights(self, index: int) -> list[Tensor]:
        band, camera = self._own_band(index), self.cameras[index]
        some = band[0] < band[1]
        rows = self._repeatable.coverage(camera, band) if some else self._nothing(0, camera.width)
        return self.loss.targets.position_weights(self.collectives.all_gather_rows(rows, self._bands[index]))

    def _rendered_regions(self, index: int, maps: RegionMaps) -> list[list[Tensor]]:
        band, camera = self._own_band(index), self.cameras[index]
        some = band[0] < band[1]
        rows = maps.render(camera, band) if some else self._nothing(0, camera.width, maps.count)
        whole = self.collectives.all_gather_rows(rows, self._bands[index])
        return [self.loss.targets.position_weights(weights) for weights in whole.unbind(2)]

    def _features(self, image: Callable[[], Tensor], scale: int, tiles: Sequence[PartitionTile]) -> ContentFeatures:
        return self.loss.targets.content_features(image(), scale, tiles)


#: Index of the view, and scale.
_ImageKey = tuple[int, int]
#: Index of the view, scale, and every rank's pieces of it.
_ContentKey = tuple[int, int, tuple[tuple[Piece, ...], ...]]


def _tensor_bytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


def _pyramid_bytes(pyramid: list[Tensor]) -> int:
    return sum(_tensor_bytes(level) for level in pyramid)
