"""Styles of a job as its settings require, and the colors that follow from them before, during and after the steps.

`warm_start` gives the scene the style's colors before the first step, weighted by visibility in the views: it matches
the distribution of the style's colors (`transported`). `with_moments` matches only mean and covariance, by the linear
map that moves colors least (optimal transport between Gaussian distributions; Pitié and Kokaram, "The Linear
Monge-Kantorovitch Linear Color Mapping for Example-Based Color Transfer", 2007):

    A = S^-1/2 (S^1/2 T S^1/2)^1/2 S^-1/2,   c -> A (c - m) + m_style

where S and m are the scene's covariance and mean, and T the style's covariance. Colors outside 0..1, of the scene or
moved there by this map, are clipped. For a dark object and a bright style of two colors, only a pale gray would be
left, which is why `warm_start` does not use it.
"""

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy  # imports its modules at first use
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.errors import SettingsError
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import StyleTargets, combined
from sgsst_core.parallel import Size
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.regions import ContentMaps, RegionMaps, Regions
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.colors import (
    ColorSubspace,
    luminance,
    on_screen,
    on_screen_by_luminance,
    style_size,
    with_chroma_of,
)
from sgsst_core.scene.gaussians import unit_rotations
from sgsst_core.settings import MAX_RESOLUTION, Settings
from sgsst_core.style import Moments, Style, color_moments, mixed_moments, some_pixels, square_root, style_moments

#: A direction counts as flat if the variance of the colors along it is less than this fraction of their largest
#: variance. It is not stretched to the style's spread, which would amplify rounding errors.
_FLAT = 1e-9
#: Number of rounds, each with its own axes; enough to reduce the remaining distance to that between samples.
ROUNDS = 16
#: Maximum number of colors sampled from each distribution, and number of knots per axis.
_SAMPLES = 1 << 16
_KNOTS = 1 << 9
#: Number of colors that are moved together, so few that intermediate results stay in the processor's cache, and that
#: matrix products start no threads of their own.
_TOGETHER = 1 << 13
#: Values closer to each other than this count as equal: a flat scene must not be stretched by its rounding errors.
_APART = 1e-6
#: Colors are first clamped to this magnitude. Beyond it their order is irrelevant, and rotating them would lose digits.
_FARTHEST = 10.0
#: Root of x^4 = x + 4. Together with the square root of 2, it generates evenly distributed rotations: Alexa,
#: "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
_PSI = 1.533751168755204288118041
#: Transport along one axis: values in ascending order and their targets, [k] each.
_Map = tuple[NDArray[np.float64], NDArray[np.float64]]


def warm_start(sh_dc: Tensor, weights: Tensor, style: Style) -> Tensor:
    """Return DC coefficients with the distribution of the style's colors, all of them displayable (0..1).

    Args:
        sh_dc: [N, 3] float32.
        weights: [N] float64, total blend weights, at least one positive.
        style: Style, in whose proportions colors then occur.

    Returns:
        [N, 3] float32.
    """
    colors = COLOR_OFFSET + SH_C0 * sh_dc.double()
    wanted = some_pixels(style).to(colors)
    moved = transported(colors, weights.double() / weights.double().amax(), wanted)
    return on_screen(((moved.clamp(0, 1) - COLOR_OFFSET) / SH_C0).to(sh_dc.dtype))


def with_moments(sh_dc: Tensor, weights: Tensor, style: Style) -> Tensor:
    """Return DC coefficients with the style's mean and covariance, clipped to 0..1; arguments as in `warm_start`."""
    colors = (COLOR_OFFSET + SH_C0 * sh_dc.double()).clamp(0, 1)
    mean, covariance = color_moments(colors, weights.double() / weights.double().amax())
    wanted_mean, wanted = style_moments(style)
    matched = (colors - mean) @ _monge_map(covariance, wanted.to(mean)).T + wanted_mean.to(mean)
    return on_screen(((matched.clamp(0, 1) - COLOR_OFFSET) / SH_C0).to(sh_dc.dtype))


