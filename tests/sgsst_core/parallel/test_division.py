"""Tests of the division of views among ranks, and of the sets of Gaussians that views show."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgsst_core.features.partition import Rectangle
from sgsst_core.parallel.collectives import DENSE_FRACTION, ShownGaussians, gaussians_sent
from sgsst_core.parallel.division import Piece, Shares, divide

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


def test_ranks_without_work_have_no_pieces() -> None:
    shares = divide(view(15, 17, 1), HALO, 4)
    assert sorted(map(len, shares)) == [0, 0, 0, 1]  # split in two, each half would be all halo
    nothing = (Piece(0, (480, 640), Rectangle(0, 0, 0, 0)),)
    assert sum(loads(divide(nothing, HALO, 2), HALO)) == 0


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(1, 700),
    width=st.integers(1, 700),
    finest=st.integers(0, 2),
    ranks=st.integers(1, 9),
)
def test_shares_contain_each_pixel_of_the_finest_scale_once(height: int, width: int, finest: int, ranks: int) -> None:
    pieces = tuple(piece for piece in view(height, width, 4) if piece.scale >= finest)
    by_rank = divide(pieces, HALO, ranks)
    shares = Shares.of((height, width), by_rank, HALO)
    owners = torch.zeros(height, width, dtype=torch.int64)
    for part, window, own in zip(shares.parts, shares.windows, by_rank, strict=True):
        owners[part.slices] += 1
        inside = torch.zeros(height, width, dtype=torch.bool)
        inside[window.slices] = True
        assert bool(inside[part.slices].all())
        for piece in own:
            if piece.scale == finest and piece.region.pixels:
                assert window.at_scale(finest) == piece.tile(HALO).outer
    complete = (height >> finest << finest, width >> finest << finest)
    assert bool((owners[: complete[0], : complete[1]] == 1).all())
    assert int(owners.sum()) == complete[0] * complete[1]


@settings(max_examples=60, deadline=None)
@given(height=st.integers(64, 700), width=st.integers(64, 700), scales=st.integers(2, 7), ranks=st.integers(1, 9))
def test_exchanged_windows_contain_the_pixels_of_coarser_pieces(
    height: int, width: int, scales: int, ranks: int
) -> None:
    by_rank = divide(tuple(piece for piece in view(height, width, scales) if piece.region.pixels), HALO, ranks)
    shares = Shares.of((height, width), by_rank, HALO)
    exchanges = shares.exchanges(by_rank, HALO)
    assert [*exchanges] == [*range(1, min(scales, 5))], "at larger scales, a pixel may belong to two parts"
    for scale, exchange in exchanges.items():
        for pieces, window in zip(by_rank, exchange.windows, strict=True):
            own = [piece for piece in pieces if shares.exchanged_scale(piece.scale) == scale and piece.scale > 0]
            assert bool(window.pixels) == any(piece.region.pixels for piece in own)
            for piece in own:
                further = piece.scale - scale
                outer, area = piece.tile(HALO).outer, window.at_scale(further)
                assert not piece.region.pixels or outer.intersection(area) == outer
                assert area.top << further == window.top
                assert area.left << further == window.left


def test_coarse_scales_are_spread_over_the_ranks() -> None:
    """Each rank has one piece of a coarser scale at most, and needs little of the exchanged images."""
    size = 3361, 5187
    by_rank = divide(view(*size, 4), HALO, 8)
    exchanges = Shares.of(size, by_rank, HALO).exchanges(by_rank, HALO)
    assert max(map(len, by_rank)) == 2
    received = [0] * 8
    for exchange, rank, other in itertools.product(exchanges.values(), range(8), range(8)):
        if other != rank:
            received[rank] += exchange.parts[other].intersection(exchange.windows[rank]).pixels
    assert max(received) < 0.55 * (size[0] // 2) * (size[1] // 2)


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("gaussians", [0, 1, 7, 8, 9, 1001])
def test_set_contains_the_gaussians_of_its_mask(gaussians: int, share: float) -> None:
    mask = torch.rand(gaussians, generator=torch.Generator().manual_seed(gaussians)) < share
    shown = ShownGaussians(mask)
    for indices in (shown.indices(), shown._device_indices()):
        assert torch.equal(indices, mask.nonzero()[:, 0])
    assert (shown.count, shown.total) == (int(mask.sum()), gaussians)
    assert shown._bits.nbytes == ShownGaussians.nbytes(gaussians)


def test_whole_gradient_is_sent_if_nearly_all_are_shown() -> None:
    assert gaussians_sent(300, 1000) == 300
    assert gaussians_sent(DENSE_FRACTION * 1000 + 1, 1000) == 1000
    assert gaussians_sent(2000, 1000) == 1000, "a survey counts pruned ones too"
    mask = torch.arange(1000) < 600
    assert ShownGaussians(mask).sparse
    assert not ShownGaussians(torch.roll(mask, 500) | mask).sparse
    assert not ShownGaussians(mask[:0]).sparse
