"""Comparison of two rasterizers that may decide differently at pixels very close to a cutoff.

A contribution is skipped below ALPHA_MIN, and a pixel ends at TRANSMITTANCE_MIN. If a value is within rounding error of
such a cutoff, one rasterizer may keep what the other skips: a jump of up to a few gray levels that is not an error.
These jumps are counted; everywhere else the tolerance applies.
"""

from __future__ import annotations

from torch import Tensor

#: Largest jump: a contribution just above ALPHA_MIN, or a Gaussian that crosses a transmittance of up to 1e-2, times a
#: color up to 2.
LARGEST_STEP = 2e-2


def assert_close_outside_band(
    actual: Tensor,  # [h, w, ...]
    expected: Tensor,  # [h, w, ...]
    band: Tensor,  # [h, w] bool, close to a cutoff
    *,
    tolerance: float,
    largest_share: float = 1e-3,
) -> int:
    """Assert equality within `tolerance` where `band` is False, and within LARGEST_STEP where it is True.

    Also asserts that at most `largest_share` of all pixels jump. Returns the number of those that do.
    """
    assert actual.shape == expected.shape, f"shapes {tuple(actual.shape)} and {tuple(expected.shape)}"
    difference = (actual.double() - expected.double()).abs()
    assert bool(difference.isfinite().all()), "a value is not finite"
    worst = difference.flatten(2).amax(-1) if difference.dim() > 2 else difference
    outside = worst[~band]
    assert outside.numel() == 0 or float(outside.max()) <= tolerance, (
        f"{int((outside > tolerance).sum())} pixels outside the band differ, by up to {float(outside.max()):.3g}"
    )
    flipped = worst > tolerance
    assert float(worst.max()) <= LARGEST_STEP, f"a flipped cut-off cannot explain a step of {float(worst.max()):.3g}"
    share = float(flipped.double().mean())
    assert share <= largest_share, f"{share:.2%} of the pixels flip, more than {largest_share:.2%}"
    return int(flipped.sum())


def relative_error(actual: Tensor, expected: Tensor) -> float:
    """Return |actual - expected| / |expected| in the Euclidean norm; 0 if both are 0."""
    difference = float((actual.double() - expected.double()).norm())
    return difference / float(expected.double().norm()) if difference else 0.0
