"""Views of a job: colors, images, color gradients, and targets, prepared when a view first needs them."""

import functools
import hashlib
from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from sgsst_core import parallel
from sgsst_core.budget import Cache
from sgsst_core.devices import Timer
from sgsst_core.features.partition import Rectangle
from sgsst_core.files.images import Color
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import ContentFeatures, ViewTarget
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.regions import ContentMaps, RegionMaps
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors, view_colors_gradient
from sgsst_core.settings import PlannedBackground
from sgsst_core.style import Style


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
        self.cache: Cache[int, Tensor] = Cache(memory)

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
        memory: Memory budget in bytes for everything that is cached about views; a quarter of it is for colors.
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
        divider: parallel.Divider | None = None,
        timer: Timer | None = None,
    ) -> None:
        self.scene = scene
        self.cameras = list(cameras)
        self.rasterizer = rasterizer
        self.covered = covered
        self.clamp_aware_gradient = clamp_aware_gradient
        self.collectives: parallel.Collectives = divider.collectives if divider else parallel.ALONE
        self.timer = timer or Timer()
        self._divider = divider
        self._regions = regions
        self._shares: dict[int, parallel.Shares] = {}
        self.colors = ViewColors(scene, self.cameras, rasterizer.device, memory // 4)
        self._sh_dc = scene.sh_dc.to(rasterizer.device)

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
        return self.render(index, self.colors(index, self._sh_dc), self.rasterizer.uncached)

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
            exchange = parallel.ImageExchange(shares.parts, [everything] * self.collectives.size)
            self.collectives.gather_parts([exchange], [own], [image])
        return image

    def shares(self, index: int) -> parallel.Shares | None:
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
        with self.timer("communication"):
            gradient = self.collectives.all_reduce(gradient)
        # After the sum, because which colors pass the clamp depends on the sign of their total gradient.
        return view_colors_gradient(gradient, colors, clamp_aware_gradient=self.clamp_aware_gradient)

    def cache_weights(self, index: int) -> None:
        """Cache the blend weights of this rank's rectangle of a view, if the rasterizer supports it and they fit.

        Only steps do so: renders between steps happen at varying times, and must not affect the results of steps.
        """
        camera = self._own_camera(index)
        if camera is not None:
            self.rasterizer.cache_weights(camera)

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


#: Function that loads the content image [H, W, 3] of a view by its index, on the CPU.
PhotoLoader = Callable[[int], Tensor]


_BITS = 53  # bits of a float64's fraction


def drawn_color(kind: PlannedBackground, seed: int, step: int, view: int, style: Style) -> Color | None:
    """Return the training background of a view in one step; None for the background of the settings.

    A scan without background covers only part of each image, and features near its silhouette also see what is behind
    it. A constant color would become part of what the loss compares, and the object's colors would compensate for it.
    The color depends only on the arguments. There is no random state: repeated and resumed runs are bit-identical, and
    all ranks agree.

    Args:
        kind: "random" for a uniform color, "palette" for the color of a random style pixel.
        seed: Seed of the job, non-negative.
        style: Image [H, W, 3] in 0..1 on the CPU, or a mixture, from which an image is drawn with probability equal to
            its weight.
    """
    if kind == "background":
        return None
    # Three pseudorandom numbers in [0, 1), identical on every machine.
    digest = hashlib.blake2b(f"{seed},{step},{view}".encode(), digest_size=24).digest()
    red, green, blue = ((int.from_bytes(digest[at : at + 8], "big") >> 64 - _BITS) / 2**_BITS for at in (0, 8, 16))
    if kind == "palette":
        index, left = 0, green - style.weights[0]
        while left >= 0 and index + 1 < len(style.images):  # the sum of the weights may be rounded down
            index += 1
            left -= style.weights[index]
        pixels = style.images[index].reshape(-1, 3)
        red, green, blue = pixels[int(red * len(pixels))].tolist()
    return red, green, blue


def replace_background(image: Tensor, coverage: Tensor, color: Sequence[float], present: Sequence[float]) -> Tensor:
    """Replace the background color of an image [h, w, 3]: image + (1 - coverage) (color - present).

    Rendering is linear in the background, and so is the box average: for an image at a scale, use the coverage at that
    scale.

    Args:
        image: [h, w, 3], rendered over the color `present`.
        coverage: [h, w] in 0..1.
        color: [3], new background color.
        present: [3], present background color.
    """
    uncovered = (1 - coverage).to(image.dtype)
    # Scalars are passed as kernel arguments: no copy to the device, and no synchronization.
    channels = zip(image.unbind(-1), color, present, strict=True)
    return torch.stack([channel.add(uncovered, alpha=wanted - old) for channel, wanted, old in channels], dim=-1)


class ViewTargets:
    """Targets of a job's views.

    Preparing targets involves all ranks, so a view's targets must be cached on all ranks or on none. What is cached
    therefore depends only on sizes that are identical on all ranks.

    Args:
        views: Views; the content of a view is its unstylized render, unless there are photos.
        loss: Loss that prepares the targets, of the same ranks that render the views.
        weighted: Whether statistics are weighted by rendered coverage.
        photos: Function that loads the content image [H, W, 3] of a view by its index; None for unstylized renders.
        memory: Memory budget in bytes for everything that is cached about views. A quarter of it is for colors
            (`Views`), one for coverage, and one for region maps; content uses the rest. On a GPU, content also uses the
            quarter for coverage if there are no position weights.
        regions: Rectangle of each view that contains all covered pixels; None if unknown.
        background: Background color of the rasterizer.
        drawn: Whether the background color changes from step to step; content images are then cached instead of
            features.
        maps: Renderer of the region maps; None without regions.
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
        maps: RegionMaps | None = None,
        content_maps: ContentMaps | None = None,
    ) -> None:
        self.views = views
        self.loss = loss
        self.weighted = weighted
        self.photos = photos
        self._regions = regions
        self._background = background
        self._maps = maps
        self._content_maps = content_maps
        has_maps = maps is not None or content_maps is not None
        spares_coverage = loss.network.device.type != "cpu" and not weighted
        cached = int(memory * (0.5 - 0.25 * has_maps + 0.25 * spares_coverage))
        images = cached // 2 if drawn else 0
        self._coverage: Cache[int, list[Tensor]] = Cache(memory // 4, _pyramid_bytes)
        self._region_weights: Cache[tuple[int, bool], list[list[Tensor]]] = Cache(
            memory // 4 if has_maps else 0, lambda every: sum(map(_pyramid_bytes, every))
        )
        # Whole scaled views count, so that all ranks agree on what fits.
        self._images: Cache[_ContentKey, parallel.ScaledView] = Cache(
            images, lambda view: view.size[0] * view.size[1] * 3 * view.image.itemsize
        )
        self._content: Cache[_ContentKey, ContentFeatures] = Cache(cached - images)
        self._divisions: dict[tuple[int, tuple[int, ...]], parallel.Division] = {}

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
        # Every rank has the whole of a photo.
        whole = division if self.photos is None else replace(division, shares=None)
        images = functools.cache(
            lambda: parallel.ViewImages(
                self.content(index), whole, self._background, self.loss.collectives, self.loss.timer
            )
        )

        def features(scale: int) -> ContentFeatures:
            make, tiles = self.loss.targets.content_features, division.tiles[scale]
            key = index, scale, division.pieces[scale]
            if background is None:
                size = self.loss.targets.content_bytes(division.pieces[scale])
                return self._content.get(key, lambda: make(images().scaled(scale), tiles), size)
            content = self._images.get(key, lambda: images().scaled(scale))
            return make(self._content_over(index, content, background), tiles)

        if self.loss.content_weight:
            target.content.update({scale: features(scale) for scale in scales})
        return target

    def content(self, index: int) -> Tensor:
        """Return the content image on the network's device: the photo [H, W, 3], or `Views.unstylized`."""
        image = self.views.unstylized(index) if self.photos is None else self.photos(index)
        return image.to(self.loss.network.device)

    def coverage(self, index: int) -> list[Tensor]:
        """Return the coverage [H >> k, W >> k] of a view at powers of two, on the network's device.

        It is cached if it fits.
        """
        views, render = self.views, self.views.rasterizer.uncached.coverage
        return self._coverage.get(
            index, lambda: self.loss.targets.position_weights(views.whole(index, views.window(index, render)))
        )

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

    def forget_division(self) -> None:
        """Clear the caches that depend on the division of work, because it is about to change."""
        self._content.clear()
        self._images.clear()
        self._divisions.clear()
        self.views.forget_shares()

    def _content_over(self, index: int, content: parallel.ScaledView, color: Color) -> parallel.ScaledView:
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

    def _division(self, index: int, scales: Sequence[int], coverage: list[Tensor] | None) -> parallel.Division:
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
            else:
                on_gpu = self.loss.network.device.type != "cpu"
                self._divisions[key] = divider.divide(sizes, coverage, known if on_gpu else None)
        return self._divisions[key]

    def _rendered_maps(self, index: int, render: Callable[[Camera], Tensor], count: int) -> list[list[Tensor]]:
        whole = self.views.whole(index, self.views.window(index, render, count))
        return [self.loss.targets.position_weights(weights) for weights in whole.unbind(2)]


#: Index of the view, scale, and every rank's pieces of it.
_ContentKey = tuple[int, int, tuple[tuple[parallel.Piece, ...], ...]]


def _pyramid_bytes(pyramid: list[Tensor]) -> int:
    return sum(level.nbytes for level in pyramid)
