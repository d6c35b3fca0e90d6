"""Targets of a job's views: content, coverage and region maps, prepared when a view first needs them."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from sgsst_core.budget import Cache, content_fraction, tensor_bytes
from sgsst_core.features.partition import PartitionTile, Rectangle
from sgsst_core.files.images import Color
from sgsst_core.loss.position_term import ScaledView
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.targets import ContentFeatures, ViewTarget
from sgsst_core.loss.tiling import Division
from sgsst_core.loss.view_images import ViewImages
from sgsst_core.parallel.division import Piece
from sgsst_core.regions.maps import ContentMaps, ViewMaps
from sgsst_core.scene.camera import Camera
from sgsst_core.stylizing.photo_prefetch import PhotoLoader, PhotosAhead
from sgsst_core.stylizing.training_background import replace_background
from sgsst_core.stylizing.views import Views


class ViewTargets:
    """Targets of a job's views.

    Preparing targets involves all ranks, so a view's targets must be cached on all ranks or on none. What is cached
    therefore depends only on sizes that are identical on all ranks.

    Args:
        views: Views; the content of a view is its unstylized render, unless there are photos.
        loss: Loss that prepares the targets, of the same ranks that render the views.
        weighted: Whether statistics are weighted by rendered coverage.
        photos: Function that loads the content image [H, W, 3] of a view by its index; None for unstylized renders.
            With a GPU it is also called in a thread, see `prefetch`.
        memory: See `limit`.
        regions: Rectangle of each view that contains all covered pixels; None if unknown.
        background: Background color of the rasterizer.
        drawn: Whether the background color changes from step to step; content images are then cached instead of
            features.
        maps: Renderer of the maps of regions or depth bands; None for one part.
        content_maps: Renderer of content weights; None for the same everywhere.
    """

    def __init__(
        self,
        views: Views,
        loss: SosLoss,
        *,
        weighted: bool,
        photos: PhotoLoader | None = None,
        memory: int = 1 << 30,
        regions: Sequence[Rectangle] | None = None,
        background: Color = (0.0, 0.0, 0.0),
        drawn: bool = False,
        maps: ViewMaps | None = None,
        content_maps: ContentMaps | None = None,
    ) -> None:
        self.views = views
        self.loss = loss
        self.weighted = weighted
        self.photos = photos
        device = loss.network.device
        self._ahead = PhotosAhead(photos, device) if photos is not None and device.type == "cuda" else None
        self._regions = regions
        self._background = background
        self._drawn = drawn
        self._maps = maps
        self._content_maps = content_maps
        self._coverage: Cache[int, list[Tensor]] = Cache(0, _pyramid_bytes)
        self._region_weights: Cache[tuple[int, bool], list[list[Tensor]]] = Cache(
            0, lambda every: sum(map(_pyramid_bytes, every))
        )
        self._images: Cache[_ContentKey, ScaledView] = Cache(0, _image_bytes)
        self._content: Cache[_ContentKey, ContentFeatures] = Cache(0)
        self.limit(memory)
        self._divisions: dict[tuple[int, tuple[int, ...]], Division] = {}

    @property
    def caches(self) -> dict[str, Cache[Any, Any]]:
        """Caches of data of the views by name."""
        return {
            "coverage": self._coverage,
            "maps": self._region_weights,
            "images": self._images,
            "content": self._content,
        }

    def limit(self, memory: int) -> None:
        """Set the memory budget in bytes for everything that is cached about views.

        A quarter of it is for colors (`Views`), one for coverage, and one for region maps; content uses the rest. On a
        GPU, content also uses the quarter for coverage if there are no position weights.
        """
        has_maps = self._maps is not None or self._content_maps is not None
        cached = int(
            memory * content_fraction(self.loss.network.device.type, weighted=self.weighted, has_maps=has_maps)
        )
        images = cached // 2 if self._drawn else 0
        self._coverage.limit(memory // 4)
        self._region_weights.limit(memory // 4 if has_maps else 0)
        self._images.limit(images)
        self._content.limit(cached - images)

    def target(self, index: int, scales: Sequence[int], background: Color | None = None) -> ViewTarget:
        """Return the target of a view at some scales; cached if it fits.

        Features are computed only for requested scales: phase 1 needs those of one.

        Args:
            background: Background color, which the content gets too; None for the rasterizer's own. Features with a
                background color are used only once, so only the images they are computed from are cached.
        """
        coverage = self.coverage(index) if self.weighted else None
        division = self._division(index, scales, coverage)
        target = ViewTarget(
            coverage=coverage,
            division=division,
            regions=self.region_weights(index),
            content_weights=self.content_weights(index),
            background=background or self._background,
        )
        images = functools.cache(lambda: self._content_images(index, division))
        if self.loss.content_weight and background is not None:
            for scale in scales:
                content = self._images.get(
                    (index, scale, division.pieces[scale]), functools.partial(_scaled, images, scale)
                )
                over = self._content_over(index, content, background)
                target.content[scale] = self.loss.targets.content_features(over, division.tiles[scale])
        elif self.loss.content_weight:
            for scale in scales:
                pieces = division.pieces[scale]
                make = functools.partial(self._features, images, scale, division.tiles[scale])
                size = self.loss.targets.content_bytes(pieces)
                target.content[scale] = self._content.get((index, scale, pieces), make, size)
        return target

    def content(self, index: int) -> Tensor:
        """Return the content image: the photo [H, W, 3], or `Views.unstylized`.

        Photos are on the GPU if there is one.
        """
        if self._ahead is not None:
            return self._ahead(index)
        if self.photos is not None:
            return self.photos(index)
        return self.views.unstylized(index)

    def coverage(self, index: int) -> list[Tensor]:
        """Return the coverage [H >> k, W >> k] of a view at powers of two, on the network's device.

        It is cached if it fits.
        """
        return self._coverage.get(index, lambda: self._rendered_coverage(index))

    def region_weights(self, index: int) -> list[list[Tensor]] | None:
        """Return the map of each region in a view, in the format of `coverage`; None if the scene has no regions."""
        maps = self._maps
        if maps is None:
            return None
        return self._region_weights.get((index, False), lambda: self._rendered_maps(index, maps.render, maps.count))

    def content_weights(self, index: int) -> list[Tensor] | None:
        """Return the relative content weights of a view, in the format of `coverage`; None if they are equal."""
        maps = self._content_maps
        if maps is None:
            return None
        return self._region_weights.get((index, True), lambda: self._rendered_maps(index, maps.render, 1))[0]

    def replace_background(self, index: int, image: Tensor, color: Color) -> Tensor:
        """Replace the background color of a view's `Views.render` [h, w, 3].

        The result is on the network's device.
        """
        coverage, shares = self.coverage(index)[0], self.views.shares(index)
        if shares is not None:
            coverage = coverage[shares.windows[self.views.collectives.rank].slices]
        return replace_background(image.to(self.loss.network.device), coverage, color, self._background)

    def prefetch(self, index: int, scales: Sequence[int]) -> None:
        """Start reading, on a GPU, the photo of the view whose target is requested next, if it will be needed."""
        if self._ahead is not None and self._needs_content(index, scales):
            self._ahead.start(index)

    def end_prefetch(self) -> None:
        """Stop prefetching until the next call of `prefetch`."""
        if self._ahead is not None:
            self._ahead.stop()

    def forget_division(self) -> None:
        """Clear the caches that depend on the division of work, because it is about to change."""
        self._content.clear()
        self._images.clear()
        self._divisions.clear()
        self.views.forget_shares()

    def _needs_content(self, index: int, scales: Sequence[int]) -> bool:
        """Return whether the content features of a view at some scales, or their images, are not cached."""
        if not self.loss.content_weight:
            return False
        cache = self._images if self._drawn else self._content
        division = self._divisions.get((index, tuple(scales)))  # content is cached only after its division is known
        return division is None or any((index, scale, division.pieces[scale]) not in cache for scale in scales)

    def _content_images(self, index: int, division: Division) -> ViewImages:
        """Return the content image of a view at the scales of a division."""
        image = self.content(index).to(self.loss.network.device)
        if self.photos is not None:  # every rank has the whole photo
            division = replace(division, shares=None)
        return ViewImages(image, division, self._background, self.loss.collectives, self.loss.timer)

    def _content_over(self, index: int, content: ScaledView, color: Color) -> ScaledView:
        """Return the content of a view at a scale with another background color.

        In a photo, the color replaces everything that no Gaussian covers.
        """
        coverage, image, present = (
            self.coverage(index)[content.scale][content.area.slices],
            content.image,
            self._background,
        )
        if self.photos is not None:
            image, present = image * coverage[..., None].to(image.dtype), (0.0, 0.0, 0.0)
        return replace(content, image=replace_background(image, coverage, color, present))

    def _division(self, index: int, scales: Sequence[int], coverage: list[Tensor] | None) -> Division:
        """Return the division of work on some scales of a view.

        It is computed once, because it requires reading the coverage.
        """
        key = (index, tuple(scales))
        if key not in self._divisions:
            camera, divider = self.views.cameras[index], self.loss.divider
            sizes = {scale: (camera.height >> scale, camera.width >> scale) for scale in scales}
            known = self._regions[index] if self._regions else None
            if self.views.shares(index) is not None:
                self._divisions[key] = divider.divide_view((camera.height, camera.width), scales, coverage, known)
            elif self.loss.network.device.type != "cpu":
                self._divisions[key] = divider.divide(sizes, coverage, known)
            else:
                self._divisions[key] = divider.divide(sizes, coverage)
        return self._divisions[key]

    def _rendered_coverage(self, index: int) -> list[Tensor]:
        window = self.views.window(index, self.views.rasterizer.repeatable.coverage)
        return self.loss.targets.position_weights(self.views.whole(index, window))

    def _rendered_maps(self, index: int, render: Callable[[Camera], Tensor], count: int) -> list[list[Tensor]]:
        whole = self.views.whole(index, self.views.window(index, render, count))
        return [self.loss.targets.position_weights(weights) for weights in whole.unbind(2)]

    def _features(
        self, images: Callable[[], ViewImages], scale: int, tiles: Sequence[PartitionTile]
    ) -> ContentFeatures:
        return self.loss.targets.content_features(images().scaled(scale), tiles)


#: Index of the view, scale, and every rank's pieces of it.
_ContentKey = tuple[int, int, tuple[tuple[Piece, ...], ...]]


def _scaled(images: Callable[[], ViewImages], scale: int) -> ScaledView:
    return images().scaled(scale)


def _image_bytes(view: ScaledView) -> int:
    """Return the size in bytes of a whole scaled view, which all ranks agree on."""
    return view.size[0] * view.size[1] * 3 * view.image.itemsize


def _pyramid_bytes(pyramid: list[Tensor]) -> int:
    return sum(map(tensor_bytes, pyramid))
