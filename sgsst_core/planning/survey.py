"""Survey of all views before the job: blend weights per Gaussian, and covered pixels per view.

It takes one pass of the rasterizer per view (`Rasterizer.survey`) and does not use the feature network. Views are
distributed among ranks.
"""

from __future__ import annotations

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


def progress_of(surveyed: int, total: int, ranks: int, stage: str = "planning") -> Progress:
    """Return the progress of all ranks, assuming that they are as fast as this one.

    Args:
        surveyed: Number of views that this rank has surveyed.
        total: Number of views that all ranks survey.
    """
    return Progress(stage=stage, step=min(total, surveyed * ranks), total=total)


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
        uncovered: Fraction of uncovered pixels of each view, 1 if nothing is seen; None if not recorded per view.
    """

    total_blend_weights: Tensor
    covered: list[int]
    regions: list[Rectangle]
    uncovered_fraction: float
    uncovered: list[float] | None = None


def survey_views(
    scene: Scene,
    cameras: Sequence[Camera],
    rasterizer: Rasterizer,
    collectives: Collectives = ALONE,
    show: ShowPlanning | None = None,
) -> Survey:
    """Survey every view once; all ranks get the same result.

    Args:
        show: Callback, called before the first view of this rank and after each view.

    Raises:
        CameraError: If no camera sees a Gaussian.
    """
    weights = torch.zeros(len(scene), dtype=torch.float64, device=rasterizer.device)
    views: dict[int, tuple[Rectangle, float, bool]] = {}  # region, uncovered pixels, whether anything is seen
    indices = range(collectives.rank, len(cameras), collectives.size)
    for done, index in enumerate([*indices, None]):
        if show:
            show(progress_of(done, len(cameras), collectives.size))
        if index is not None:
            coverage, summed = rasterizer.survey(cameras[index])
            uncovered, seen = float((1 - coverage).sum(dtype=torch.float64)), sees_something(coverage)
            views[index] = covered_region(coverage), uncovered, seen
            if seen:
                weights += summed.double()
    for others in collectives.all_gather(views):
        views |= others
    pixels = [camera.width * camera.height for camera in cameras]
    covered = [index for index in range(len(cameras)) if views[index][2]]
    if not covered:
        raise nothing_seen(scene.means, cameras, rasterizer.near)
    return Survey(
        collectives.all_reduce(weights).cpu(),
        covered,
        [views[index][0] for index in range(len(cameras))],
        sum(views[index][1] for index in covered) / sum(pixels[index] for index in covered),
        [views[index][1] / pixels[index] if views[index][2] else 1.0 for index in range(len(cameras))],
    )
