"""Tests of clamping colors to the range of screens."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from sgsst_core.constants import SH_C0
from sgsst_core.scene.colors import LARGEST, on_screen, on_screen_by_luminance, with_chroma_of

COEFFICIENT = st.floats(-1e6, 1e6, width=32)
COLOR = st.tuples(COEFFICIENT, COEFFICIENT, COEFFICIENT)
HIGHEST = 0.5 / SH_C0
#: Rounding error of float32 coefficients below 2 in magnitude, twice.
ROUNDING = 2.0**-22


def colors(sh_dc: torch.Tensor) -> torch.Tensor:
    return 0.5 + SH_C0 * sh_dc.double()


def test_bound_is_the_largest_float32_within_range() -> None:
    bound = torch.tensor([LARGEST])
    beyond = torch.nextafter(bound, torch.tensor([torch.inf]))
    assert float(colors(bound)) <= 1
    assert float(colors(-bound)) >= 0
    assert float(colors(beyond)) > 1
    assert float(colors(-beyond)) < 0


@given(st.lists(COLOR, min_size=1, max_size=8))
def test_channels_are_clamped_separately(rows: list[tuple[float, float, float]]) -> None:
    sh_dc = torch.tensor(rows, dtype=torch.float32)
    result = on_screen(sh_dc)
    shown = colors(result)
    assert float(shown.min()) >= 0
    assert float(shown.max()) <= 1
    inside = ((colors(sh_dc) >= 0) & (colors(sh_dc) <= 1)).all(dim=1)
    assert torch.equal(result[inside], sh_dc[inside])
    assert torch.allclose(shown, colors(sh_dc).clamp(0, 1), atol=1e-7)


@given(st.lists(COLOR, min_size=1, max_size=8))
def test_gray_shift_is_as_small_as_possible(rows: list[tuple[float, float, float]]) -> None:
    sh_dc = torch.tensor(rows, dtype=torch.float32).double()
    result = on_screen_by_luminance(sh_dc)
    shift = result - sh_dc
    size = 1 + sh_dc.abs().amax(dim=1)
    assert float(((shift - shift.mean(dim=1, keepdim=True)).abs().amax(dim=1) / size).max()) < 1e-12
    fits = sh_dc.amax(dim=1) - sh_dc.amin(dim=1) <= 2 * LARGEST * (1 - 1e-6)
    for before, after, fit in zip(sh_dc, result, fits, strict=True):
        outside = max(float(-LARGEST - before.min()), float(before.max() - LARGEST), 0.0)
        if fit:
            assert float(after.abs().max()) <= HIGHEST
            assert float((after - before).abs().max()) <= outside + 1e-5
        else:  # as far beyond white as beyond black
            assert float(after.min() + after.max()) == pytest.approx(0, abs=1e-9 * float(before.abs().max()))


def test_gray_shift_preserves_chroma_in_float32() -> None:
    generator = torch.Generator().manual_seed(1)
    original = torch.rand((1000, 3), generator=generator) * 2 - 1
    moved = original + 6 * torch.randn((1000, 1), generator=generator)
    result = with_chroma_of(on_screen_by_luminance(moved), original)
    shown = colors(result)
    assert float(shown.min()) >= 0
    assert float(shown.max()) <= 1
    change = (result - original).double()
    assert float((change - change.mean(dim=1, keepdim=True)).abs().max()) < ROUNDING
