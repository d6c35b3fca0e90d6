"""3D filter of Mip-Splatting, which limits the detail of each Gaussian to what its training views could sample.

Trainers keep it beside the Gaussians (property `filter_3D`). A Gaussian is drawn convolved with a round Gaussian of
that deviation, at an opacity that keeps its integral.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray


def apply_filter(scales: NDArray[np.float32], opacities: NDArray[np.float32], deviations: NDArray[Any]) -> None:
    """Convolve Gaussians with their 3D filters, in place.

    Variances along the axes become s^2 + f^2, and the opacity is multiplied by the square root of the ratio of the
    determinants before and after. Both are computed from logarithms, so that nothing over- or underflows.

    Args:
        scales: [n, 3], log scales.
        opacities: [n], logits.
        deviations: [n], deviation f of each filter, in world units; 0 leaves the Gaussian unchanged.
    """
    before, logits = scales.astype(np.float64), opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # invalid values are reported later
        filters = 2 * np.log(np.abs(deviations.astype(np.float64)))
        after = np.logaddexp(2 * before, filters[:, None]) / 2
        ratio = (before - after).sum(axis=1)
        log_opacity = ratio - np.logaddexp(0, -logits)
        filtered = log_opacity - np.log(-np.expm1(log_opacity))
    scales[:] = after
    opacities[:] = np.where(ratio < 0, filtered, logits)