def in_colors_of(style: Style, sh_dc: Tensor, weights: Tensor) -> Style:
    """Match the mean and covariance of a style's colors to those of a scene, the inverse of `with_moments`.

    Several images are mapped together, by the moments of their mixture. Arguments are as in `warm_start`.
    """
    colors = (COLOR_OFFSET + SH_C0 * sh_dc.double()).clamp(0, 1)
    wanted_mean, wanted = color_moments(colors, weights.double() / weights.double().amax())
    mean, covariance = style_moments(style)
    rotated = _monge_map(covariance, wanted.to(mean)).T

    def match(image: Tensor) -> Tensor:
        matched = (image.reshape(-1, 3).double() - mean) @ rotated + wanted_mean.to(mean)
        return matched.clamp(0, 1).to(image.dtype).reshape(image.shape)

    return style.map(match)


def luminance_start(sh_dc: Tensor, weights: Tensor, style: Style) -> Tensor:
    """Return DC coefficients with the style's mean and spread of luminance, clamped to 0..1, and their own chroma.

    Arguments are as in `warm_start`.

    Returns:
        [N, 3] float32.
    """
    colors = COLOR_OFFSET + SH_C0 * sh_dc.double()
    own, shown = luminance(colors), luminance(colors.clamp(0, 1))
    matched = _matched(shown, color_moments(shown[:, None], weights), _style_luminance(style))
    return (sh_dc.double() + ((matched - own) / SH_C0)[:, None]).to(sh_dc.dtype)


def in_luminance_of(style: Style, sh_dc: Tensor, weights: Tensor) -> Style:
    """Convert a style to gray, and match the mean and deviation of its luminance to those of a scene.

    Several images are mapped together, by the moments of their mixture. Arguments are as in `warm_start`.
    """
    colors = (COLOR_OFFSET + SH_C0 * sh_dc.double()).clamp(0, 1)
    own, wanted = _style_luminance(style), color_moments(luminance(colors)[:, None], weights)

    def match(image: Tensor) -> Tensor:
        matched = _matched(luminance(image.double()), own, wanted)
        return matched.to(image.dtype)[..., None].expand(image.shape).contiguous()

    return style.map(match)


def _style_luminance(style: Style) -> Moments:
    """Return mean [1] and variance [1, 1] of the luminance of a style's pixels."""
    luminances = [luminance(image.reshape(-1, 3).double()) for image in style.images]
    return mixed_moments([color_moments(values[:, None]) for values in luminances], style.weights)


def _matched(values: Tensor, own: Moments, wanted: Moments) -> Tensor:
    """Map values linearly to another mean and variance, clamped to 0..1; flat values are only shifted."""
    (mean, variance), (wanted_mean, wanted_variance) = own, (part.to(values) for part in wanted)
    flat = variance[0, 0] <= _FLAT * mean.square().clamp_min(torch.finfo(values.dtype).tiny)
    factor = torch.where(flat, 0.0, wanted_variance[0, 0] / torch.where(flat, 1.0, variance[0, 0])).sqrt()
    return ((values - mean) * factor + wanted_mean).clamp(0, 1)


def _monge_map(source: Tensor, target: Tensor) -> Tensor:
    """Return the symmetric A [3, 3] with A source A = target, in the directions in which the source varies."""
    values, vectors = torch.linalg.eigh(source)
    varies = values > _FLAT * values[-1].clamp_min(torch.finfo(values.dtype).tiny)
    roots = torch.where(varies, values, 0.0).sqrt()
    inverse = torch.where(varies, 1 / torch.where(varies, roots, 1.0), 0.0)
    root = vectors * roots @ vectors.T
    inverse_root = vectors * inverse @ vectors.T
    matrix: Tensor = inverse_root @ square_root(root @ target @ root) @ inverse_root
    return matrix


