"""Warm start: give the scene the style's colors before the first step, weighted by visibility in the views.

`warm_start` matches the distribution of the style's colors (`transported`). `with_moments` matches only mean
and covariance, by the linear map that moves colors least (optimal transport between Gaussian distributions; Pitié and
Kokaram, "The Linear Monge-Kantorovitch Linear Color Mapping for Example-Based Color Transfer", 2007):

    A = S^-1/2 (S^1/2 T S^1/2)^1/2 S^-1/2,   c -> A (c - m) + m_style

where S and m are the scene's covariance and mean, and T the style's covariance. Colors outside 0..1, of the scene or
moved there by this map, are clipped. For a dark object and a bright style of two colors, only a pale gray would be
left, which is why `warm_start` does not use it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from sgsst_core.constants import COLOR_OFFSET, SH_C0
from sgsst_core.scene.colors import luminance, on_screen
from sgsst_core.scene.gaussians import unit_rotations
from sgsst_core.style import Style, color_moments, mixed_moments, some_pixels, square_root, style_moments

#: A direction counts as flat if the variance of the colors along it is less than this fraction of their largest
#: variance. It is not stretched to the style's spread, which would amplify rounding errors.
_FLAT = 1e-9
#: Number of rounds, each with its own axes; enough to reduce the remaining distance to that between samples.
ROUNDS = 16
#: Maximum number of colors sampled from each distribution, and number of knots per axis.
_SAMPLES = 1 << 16
_KNOTS = 1 << 9
#: Number of colors that are moved together: their intermediate results stay in the processor's cache.
_TOGETHER = 1 << 16
#: Values closer to each other than this count as equal: a flat scene must not be stretched by its rounding errors.
_APART = 1e-6
#: Colors are first clamped to this magnitude. Beyond it their order is irrelevant, and rotating them would lose digits.
_FARTHEST = 10.0
#: Root of x^4 = x + 4. Together with the square root of 2, it generates evenly distributed rotations: Alexa,
#: "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
_PSI = 1.533751168755204288118041
#: Transport along one axis: values in ascending order and their targets, [k] each.
_Map = tuple[Tensor, Tensor]


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
    matched = _matched(shown, _luminance_moments(shown, weights.double()), _style_luminance(style))
    return (sh_dc.double() + ((matched - own) / SH_C0)[:, None]).to(sh_dc.dtype)


def in_luminance_of(style: Style, sh_dc: Tensor, weights: Tensor) -> Style:
    """Convert a style to gray, and match the mean and deviation of its luminance to those of a scene.

    Several images are mapped together, by the moments of their mixture. Arguments are as in `warm_start`.
    """
    wanted = _luminance_moments(luminance((COLOR_OFFSET + SH_C0 * sh_dc.double()).clamp(0, 1)), weights.double())
    own = _style_luminance(style)

    def match(image: Tensor) -> Tensor:
        matched = _matched(luminance(image.double()), own, wanted)
        return matched.to(image.dtype)[..., None].expand(image.shape).contiguous()

    return style.map(match)


def _style_luminance(style: Style) -> tuple[Tensor, Tensor]:
    """Return mean and deviation of the luminance of a style's pixels."""
    luminances = [luminance(image.reshape(-1, 3).double()) for image in style.images]
    parts = [_luminance_moments(values, torch.ones_like(values)) for values in luminances]
    if len(parts) == 1:
        return parts[0]
    moments = [(mean[None], spread.square()[None, None]) for mean, spread in parts]
    mean, variance = mixed_moments(moments, style.weights)
    return mean[0], variance[0, 0].sqrt()


def _luminance_moments(values: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted mean and deviation of values [n]."""
    fraction = weights / weights.amax()
    fraction = fraction / fraction.sum()
    mean = (fraction * values).sum()
    return mean, (fraction * (values - mean).square()).sum().sqrt()


def _matched(values: Tensor, own: tuple[Tensor, Tensor], wanted: tuple[Tensor, Tensor]) -> Tensor:
    """Map values linearly to another mean and deviation, clamped to 0..1; flat values are only shifted."""
    (mean, deviation), (wanted_mean, wanted_deviation) = own, (part.to(values) for part in wanted)
    flat = deviation <= _FLAT**0.5 * mean.abs().clamp_min(torch.finfo(values.dtype).tiny)
    factor = torch.where(flat, 0.0, wanted_deviation / torch.where(flat, 1.0, deviation))
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
    return torch.cat([_through(part, rounds) for part in start.split(_TOGETHER)])


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
        axes = axes.to(source.device)
        along = zip((source @ axes).unbind(1), (wanted @ axes).unbind(1), strict=True)
        maps = [_along(_quantiles(values, counts), _quantiles(others, once)) for values, others in along]
        rounds.append((axes, maps))
        source = _through(source, rounds[-1:])
    return rounds


def _through(colors: Tensor, rounds: Sequence[tuple[Tensor, list[_Map]]]) -> Tensor:
    """Apply the maps of some rounds to colors [n, 3]."""
    for axes, maps in rounds:
        along = zip((colors @ axes).unbind(1), maps, strict=True)
        colors = torch.stack([_mapped(values, *map_) for values, map_ in along], dim=1) @ axes.T
    return colors


def _drawn(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Sample _SAMPLES colors in proportion to their weights.

    Samples are taken at equal steps of the cumulative weights.

    Returns:
        Indices [n] of the different samples, and how many times [n] each was drawn: few for a small scene.
    """
    running = weights.cumsum(0)
    steps = (torch.arange(_SAMPLES, dtype=running.dtype, device=running.device) + 0.5) * (running[-1] / _SAMPLES)
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
    return next(sums) / counts, next(sums) / counts


def _quantiles(values: Tensor, counts: Tensor) -> Tensor:
    """Return [_KNOTS] quantiles of values [n] that each occur some number of times [n], from minimum to maximum."""
    ordered, order = values.sort()
    ends = counts[order].cumsum(0)
    positions = torch.linspace(0, int(ends[-1]) - 1, _KNOTS, dtype=torch.float64, device=values.device)
    return ordered[torch.searchsorted(ends, positions.round().long(), right=True)]


def _mapped(values: Tensor, knots: Tensor, targets: Tensor) -> Tensor:
    """Map values [n] by a piecewise linear function that is constant beyond its ends."""
    if len(knots) == 1:
        return targets.expand(len(values))
    index = torch.searchsorted(knots, values.contiguous()).clamp(1, len(knots) - 1)
    low, high = knots[index - 1], knots[index]
    fraction = ((values - low) / (high - low)).clamp(0, 1)
    return torch.lerp(targets[index - 1], targets[index], fraction)
