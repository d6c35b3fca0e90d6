"""A look at every view before the work: what each Gaussian contributes, and what of each view is covered.

One pass of the rasterizer a view (`Rasterizer.survey`); no feature network. Of several ranks, each looks at some of the
views.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.errors import CameraError
from sgsst_core.features.partition import Rectangle, covered_region
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.progress import ShowPlanning, progress_of
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Below this coverage nothing can be seen of a pixel's color in 8 bits.
SEEN_COVERAGE = 1 / 255


def sees_something(coverage: Tensor) -> bool:
    """Whether anything can be seen of a view's coverage [H, W]."""
    return float(coverage.amax()) > SEEN_COVERAGE


def nothing_seen(cameras: int) -> CameraError:
    """The error of so many cameras, none of which sees a Gaussian."""
    return CameraError(
        f"None of the {cameras} cameras sees a Gaussian. Check that cameras and scene belong together (same training "
        "run, same world), or let an orbit make the cameras."
    )


@dataclass(frozen=True)
class Survey:
    """What the views show.

    Attributes:
        total_blend_weights: [N] float64, sum of each Gaussian's blend weights over all pixels of all views.
        covered: indices of the views that see anything.
        regions: for each view, the rectangle that holds every covered pixel.
        uncovered_share: share of uncovered pixels in the views that see anything.
        shown: Gaussians that such a view shows, their mean; None in surveys that did not count them.
        uncovered: for each view, its share of uncovered pixels, 1 where nothing is seen; None in surveys that did not
            tell them apart.
    """

    total_blend_weights: Tensor
    covered: list[int]
    regions: list[Rectangle]
    uncovered_share: float
    shown: float | None = None
    uncovered: list[float] | None = None


@dataclass(frozen=True)
class _Look:
    """What one view shows."""

    region: Rectangle
    uncovered: float  # pixels
    pixels: int
    covered: bool
    shown: int  # Gaussians


def survey(
    scene: Scene,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    collectives: Collectives = ALONE,
    show: ShowPlanning | None = None,
) -> Survey:
    """Look at every view once; every rank gets the same survey.

    Args:
        show: told before the first view of this rank, and after each.

    Raises:
        CameraError: no camera sees a Gaussian.
    """
    weights = torch.zeros(len(scene), dtype=torch.float64)
    looks: dict[int, _Look] = {}
    own = range(collectives.rank, len(cameras), collectives.size)
    started = time.perf_counter()
    for done, index in enumerate(own):
        if show:
            show(progress_of(done, len(cameras), collectives.size, time.perf_counter() - started))
        looks[index] = _look(cameras[index], rasterizer, weights)
    if show:
        show(progress_of(len(own), len(cameras), collectives.size, time.perf_counter() - started))
    for part in collectives.all_gather(looks):
        looks |= part
    covered = [index for index in range(len(cameras)) if looks[index].covered]
    if not covered:
        raise nothing_seen(len(cameras))
    weights = collectives.all_reduce(weights.to(rasterizer.device)).cpu()
    uncovered_share = sum(looks[index].uncovered for index in covered) / sum(looks[index].pixels for index in covered)
    regions = [looks[index].region for index in range(len(cameras))]
    shown = sum(looks[index].shown for index in covered) / len(covered)
    ordered = [looks[index] for index in range(len(cameras))]
    uncovered = [look.uncovered / look.pixels if look.covered else 1.0 for look in ordered]
    return Survey(weights, covered, regions, uncovered_share, shown, uncovered)


def _look(camera: Camera, rasterizer: Rasterizer, weights: Tensor) -> _Look:
    """What a view shows; its blend weights are added to weights [N] float64."""
    coverage, summed = rasterizer.survey(camera)
    seen = sees_something(coverage)
    uncovered = float((1 - coverage).sum(dtype=torch.float64))
    shown = 0
    if seen:
        own = summed.cpu()
        weights += own.double()
        shown = int((own > 0).sum())
    return _Look(covered_region(coverage), uncovered, coverage.numel(), seen, shown)