def transported(colors: Tensor, weights: Tensor, wanted: Tensor) -> Tensor:
    """Transform colors so that their distribution matches that of the `wanted` colors.

    Along a single axis the optimal transport is known: sorted values map to sorted target values. Repeating this for
    three perpendicular axes, then for three others, and so on, makes the distributions converge (Pitié, Kokaram and
    Dahyot, "Automated color grading using color distribution transfer", 2007). Equal colors stay equal. Results lie
    almost within the convex hull of the target colors, so hardly anything is clipped: a dark scene also gets the dark
    strokes of a bright style.

    Args:
        colors: [N, 3] float64, finite.
        weights: [N] float64, non-negative and at least one positive.
        wanted: [M, 3] float64 in 0..1, at least one, with equal weights.

    Returns:
        [N, 3] float64.
    """
    start = colors.clamp(-_FARTHEST, _FARTHEST)
    drawn, counts = _drawn(weights)
    rounds = _rounds(start[drawn], counts, wanted)
    with ThreadPoolExecutor(torch.get_num_threads()) as threads:  # NumPy interpolates on one core
        return torch.cat(list(threads.map(partial(_through, rounds=rounds), start.split(_TOGETHER))))


def _rounds(source: Tensor, counts: Tensor, wanted: Tensor) -> list[tuple[Tensor, list[_Map]]]:
    """Return the axes [3, 3] of each round and the maps along them.

    Args:
        source: [n, 3] samples of the colors.
        counts: [n] integer, how many times each of them was drawn.
        wanted: [m, 3] samples of the other distribution.
    """
    once = torch.ones_like(wanted[:, 0], dtype=counts.dtype)
    rounds: list[tuple[Tensor, list[_Map]]] = []
    for axes in _round_axes():
        along = zip((source @ axes).unbind(1), (wanted @ axes).unbind(1), strict=True)
        maps = [_along(_quantiles(values, counts), _quantiles(others, once)) for values, others in along]
        rounds.append((axes, maps))
        source = _through(source, rounds[-1:])
    return rounds


def _through(colors: Tensor, rounds: Sequence[tuple[Tensor, list[_Map]]]) -> Tensor:
    """Apply the maps of some rounds to colors [n, 3]; they are piecewise linear, and constant beyond their ends."""
    moved = colors.numpy()
    for axes, maps in rounds:
        rotation = axes.numpy()
        along = zip((moved @ rotation).T, maps, strict=True)
        moved = np.stack([np.interp(values, *map_) for values, map_ in along], axis=1) @ rotation.T
    return torch.from_numpy(moved)


