"""Transport of colors to the distribution of other colors, along one axis after another.

Along a single axis the optimal transport is known: sorted values map to sorted target values, so the minimum maps to
the minimum and the median to the median. Repeating this for three perpendicular axes, then for three others, and so on,
makes the distributions converge (Pitié, Kokaram and Dahyot, "Automated color grading using color distribution
transfer", 2007). The result is a function of color, so equal colors stay equal. Results lie almost within the convex
hull of the target colors, so hardly anything is clipped: a dark scene also gets the dark strokes of a bright style.
Matching only mean and spread would turn such a scene mostly white.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from sgsst_core.compiled import kernel_threads
from sgsst_core.scene.rotations import unit_rotations
from sgsst_core.stylizing import color_transport_kernels

#: Number of rounds, each with its own axes; enough to reduce the remaining distance to that between samples.
ROUNDS = 16
#: Maximum number of colors sampled from each distribution, and number of knots per axis (a power of 2).
_SAMPLES = 1 << 16
_KNOTS = 1 << 9
#: Values closer to each other than this count as equal: a flat scene must not be stretched by its rounding errors.
_APART = 1e-6
#: Colors are first clamped to this magnitude. Beyond it their order is irrelevant, and rotating them would lose digits.
_FARTHEST = 10.0
#: Root of x^4 = x + 4. Together with the square root of 2, it generates evenly distributed rotations: Alexa,
#: "Super-Fibonacci Spirals: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
_PSI = 1.533751168755204288118041

#: Transport along one axis: values in ascending order and their targets, [k] each.
_Map = tuple[Tensor, Tensor]


def transported(colors: Tensor, weights: Tensor, wanted: Tensor) -> Tensor:
    """Transform colors so that their distribution matches that of the `wanted` colors.

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
    return _through(start, rounds) if start.is_cuda else _through_compiled(start, rounds)


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


def _through_compiled(colors: Tensor, rounds: Sequence[tuple[Tensor, list[_Map]]]) -> Tensor:
    """Compute `_through` for many colors on the CPU."""
    knots = torch.full((len(rounds), 3, _KNOTS), math.inf, dtype=torch.float64)
    targets = torch.empty_like(knots)
    for number, (_, maps) in enumerate(rounds):
        for axis, (positions, become) in enumerate(maps):
            knots[number, axis, : len(positions)] = positions
            targets[number, axis] = become[-1]
            targets[number, axis, : len(become)] = become
    slopes = torch.zeros_like(knots)  # computed here, because Numba takes long to compile this line
    slopes[..., :-1] = targets.diff() / knots.diff()
    axes = torch.stack([axes.contiguous() for axes, _ in rounds])
    moved = colors.clone(memory_format=torch.contiguous_format)
    with kernel_threads():
        color_transport_kernels.through(*(part.numpy() for part in (moved, axes, knots, targets, slopes)))
    return moved


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
