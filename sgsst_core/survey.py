"""A look at every view before the work: what each Gaussian contributes, and what of each view is covered.

One forward and one backward pass of the rasterizer a view, with all colours 1; no feature network.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.camera import Camera
from sgsst_core.errors import CameraError
from sgsst_core.partition import Rectangle, covered_region
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene import Scene

#: Below this coverage nothing can be seen of a pixel's colour in 8 bits.
SEEN_COVERAGE = 1 / 255


@dataclass(frozen=True)
class Survey:
    """What the views show.

    Attributes:
        total_weights: [N] float64, sum of each Gaussian's blend weights over all pixels of all views.
        covered: indices of the views that see anything.
        regions: for each view, the rectangle that holds every covered pixel.
        uncovered_share: share of uncovered pixels in the views that see anything.
        seconds_per_view: of one render with its gradient, as the rasterizer that was used does it.
    """

    total_weights: Tensor
    covered: list[int]
    regions: list[Rectangle]
    uncovered_share: float
    seconds_per_view: float


def survey(scene: Scene, cameras: Sequence[Camera], rasterizer: Rasterizer) -> Survey:
    """Look at every view once.

    Raises:
        CameraError: no camera sees a Gaussian.
    """
    weights = torch.zeros(len(scene), dtype=torch.float64)
    covered: list[int] = []
    regions: list[Rectangle] = []
    uncovered, pixels = 0.0, 0
    started = time.perf_counter()
    for index, camera in enumerate(cameras):
        coverage = rasterizer.coverage(camera)
        regions.append(covered_region(coverage))
        if not float(coverage.amax()) > SEEN_COVERAGE:
            continue
        covered.append(index)
        uncovered += float((1 - coverage).sum(dtype=torch.float64))
        pixels += coverage.numel()
        ones = torch.ones((camera.height, camera.width, 3), device=coverage.device)
        weights += rasterizer.colour_gradient(ones, camera)[:, 0].cpu().double()
    if not covered:
        raise CameraError(
            f"None of the {len(cameras)} cameras sees a Gaussian. Check that cameras and scene belong "
            "together (same training run, same world), or let --orbit make cameras."
        )
    seconds = (time.perf_counter() - started) / len(cameras)
    return Survey(weights, covered, regions, uncovered / pixels, seconds)
