"""Colors with the distribution of other colors: which one becomes which, by transport along one axis after another.

Along one axis the optimal transport is known: the smallest value becomes the smallest one wanted, the median the
median. Done along three axes that are at right angles, then along three others, and so on, the distributions come
together (Pitié, Kokaram and Dahyot, "Automated color grading using color distribution transfer", 2007). It is a map
of colors, so that equal ones stay equal, and nearly one into the wanted colors' hull, so that nothing is cut off:
a dark scene gets the bright style's dark strokes too, where its mean and spread alone would end in white.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from sgsst_core.compiled import kernel_threads
from sgsst_core.stylizing import color_transport_kernels

#: Sets of axes. The distance that is left falls to that of the samples within so many.
ROUNDS = 16
#: Colors of each side that distributions are taken from, at most, and values by which one axis is told (a power of 2).
_SAMPLES = 1 << 16
_KNOTS = 1 << 9
#: Values that are nearer to each other than this are one: a flat scene must not be pulled apart by its rounding.
_APART = 1e-6
#: What colors are brought to first: beyond it their order counts for nothing, and turning them would lose digits.
_FARTHEST = 10.0
#: Root of x^4 = x + 4, from which, with the square root of 2, turns spread evenly: Alexa, "Super-Fibonacci Spirals:
#: Fast, Low-Discrepancy Sampling of SO(3)", CVPR 2022.
_PSI = 1.533751168755204288118041

#: A transport along one axis: values, rising, and what they become, [k] each.
_Map = tuple[Tensor, Tensor]


def transported(colors: Tensor, weights: Tensor, wanted: Tensor) -> Tensor:
    """Colors with the distribution of others.

    Args:
        colors: [N, 3] float64, finite.
        weights: [N] float64, how much each counts; none negative, at least one positive.
        wanted: [M, 3] float64 in 0..1, at least one, each of which counts alike.

    Returns:
        [N, 3] float64.
    """
    begun = colors.clamp(-_FARTHEST, _FARTHEST)
    rounds = _rounds(begun[_drawn(weights)], wanted)
    return _through(begun, rounds) if begun.is_cuda else _through_compiled(begun, rounds)


def _rounds(source: Tensor, wanted: Tensor) -> list[tuple[Tensor, list[_Map]]]:
    """Axes [3, 3] of each round with the map along each of them, for samples [n, 3] of either side."""
    found: list[tuple[Tensor, list[_Map]]] = []
    for axes in _turns():
        axes = axes.to(source.device)
        along = zip((source @ axes).unbind(1), (wanted @ axes).unbind(1), strict=True)
        found.append((axes, [_along(values, others) for values, others in along]))
        source = _through(source, found[-1:])
    return found


def _through(colors: Tensor, rounds: Sequence[tuple[Tensor, list[_Map]]]) -> Tensor:
    """Colors [n, 3] after some rounds."""
    for axes, maps in rounds:
        along = zip((colors @ axes).unbind(1), maps, strict=True)
        colors = torch.stack([_mapped(values, *map_) for values, map_ in along], dim=1) @ axes.T
    return colors


def _through_compiled(colors: Tensor, rounds: Sequence[tuple[Tensor, list[_Map]]]) -> Tensor:
    """`_through` on CPUs, for many colors."""
    knots = torch.full((len(rounds), 3, _KNOTS), math.inf, dtype=torch.float64)
    targets = torch.empty_like(knots)
    for number, (_, maps) in enumerate(rounds):
        for axis, (places, become) in enumerate(maps):
            knots[number, axis, : len(places)] = places
            targets[number, axis] = become[-1]
            targets[number, axis, : len(become)] = become
    axes = torch.stack([axes.contiguous() for axes, _ in rounds])
    moved = colors.clone(memory_format=torch.contiguous_format)
    with kernel_threads():
        color_transport_kernels.through(*(part.numpy() for part in (moved, axes, knots, targets)))
    return moved


def _drawn(weights: Tensor) -> Tensor:
    """Places [_SAMPLES] of colors, each as often as it counts: at equal steps of the running sum."""
    running = weights.cumsum(0)
    steps = (torch.arange(_SAMPLES, dtype=running.dtype, device=running.device) + 0.5) * (running[-1] / _SAMPLES)
    return torch.searchsorted(running, steps).clamp_max(len(weights) - 1)


def _turns() -> Iterator[Tensor]:
    """Axes [3, 3] of each round, as columns: red, green and blue first, then evenly spread turns of these."""
    yield torch.eye(3, dtype=torch.float64)
    for number in range(ROUNDS - 1):
        part, angle = (number + 0.5) / (ROUNDS - 1), 2 * math.pi * (number + 0.5)
        first, second = angle / math.sqrt(2), angle / _PSI
        low, high = math.sqrt(part), math.sqrt(1 - part)
        yield _turn(low * math.sin(first), low * math.cos(first), high * math.sin(second), high * math.cos(second))


def _turn(w: float, x: float, y: float, z: float) -> Tensor:
    """The rotation [3, 3] of a unit quaternion."""
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.tensor(rows, dtype=torch.float64)


def _along(values: Tensor, wanted: Tensor) -> _Map:
    """The transport along one axis, from some values [n] to others [m]: knots, rising, and what they become.

    Values that are one become the mean of all that they would have to become.
    """
    knots, targets = _quantiles(values), _quantiles(wanted)
    apart = torch.diff(knots, prepend=knots[:1] - 1) > _APART
    group = apart.cumsum(0) - 1
    counts = torch.bincount(group).to(knots)
    sums = (torch.zeros_like(counts).index_add_(0, group, each) for each in (knots, targets))
    return next(sums) / counts, next(sums) / counts


def _quantiles(values: Tensor) -> Tensor:
    """Of values [n], [_KNOTS] from the least to the largest."""
    ordered = values.sort().values
    places = torch.linspace(0, len(ordered) - 1, _KNOTS, dtype=torch.float64, device=values.device)
    return ordered[places.round().long()]


def _mapped(values: Tensor, knots: Tensor, targets: Tensor) -> Tensor:
    """Values [n] through a piecewise linear map, whose ends hold beyond it."""
    if len(knots) == 1:
        return targets.expand(len(values))
    place = torch.searchsorted(knots, values.contiguous()).clamp(1, len(knots) - 1)
    low, high = knots[place - 1], knots[place]
    share = ((values - low) / (high - low)).clamp(0, 1)
    return torch.lerp(targets[place - 1], targets[place], share)
