"""Tests of the division of views among ranks, and of the sets of Gaussians that views show."""

import itertools
from collections.abc import Sequence

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgsst_core.features.partition import Rectangle
from sgsst_core.parallel import Piece, Shares, divide

HALO = 64


def view(height: int, width: int, scales: int) -> tuple[Piece, ...]:
    return tuple(Piece(s, (height >> s, width >> s), Rectangle(0, 0, height >> s, width >> s)) for s in range(scales))


def loads(division: Sequence[Sequence[Piece]], halo: int) -> list[int]:
    """Return the number of pixels that each rank passes through the network."""
    return [sum(piece.cost(halo) for piece in own) for own in division]


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(1, 700),
    width=st.integers(1, 700),
    scales=st.integers(1, 3),
    ranks=st.integers(1, 9),
)
def test_every_pixel_belongs_to_one_rank(height: int, width: int, scales: int, ranks: int) -> None:
    pieces = tuple(piece for piece in view(height, width, scales) if piece.region.pixels)
    shares = divide(pieces, HALO, ranks)
    assert len(shares) == ranks
    for piece in pieces:
        owners = torch.zeros(piece.size, dtype=torch.int64)
        for part in itertools.chain.from_iterable(shares):
            if part.scale == piece.scale:
                owners[part.region.slices] += 1
                assert part.region.top % 16 == part.region.left % 16 == 0
        assert bool((owners == 1).all())


@pytest.mark.parametrize(
    ("height", "width", "scales", "ranks", "least"),
    [(720, 1280, 2, 2, 1.8), (2048, 2048, 3, 2, 1.89), (3361, 5187, 4, 8, 7.0), (545, 980, 2, 4, 2.9)],
)
def test_loads_are_even_and_halos_small(height: int, width: int, scales: int, ranks: int, least: float) -> None:
    pieces = view(height, width, scales)
    shared = loads(divide(pieces, HALO, ranks), HALO)
    assert min(shared) > 0.9 * max(shared)
    assert loads(divide(pieces, HALO, 1), HALO)[0] / max(shared) > least


def test_coarse_scales_are_spread_over_the_ranks() -> None:
    """Each rank has one piece of a coarser scale at most, and needs little of the exchanged images."""
    size = 3361, 5187
    by_rank = divide(view(*size, 4), HALO, 8)
    exchanges = Shares.of(size, by_rank, HALO).exchanges(by_rank)
    assert max(map(len, by_rank)) == 2
    received = [0] * 8
    for exchange, rank, other in itertools.product(exchanges.values(), range(8), range(8)):
        if other != rank:
            received[rank] += exchange.parts[other].intersection(exchange.windows[rank]).pixels
    assert max(received) < 0.55 * (size[0] // 2) * (size[1] // 2)