def _drawn(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Sample _SAMPLES colors in proportion to their weights.

    Samples are taken at equal steps of the cumulative weights.

    Returns:
        Indices [n] of the different samples, and how many times [n] each was drawn: few for a small scene.
    """
    running = weights.cumsum(0)
    steps = (torch.arange(_SAMPLES, dtype=running.dtype) + 0.5) * (running[-1] / _SAMPLES)
    drawn = torch.searchsorted(running, steps).clamp_max(len(weights) - 1)
    indices, counts = torch.unique_consecutive(drawn, return_counts=True)
    return indices, counts


def _round_axes() -> Iterator[Tensor]:
    """Yield the axes [3, 3] of each round as columns: red, green and blue first, then evenly distributed rotations."""
    yield torch.eye(3, dtype=torch.float64)
    for number in range(ROUNDS - 1):
        part, angle = (number + 0.5) / (ROUNDS - 1), 2 * math.pi * (number + 0.5)
        first, second = angle / math.sqrt(2), angle / _PSI
        low, high = math.sqrt(part), math.sqrt(1 - part)
        quat = (low * math.sin(first), low * math.cos(first), high * math.sin(second), high * math.cos(second))
        yield unit_rotations(torch.tensor(quat, dtype=torch.float64))


def _along(knots: Tensor, targets: Tensor) -> _Map:
    """Return the transport along one axis that maps a distribution to another, given their quantiles [_KNOTS].

    Equal values map to the mean of all their targets.
    """
    apart = torch.diff(knots, prepend=knots[:1] - 1) > _APART
    group = apart.cumsum(0) - 1
    counts = torch.bincount(group).to(knots)
    sums = (torch.zeros_like(counts).index_add_(0, group, each) for each in (knots, targets))
    return (next(sums) / counts).numpy(), (next(sums) / counts).numpy()


def _quantiles(values: Tensor, counts: Tensor) -> Tensor:
    """Return [_KNOTS] quantiles of values [n] that each occur some number of times [n], from minimum to maximum."""
    ordered, order = values.sort()
    ends = counts[order].cumsum(0)
    positions = torch.linspace(0, int(ends[-1]) - 1, _KNOTS, dtype=torch.float64, device=values.device)
    return ordered[torch.searchsorted(ends, positions.round().long(), right=True)]


@dataclass(frozen=True)
class JobStyles:
    """Styles of a job, prepared as its settings require.

    Attributes:
        own: Default style; if one region contains everything that the views show, the style of that region.
        each: Style of each region in `Regions.active`; empty if views need no region maps.
        content_weights: [N], content weight of each Gaussian; None for that of the settings everywhere.
    """

    own: Style
    regions: Regions | None = None
    each: tuple[Style, ...] = ()
    content_weights: Tensor | None = None

    @staticmethod
    def prepared(
        style: Style, regions: Regions | None, settings: Settings, sh_dc: Tensor, weights: Tensor
    ) -> "JobStyles":
        """Prepare styles as the settings require; see `prepared_style`.

        Args:
            regions: Result of `Regions.resolved`; None if there are no regions.
            sh_dc: [N, 3], colors of the scene. A region's style may be matched to the colors of the region's own
                Gaussians.
            weights: [N] float64, total blend weights.
        """
        if regions is None:
            return JobStyles(prepared_style(style, settings, sh_dc, weights))
        content_weights, labels = regions.content_weights(settings.content_weight), regions.style_labels
        by_region = [regions.every[index].style or style for index in regions.active]
        if not regions.mapped:
            own = prepared_style(by_region[0], settings, sh_dc, weights)
            return JobStyles(own, regions, content_weights=content_weights)
        each = [
            prepared_style(own, settings, sh_dc, torch.where(labels == index, weights, 0.0))
            for index, own in zip(regions.active, by_region, strict=True)
        ]
        rest = each[regions.active.index(0)] if 0 in regions.active else prepared_style(style, settings, sh_dc, weights)
        return JobStyles(rest, regions, tuple(each), content_weights=content_weights)

    @property
    def content_weight(self) -> float | None:
        """Largest content weight of a Gaussian; None for that of the settings."""
        return None if self.content_weights is None else float(self.content_weights.max())

    @property
    def all(self) -> list[Style]:
        """All distinct styles in use."""
        return [*{id(style): style for style in self.each or (self.own,)}.values()]

    def cached_targets(self, loss: SosLoss) -> Callable[[Camera], StyleTargets]:
        """Return a function that returns the targets for views of a camera's size, computed at first use.

        The images are copied to the network's device at once, so that no step waits for that.
        """
        own, *each = (style.map(lambda image: image.to(loss.network.device)) for style in (self.own, *self.each))
        targets = functools.cache(functools.partial(replace(self, own=own, each=tuple(each)).targets, loss))
        return lambda camera: targets((camera.height, camera.width))

    def targets(self, loss: SosLoss, view_size: Size) -> StyleTargets:
        """Compute the targets for views of a size (height, width); see `TargetBuilder.of_style`."""
        if not self.each:
            return loss.targets.of_style(self.own, view_size)
        assert self.regions is not None
        weights = [self.regions.every[index].weight for index in self.regions.active]
        return combined([loss.targets.of_style(style, view_size) for style in self.each], weights)

    def transferred(self, sh_dc: Tensor, weights: Tensor, rows: Tensor, *, preserve_chroma: bool = False) -> Tensor:
        """Transfer to each Gaussian the colors of its region's style; see `warm_start`.

        Args:
            sh_dc: [n, 3], colors of some of the scene's Gaussians.
            weights: [n] float64, total blend weights.
            rows: [N] bool, mask of these Gaussians.
            preserve_chroma: Whether to change luminance only.

        Returns:
            [n, 3].
        """
        transfer = luminance_start if preserve_chroma else warm_start
        if not self.each:
            return transfer(sh_dc, weights, self.own)
        assert self.regions is not None
        result, labels = sh_dc.clone(), self.regions.style_labels[rows]
        for index, style in zip(self.regions.active, self.each, strict=True):
            own = labels == index
            if bool((weights[own] > 0).any()):
                result[own] = transfer(sh_dc[own], weights[own], style)
        return result

    def maps(self, rasterizer: Rasterizer, rows: Tensor | None = None) -> RegionMaps | None:
        """Return the renderer of the maps of regions; None if the views need none.

        Args:
            rows: [N] bool, Gaussians that the rasterizer contains; None for all.
        """
        if not self.each:
            return None
        assert self.regions is not None
        labels = self.regions.style_labels if rows is None else self.regions.style_labels[rows]
        return RegionMaps(labels, self.regions.active, rasterizer)

    def content_maps(self, rasterizer: Rasterizer, rows: Tensor | None = None) -> ContentMaps | None:
        """Return the renderer of content weights; None if they are the same everywhere. See `maps` for arguments."""
        if not self.content_weight or self.content_weights is None:
            return None
        return ContentMaps(self.content_weights if rows is None else self.content_weights[rows], rasterizer)


def prepared_style(style: Style, settings: Settings, sh_dc: Tensor, weights: Tensor) -> Style:
    """Prepare a style as the settings require. If they require nothing, return the style itself.

    Args:
        style: Images [H, W, 3] in 0..1.
        sh_dc: [N, 3], colors of the scene.
        weights: [N] float64, total blend weights, at least one positive.
    """
    if settings.style_rotation:
        style = style.map(lambda image: rotated(image, settings.style_rotation))
    if settings.preserve_colors == "match":
        # Gatys, Ecker, Bethge, Hertzmann, Shechtman, "Controlling Perceptual Factors in Neural Style Transfer", CVPR
        # 2017, section 5.2.
        style = in_colors_of(style, sh_dc, weights)
    elif settings.preserve_colors == "luminance":
        style = in_luminance_of(style, sh_dc, weights)  # section 5.1 of the same paper
    return style


def check_style_size(style: Style, cameras: Sequence[Camera], scale: float) -> None:
    """Check that no view requires a style image with a longer side of more than `MAX_RESOLUTION` pixels.

    Raises:
        SettingsError: If an image would be larger.
    """
    if scale <= 1:
        return
    sizes = {(camera.height, camera.width) for camera in cameras}
    for size, image in itertools.product(sizes, style.images):
        height, width = style_size((image.shape[0], image.shape[1]), size, scale)
        if max(height, width) > MAX_RESOLUTION:
            raise SettingsError(
                f"--style-scale {scale:g} would make the style image {width:,} x {height:,} pixels for views of "
                f"{size[1]} x {size[0]}. Its longer side must be at most {MAX_RESOLUTION:,}. Use a smaller scale."
            )


def rotated(style: Tensor, degrees: float) -> Tensor:
    """Rotate an image [H, W, 3] counterclockwise, and crop it to the largest upright rectangle inside.

    Quarter turns are exact. Other angles are interpolated (cubic splines) and clamped to 0..1.
    """
    quarters, rest = divmod(degrees, 90)
    style = torch.rot90(style, int(quarters) % 4, (0, 1)).contiguous()
    if not rest:
        return style
    height, width = style.shape[:2]
    spun = scipy.ndimage.rotate(style.double().numpy(), rest, axes=(1, 0), reshape=True, order=3, mode="nearest")
    inner_height, inner_width = _inside(height, width, math.radians(rest))
    top, left = (spun.shape[0] - inner_height) // 2, (spun.shape[1] - inner_width) // 2
    cropped = spun[top : top + inner_height, left : left + inner_width]
    return torch.from_numpy(cropped).clamp(0, 1).to(style.dtype).contiguous()


def _inside(height: int, width: int, angle: float) -> tuple[int, int]:
    """Return the sides of the largest upright rectangle inside one that is rotated by 0 to pi/2; at least 1.

    If the rotated rectangle is narrow, two corners of the result lie on one of its long sides, and half of its short
    side is the limit. Otherwise, each corner of the result lies on a different side.
    """
    sine, cosine = math.sin(angle), math.cos(angle)
    shorter, longer = min(height, width), max(height, width)
    if shorter <= 2 * sine * cosine * longer:
        half = shorter / 2
        across, down = (half / sine, half / cosine) if width >= height else (half / cosine, half / sine)
    else:
        spread = cosine * cosine - sine * sine
        across, down = (width * cosine - height * sine) / spread, (height * cosine - width * sine) / spread
    # One pixel less on each side, where the interpolation reads beyond the image.
    return max(int(down) - 2, 1), max(int(across) - 2, 1)


def constrained(
    colors: Tensor, chroma_of: Tensor | None, subspace: ColorSubspace | None = None, *, bounded: bool
) -> Tensor:
    """Project DC coefficients [n, 3] to their constraints, without accumulating rounding errors in their chroma.

    Args:
        colors: [n, 3].
        chroma_of: [n, 3], colors whose chroma is preserved; None if chroma may change.
        subspace: Color subspace that colors are projected to; they leave it where it leaves the range. None for any
            color.
        bounded: Whether colors must be in 0..1.
    """
    colors = colors if subspace is None else subspace.projected(colors)
    if chroma_of is None:
        return on_screen(colors) if bounded else colors
    return with_chroma_of(on_screen_by_luminance(colors) if bounded else colors, chroma_of)


#: Number of seen neighbors that determine the color change of an unseen Gaussian.
NEIGHBORS = 8
#: Number of unseen Gaussians processed at a time; their neighbors' changes and weights take some tens of megabytes.
_CHUNK = 1 << 16
#: Cells along each axis of the grid that orders the searches.
_CELLS = 128


def neighbors_change(means: Tensor, change: Tensor, weights: Tensor) -> Tensor:
    """Return color changes for the Gaussians that no view sees.

    Each takes the mean change of its nearest seen neighbors, weighted by their total blend weights: the change of a
    hardly visible Gaussian is determined by only a few pixels.

    Args:
        means: [N, 3].
        change: [N, 3], change by the optimization; rows of unseen Gaussians are ignored.
        weights: [N] float64, total blend weights: 0 for the U unseen Gaussians, positive for at least one other.

    Returns:
        [U, 3] float32.
    """
    seen = weights > 0
    if bool(seen.all()):
        return torch.zeros((0, 3))
    count = min(NEIGHBORS, int(seen.sum()))
    tree = scipy.spatial.cKDTree(means[seen].double().numpy())
    weights, change, positions = weights[seen], change[seen], means[~seen].double()
    votes = torch.empty((len(positions), 3))
    # Ordered by the cells of a coarse grid: consecutive searches then read the same part of the tree.
    lowest = positions.amin(dim=0)
    size = (positions.amax(dim=0) - lowest).clamp_min(1e-300)
    x, y, z = ((positions - lowest) / size * (_CELLS - 1)).long().unbind(1)
    for part in torch.argsort((x * _CELLS + y) * _CELLS + z, stable=True).split(_CHUNK):
        _, indices = tree.query(positions[part].numpy(), k=count, workers=torch.get_num_threads())
        nearest = torch.as_tensor(indices).reshape(-1, count)
        own = weights[nearest]
        fraction = own / own.amax(dim=1, keepdim=True)  # so that tiny weights do not underflow
        sums = (change[nearest].double() * fraction[:, :, None]).sum(dim=1)
        votes[part] = (sums / fraction.sum(dim=1, keepdim=True)).float()
    return votes
