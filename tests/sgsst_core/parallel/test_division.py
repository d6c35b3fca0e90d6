"""Tests of the division of work among ranks: complete, without overlap, and as even as multiples of 16 px allow."""

from __future__ import annotations

import itertools

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from sgsst_core.features.partition import Rectangle
from sgsst_core.parallel.division import Piece, divide, divide_rows, loads, rounds

HALO = 64


def view(height: int, width: int, scales: int) -> tuple[Piece, ...]:
    return tuple(Piece(s, (height >> s, width >> s), Rectangle(0, 0, height >> s, width >> s)) for s in range(scales))


@settings(max_examples=60, deadline=None)
@given(
    height=st.integers(1, 700),
    width=st.integers(1, 700),
    scales=st.integers(1, 3),
    speeds=st.lists(st.floats(0.2, 5.0), min_size=1, max_size=9),
)
def test_every_pixel_belongs_to_one_rank(height: int, width: int, scales: int, speeds: list[float]) -> None:
    pieces = tuple(piece for piece in view(height, width, scales) if piece.region.pixels)
    shares = divide(pieces, HALO, tuple(speeds))
    assert len(shares) == len(speeds)
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
    shared = loads(divide(pieces, HALO, (1.0,) * ranks), HALO)
    assert min(shared) > 0.9 * max(shared)
    assert loads(divide(pieces, HALO, (1.0,)), HALO)[0] / max(shared) > least


def test_faster_ranks_get_more_work() -> None:
    slow, fast = loads(divide(view(1024, 1024, 2), HALO, (1.0, 3.0)), HALO)
    assert fast / slow == pytest.approx(3.0, rel=0.05)


def test_ranks_without_work_have_no_pieces() -> None:
    shares = divide(view(15, 17, 1), HALO, (1.0,) * 4)
    assert sorted(map(len, shares)) == [0, 0, 0, 1]  # split in two, each half would be all halo
    nothing = (Piece(0, (480, 640), Rectangle(0, 0, 0, 0)),)
    assert sum(loads(divide(nothing, HALO, (1.0, 1.0)), HALO)) == 0


@settings(max_examples=100, deadline=None)
@given(height=st.integers(1, 500), count=st.integers(1, 40), data=st.data())
def test_bands_partition_all_rows(height: int, count: int, data: st.DataObject) -> None:
    top = data.draw(st.integers(0, height - 1))
    bottom = data.draw(st.integers(top + 1, height))
    bands = divide_rows(height, count, (top, bottom))
    assert len(bands) == count
    assert bands[0][0] == 0
    assert bands[-1][1] == height
    assert all(first[1] == second[0] and first[0] <= first[1] for first, second in itertools.pairwise(bands))
    assert all(start % 16 == 0 for start, _ in bands if start < height)


def test_covered_rows_are_divided_equally() -> None:
    assert divide_rows(480, 2, (320, 384)) == [(0, 352), (352, 480)]


def test_several_ranks_evaluate_all_scales_together() -> None:
    assert rounds([0, 1, 2], 1) == [[0], [1], [2]]
    assert rounds([0, 1, 2], 2) == [[0, 1, 2]]
