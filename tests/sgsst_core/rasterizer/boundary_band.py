"""Comparison of two rasterizers that tolerates different decisions at pixels very close to a cutoff.

Rasterizers skip contributions below ALPHA_MIN, and stop blending a pixel at TRANSMITTANCE_MIN. If a value is within
rounding error of such a cutoff, one rasterizer may keep a contribution that the other one skips. The difference of up
to a few gray levels is not an error, and such pixels are only counted. The tolerance applies to all other pixels.
"""

from __future__ import annotations

from torch import Tensor

#: Largest difference at a cutoff: a contribution just above ALPHA_MIN, or one of a Gaussian at a transmittance of up to
#: 1e-2, times a color of up to 2.
LARGEST_STEP = 2e-2


def assert_close_outside_band(
    actual: Tensor,  # [h, w, ...]
    expected: Tensor,  # [h, w, ...]
    band: Tensor,  # [h, w] bool, close to a cutoff
    *,
    tolerance: float,
    largest_share: float = 1e-3,
) -> int:
    """Assert equality within `tolerance` where `band` is False, and within `LARGEST_STEP` where it is True.

    Also assert that within the band, at most the fraction `largest_share` of all pixels exceeds the tolerance. Return
    the number of these pixels.
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
