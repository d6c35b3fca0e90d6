"""Survey of all views before the job: blend weights per Gaussian, and covered pixels per view.

It takes one pass of the rasterizer per view (`Rasterizer.survey`) and does not use the feature network. Views are
distributed among ranks.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.features.partition import Rectangle, covered_region
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.shown import nothing_seen
from sgsst_core.progress import Progress
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Below this coverage, the color of a pixel is invisible in 8 bits.
SEEN_COVERAGE = 1 / 255


#: Callback for the progress of the stages before the steps.
ShowPlanning = Callable[[Progress], None]


def progress_of(surveyed: int, total: int, ranks: int, seconds: float, stage: str = "planning") -> Progress:
    """Return the progress of all ranks, assuming that they are as fast as this one.

    Args:
        surveyed: Number of views that this rank has surveyed.
        total: Number of views that all ranks survey.
        ranks: Number of ranks.
        seconds: Seconds since the stage started.
        stage: Stage in which the views are surveyed.
    """
    done = min(total, surveyed * ranks)
    return Progress(stage=stage, step=done, total=total, eta_s=seconds * (total - done) / done if done else None)


def sees_something(coverage: Tensor) -> bool:
    """Return whether anything is visible in a view, given its coverage [H, W]."""
    return float(coverage.amax()) > SEEN_COVERAGE


@dataclass(frozen=True)
class Survey:
    """Result of surveying the views.

    Attributes:
        total_blend_weights: [N] float64, blend weights of each Gaussian summed over all pixels of all views.
        covered: Indices of the views that see anything.
        regions: Rectangle of each view that contains all covered pixels.
        uncovered_fraction: Fraction of uncovered pixels in the views that see anything.
        shown: Mean number of Gaussians visible in such a view; None if it was not counted.
        uncovered: Fraction of uncovered pixels of each view, 1 if nothing is seen; None if not recorded per view.
    """

    total_blend_weights: Tensor
    covered: list[int]
    regions: list[Rectangle]
    uncovered_fraction: float
    shown: float | None = None
    uncovered: list[float] | None = None


@dataclass(frozen=True)
class _ViewSurvey:
    """Survey of one view."""

    region: Rectangle
    uncovered: float  # pixels
    pixels: int
    covered: bool
    shown: int  # Gaussians


def survey_views(
    scene: Scene,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    collectives: Collectives = ALONE,
    show: ShowPlanning | None = None,
) -> Survey:
    """Survey every view once; all ranks get the same result.

    Args:
        scene: Scene with N Gaussians.
        cameras: Cameras of the views.
        rasterizer: Rasterizer of the scene.
        collectives: Ranks that share the work.
        show: Callback, called before the first view of this rank and after each view.

    Raises:
        CameraError: If no camera sees a Gaussian.
    """
    weights = torch.zeros(len(scene), dtype=torch.float64, device=rasterizer.device)
    views: dict[int, _ViewSurvey] = {}
    indices = range(collectives.rank, len(cameras), collectives.size)
    started = time.perf_counter()
    for done, index in enumerate(indices):
        if show:
            show(progress_of(done, len(cameras), collectives.size, time.perf_counter() - started))
        views[index] = _survey_view(cameras[index], rasterizer, weights)
    if show:
        show(progress_of(len(indices), len(cameras), collectives.size, time.perf_counter() - started))
    for others in collectives.all_gather(views):
        views |= others
    covered = [index for index in range(len(cameras)) if views[index].covered]
    if not covered:
        raise nothing_seen(scene.means, cameras, rasterizer.near)
    weights = collectives.all_reduce(weights).cpu()
    uncovered_fraction = sum(views[index].uncovered for index in covered) / sum(
        views[index].pixels for index in covered
    )
    regions = [views[index].region for index in range(len(cameras))]
    shown = sum(views[index].shown for index in covered) / len(covered)
    ordered = [views[index] for index in range(len(cameras))]
    uncovered = [view.uncovered / view.pixels if view.covered else 1.0 for view in ordered]
    return Survey(weights, covered, regions, uncovered_fraction, shown, uncovered)


def _survey_view(camera: Camera, rasterizer: Rasterizer, weights: Tensor) -> _ViewSurvey:
    """Survey a view, and add its blend weights to weights [N] float64."""
    coverage, summed = rasterizer.survey(camera)
    seen = sees_something(coverage)
    uncovered = float((1 - coverage).sum(dtype=torch.float64))
    shown = 0
    if seen:
        weights += summed.double()
        shown = int((summed > 0).sum())
    return _ViewSurvey(covered_region(coverage), uncovered, coverage.numel(), seen, shown)
