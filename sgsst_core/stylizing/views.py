"""The views of a job: what each is compared with, and what of it is kept in memory."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from sgsst_core.budget import Shelf
from sgsst_core.features.partition import PartitionTile, Rectangle
from sgsst_core.loss.sos import ContentFeatures, Share, SosLoss, ViewTarget
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.parallel.division import Piece, divide_rows
from sgsst_core.parallel.shown import ShownGaussians
from sgsst_core.rasterizer import Rasterizer, Rows
from sgsst_core.rasterizer.cached import CachedRasterizer, repeatable
from sgsst_core.rasterizer.coarse import CoarseRasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.pyramid import downscale
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors, view_colors_gradient
from sgsst_core.stylizing.ahead import PhotoLoader, PhotosAhead
from sgsst_core.stylizing.regions import RegionMaps
from sgsst_core.stylizing.training_background import Color, put_behind


class Views:
    """Renders views, and prepares their targets at first use.

    Of several ranks, each renders a band of rows. What is kept is decided by sizes that are the same on every rank, so
    that all of them find a view's targets, or none: preparing them takes all ranks.

    Args:
        scene: supplies the colors' frozen part and the content (the unstylized render).
        cameras: one for each view.
        rasterizer: renders them.
        loss: prepares the targets.
        photos: content image [H, W, 3] of a view by its index; None for the unstylized render. On a GPU they are read
            in a thread too, see `look_ahead`.
        covered: indices of the views that see anything.
        weighted: weigh statistics by rendered coverage.
        memory: bytes that content features, coverage and colors of views may take.
        clamp_aware_gradient: let colors that the clamp holds at 0 come back (`view_colors_gradient`).
        keep_content: keep content features that fit; False computes them at each visit, for comparison.
        regions: for each view, the rectangle that holds every covered pixel; None where that is not known.
        background: what the rasterizer has behind the Gaussians.
        drawn: steps have other colors behind the Gaussians: images of the content are kept for them, not features.
        maps: renders the share of each of the scene's regions; None where it has none.
        collectives: of the ranks that render each view together; `loss` has the same.
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
        #: For what is kept through many steps: whenever it is made, it has the same bits.
        self._repeatable = repeatable(rasterizer)
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
        self._shown: Shelf[_ShownKey, ShownGaussians] = Shelf(shown)
        self._rest: Shelf[int, Tensor] = Shelf(memory // 4 - shown, _tensor_bytes)
        self._coverage: Shelf[int, list[Tensor]] = Shelf(memory // 4, _pyramid_bytes)
        #: Room for content, of which maps of regions take one half.
        content = memory // 2 if maps is None else memory // 4
        self._region_weights: Shelf[int, list[list[Tensor]]] = Shelf(
            0 if maps is None else memory // 4, lambda every: sum(map(_pyramid_bytes, every))
        )
        kept = content if keep_content else 0
        images = kept // 2 if drawn else 0
        self._images: Shelf[_ImageKey, Tensor] = Shelf(images, _tensor_bytes)
        self._content: Shelf[_ContentKey, ContentFeatures] = Shelf(kept - images)
        self._shares: dict[tuple[int, tuple[int, ...]], Share] = {}
        self.covered = covered
        self.weighted = weighted
        self.clamp_aware_gradient = clamp_aware_gradient
        self._background = background
        self._maps = maps
        self._drawn = drawn

    def __len__(self) -> int:
        return len(self.cameras)

    def colors(self, index: int, sh_dc: Tensor) -> Tensor:
        """Colors [N, 3] of a view."""
        if self.scene.sh_degree == 0:
            return view_colors(sh_dc, torch.zeros((), dtype=sh_dc.dtype, device=sh_dc.device))
        rest = self._rest.get(index, lambda: rest_colors(self._sh_rest, self._means, self.cameras[index]))
        return view_colors(sh_dc, rest)

    def render(self, index: int, colors: Tensor, rasterizer: Rasterizer | None = None) -> Tensor:
        """Image [h, w, 3] of a view with its colors [N, 3].

        Args:
            rasterizer: takes the place of the views' own; h and w are those of its scale. Images of a coarse scale
                are so small that every rank renders them whole.
        """
        rasterizer, camera = rasterizer or self.rasterizer, self.cameras[index]
        if rasterizer.scale:
            return rasterizer.render(colors, camera)
        band = self._own_band(index)
        some = band[0] < band[1]
        rows = rasterizer.render(colors, camera, band) if some else self._nothing(0, camera.width, 3)
        with self.loss.timer("communication"):
            return self.collectives.all_gather_rows(rows, self._bands[index])

    def gradient(
        self, index: int, image_gradient: Tensor, colors: Tensor, rasterizer: Rasterizer | None = None
    ) -> Tensor:
        """dL/dsh_dc [N, 3] from this rank's part of dL/dimage [h, w, 3] and the colors that were rendered.

        Args:
            rasterizer: as for `render`.
        """
        rasterizer, camera = rasterizer or self.rasterizer, self.cameras[index]
        if rasterizer.scale:
            rows, band = image_gradient, None
        else:
            band = self._own_band(index)
            with self.loss.timer("communication"):
                rows = self.collectives.reduce_scatter_rows(image_gradient, self._bands[index])
        some = len(rows) > 0
        gradient = rasterizer.color_gradient(rows, camera, band) if some else self._nothing(len(colors), 3)
        gradient = self._sum(gradient, self._shown_by(index, rasterizer, rows, band))
        # After the sum: which colors are let through depends on the sign of their whole gradient.
        return view_colors_gradient(gradient, colors, clamp_aware_gradient=self.clamp_aware_gradient)

    def keep_weights(self, index: int, rasterizer: Rasterizer | None = None) -> None:
        """Keep the blend weights of this rank's part of a view, where its rasterizer keeps any and they fit.

        Args:
            rasterizer: as for `render`.
        """
        rasterizer, camera, band = rasterizer or self.rasterizer, self.cameras[index], self._own_band(index)
        if isinstance(rasterizer, CoarseRasterizer):
            rasterizer.keep(camera)
        elif isinstance(rasterizer, CachedRasterizer) and band[0] < band[1]:
            rasterizer.keep(camera, band)

    def lending_weights(self, index: int, rasterizer: Rasterizer) -> AbstractContextManager[None]:
        """A block in which a view's weights are those that `keep_weights` keeps, though they may not be kept by then.

        Coarse ones are no approximation, and not lent.
        """
        band = self._own_band(index)
        if isinstance(rasterizer, CachedRasterizer) and band[0] < band[1]:
            return rasterizer.lending(self.cameras[index], band)
        return nullcontext()

    def _sum(self, gradient: Tensor, shown: ShownGaussians | None) -> Tensor:
        """The sum [N, 3] of every rank's gradient [N, 3], which is 0 but for the Gaussians that the view shows."""
        with self.loss.timer("communication"):
            if shown is None or not shown.sparse:
                return self.collectives.all_reduce(gradient)
            indices = shown.indices()
            return gradient.index_copy_(0, indices, self.collectives.all_reduce(gradient.index_select(0, indices)))

    def _shown_by(self, index: int, rasterizer: Rasterizer, rows: Tensor, band: Rows | None) -> ShownGaussians | None:
        """The Gaussians that any rank's part of a view shows; None where there is nobody to tell, or no room.

        Agreed upon at the first visit, from the blend weights of the gradients themselves: those of another
        rasterizer, or of the whole view in place of its bands, may differ by rounding at the least opacity.

        Args:
            rows: [h, w, 3], this rank's part of the image gradient, for its shape.
            band: the rows that it belongs to.
        """
        key, size = (index, rasterizer.scale), ShownGaussians.nbytes(len(self.scene))
        if self.collectives.size == 1 or not self._shown.holds(key, size):
            return None

        def look() -> ShownGaussians:
            mask = torch.zeros(len(self.scene), dtype=torch.bool, device=self.rasterizer.device)
            with self.loss.timer("prepare"):
                if len(rows):  # weights are never negative: their sum is 0 where all of them are
                    mask = rasterizer.color_gradient(torch.ones_like(rows), self.cameras[index], band)[:, 0] > 0
            with self.loss.timer("communication"):
                return ShownGaussians(self.collectives.union(mask))

        return self._shown.get(key, look, size)

    def _nothing(self, *shape: int) -> Tensor:
        """What a rank without rows has to add."""
        return torch.zeros(shape, dtype=self.rasterizer.dtype, device=self.rasterizer.device)

    def _own_band(self, index: int) -> Rows:
        return self._bands[index][self.collectives.rank]

    def content(self, index: int) -> Tensor:
        """Content image [H, W, 3]: the photo, on the GPU where there is one; or the render of the unstylized scene."""
        if self._ahead is not None:
            return self._ahead(index)
        if self._photos is not None:
            return self._photos(index)
        return self.render(index, self.colors(index, self._sh_dc), self._repeatable)

    def look_ahead(self, index: int, scales: Sequence[int]) -> None:
        """On a GPU, begin to read the photo of the view whose target is asked for next, if that will need it."""
        if self._ahead is not None and self._needs_content(index, scales):
            self._ahead.begin(index)

    def end_look_ahead(self) -> None:
        """Read nothing in advance any more, until `look_ahead`."""
        if self._ahead is not None:
            self._ahead.end()

    def _needs_content(self, index: int, scales: Sequence[int]) -> bool:
        """Whether the content of a view at some scales is not kept: its features, or the images that they are of."""
        if self._drawn:
            return bool(self.loss.content_weight) and any((index, scale) not in self._images for scale in scales)
        share = self._shares.get((index, tuple(scales)))  # what is kept was shared out before
        kept = share is not None and all((index, scale, share.pieces[scale]) in self._content for scale in scales)
        return bool(self.loss.content_weight) and not kept

    def coverage(self, index: int) -> list[Tensor]:
        """Coverage [H >> k, W >> k] of a view at powers of two, on the network's device; kept where memory allows."""
        return self._coverage.get(index, lambda: self._position_weights(index))

    def region_weights(self, index: int) -> list[list[Tensor]] | None:
        """The share of each region in a view, as `coverage`; None where the scene has none."""
        maps = self._maps
        return None if maps is None else self._region_weights.get(index, lambda: self._rendered_regions(index, maps))

    def put_behind(self, index: int, image: Tensor, color: Color, scale: int = 0) -> Tensor:
        """Image [h, w, 3] of a view, at a scale, with another color behind the Gaussians, on the network's device."""
        return put_behind(image.to(self.loss.network.device), self.coverage(index)[scale], color, self._background)

    def target(self, index: int, scales: Sequence[int], behind: Color | None = None) -> ViewTarget:
        """What the view is compared with at some scales; kept where memory allows.

        Features are computed only of scales that are asked for: phase 1 needs those of one.

        Args:
            behind: the color behind the Gaussians, which their content has too; None for the rasterizer's own. Its
                features are nobody else's: only the images that they are computed from are kept.
        """
        coverage = self.coverage(index) if self.weighted else None
        share = self._share(index, scales, coverage)
        target = ViewTarget(coverage=coverage, share=share, regions=self.region_weights(index))
        if self.loss.content_weight and behind is not None:
            for scale, content in self._content_images(index, scales).items():
                over = self._content_behind(index, content, behind, scale)
                target.content[scale] = self.loss.content_features(over, 0, share.tiles[scale])
        elif self.loss.content_weight:
            image = functools.cache(lambda: self.content(index))
            for scale in scales:
                pieces = share.pieces[scale]
                make = functools.partial(self._features, image, scale, share.tiles[scale])
                size = self.loss.content_bytes(pieces)
                target.content[scale] = self._content.get((index, scale, pieces), make, size)
        return target

    def _content_images(self, index: int, scales: Sequence[int]) -> dict[int, Tensor]:
        """The content of a view at some scales, [H >> s, W >> s, 3] on the network's device."""
        whole = functools.cache(lambda: self.content(index).to(self.loss.network.device))

        def scaled(scale: int) -> Tensor:
            return downscale(whole(), scale)

        return {scale: self._images.get((index, scale), functools.partial(scaled, scale)) for scale in scales}

    def _content_behind(self, index: int, image: Tensor, behind: Color, scale: int) -> Tensor:
        """The content of a view at a scale with another color behind the Gaussians.

        What a photo has where no Gaussian is gives way to the color.
        """
        if self._photos is None:
            return self.put_behind(index, image, behind, scale)
        coverage = self.coverage(index)[scale]
        return put_behind(image * coverage[..., None].to(image.dtype), coverage, behind, (0.0, 0.0, 0.0))

    def uncached_fraction(self) -> None:
        """Forget what belongs to the present division of the work, because another follows."""
        self._content.clear()
        self._shares.clear()

    def _share(self, index: int, scales: Sequence[int], coverage: list[Tensor] | None) -> Share:
        """How the work on some scales of a view is shared out: found once, because it takes looks at the coverage."""
        key = (index, tuple(scales))
        if key not in self._shares:
            camera = self.cameras[index]
            sizes = {scale: (camera.height >> scale, camera.width >> scale) for scale in scales}
            known = self._regions[index] if self._regions and self.loss.network.device.type != "cpu" else None
            self._shares[key] = self.loss.share(sizes, coverage, known)
        return self._shares[key]

    def _position_weights(self, index: int) -> list[Tensor]:
        band, camera = self._own_band(index), self.cameras[index]
        some = band[0] < band[1]
        rows = self._repeatable.coverage(camera, band) if some else self._nothing(0, camera.width)
        return self.loss.position_weights(self.collectives.all_gather_rows(rows, self._bands[index]))

    def _rendered_regions(self, index: int, maps: RegionMaps) -> list[list[Tensor]]:
        band, camera = self._own_band(index), self.cameras[index]
        some = band[0] < band[1]
        rows = maps.render(camera, band) if some else self._nothing(0, camera.width, maps.count)
        whole = self.collectives.all_gather_rows(rows, self._bands[index])
        return [self.loss.position_weights(weights) for weights in whole.unbind(2)]

    def _features(self, image: Callable[[], Tensor], scale: int, tiles: Sequence[PartitionTile]) -> ContentFeatures:
        return self.loss.content_features(image(), scale, tiles)


#: View, and scale of the rasterizer.
_ShownKey = tuple[int, int]
#: View and scale.
_ImageKey = tuple[int, int]
#: View, scale, and every rank's pieces of it.
_ContentKey = tuple[int, int, tuple[tuple[Piece, ...], ...]]


def _tensor_bytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


def _pyramid_bytes(pyramid: list[Tensor]) -> int:
    return sum(_tensor_bytes(level) for level in pyramid)
