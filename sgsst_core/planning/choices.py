"""Choices that follow directly from the settings and a first measurement.

Later measurements depend on them, so the probe and `decide` share them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import memory_for
from sgsst_core.errors import SettingsError
from sgsst_core.loss.style_losses import has_statistics
from sgsst_core.planning.plan import Device
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import RasterizerName
from sgsst_core.settings import PlannedBackground, Precision, Settings

#: Minimum visits of a view for which caching its blend weights pays off on a CPU. Computing them takes as long as about
#: three renders with gradient, and each use saves two thirds of a render. On GPUs, both times are measured
#: (`RasterCost.least_visits`).
LEAST_VISITS = 5
#: Above this fraction of uncovered pixels, views are assumed to show an object without background. (Views of a room
#: that was captured from only some places have holes of a few percent.)
SCAN_SHARE = 0.2
#: Default training background for such an object (docs/quality.md).
SCAN_BACKGROUND: PlannedBackground = "palette"


def optimized_gaussians(survey: Survey, settings: Settings) -> Tensor:
    """Return the mask [N] bool of Gaussians whose colors are determined by the views.

    Raises:
        SettingsError: If pruning would leave none.
    """
    optimized = survey.total_blend_weights > settings.prune_weight
    if not optimized.any():
        raise SettingsError(
            f"--prune-weight {settings.prune_weight:g} would leave out every Gaussian: the largest total blend weight "
            f"is {float(survey.total_blend_weights.max()):.3g}. Give a smaller one."
        )
    return optimized


def is_scan(survey: Survey, *, weighted: bool) -> bool:
    """Return whether views show an object without background, and statistics are weighted by coverage (`weighted`)."""
    return weighted and survey.uncovered_share > SCAN_SHARE


def starts_warm(settings: Settings, *, scan: bool) -> bool:
    """Return whether the job starts with the style's colors.

    Optimization changes the overall color of a scene only slowly (docs/quality.md). If only luminance is stylized, a
    warm start pays off only for scans, because nothing around the object determines its brightness.
    """
    if settings.warm_start is None:
        return scan or settings.preserve_colors != "luminance"
    return settings.warm_start


def ends_with_transfer(settings: Settings, *, warm: bool) -> bool:
    """Return whether a job with a warm start transfers the style's colors once more after the last step.

    A loss without statistics lets colors drift from the style's during the steps; ARF (Zhang et al. 2022) transfers
    them twice too. With statistics, a second transfer would undo what the steps have achieved (docs/quality.md).
    """
    return warm and not has_statistics(settings.style_loss)


def training_background_of(settings: Settings, *, scan: bool) -> PlannedBackground:
    """Return the training background, the background of renders in optimization steps."""
    if settings.training_background == "auto":
        return SCAN_BACKGROUND if scan else "background"
    return settings.training_background


def rendered_gaussians(optimized: Tensor, settings: Settings) -> Tensor:
    """Return the mask [N] bool of Gaussians that are rendered: the optimized ones, or all if requested."""
    everything = "unseen" in settings.keep and not settings.prune_weight
    return torch.ones_like(optimized) if everything else optimized


def pruned_gaussians(survey: Survey, seen: Tensor) -> Tensor:
    """Return the mask [N] bool of pruned Gaussians: visible in a view, but excluded from rendering."""
    return ~seen & (survey.total_blend_weights > 0)


def precision_of(asked: Precision, ratio: float | None) -> Precision:
    """Return the precision of the network: the requested one if it is faster than float32, else float32.

    Processors without bfloat16 instructions compute it hundreds of times more slowly than float32.

    Args:
        asked: Requested precision.
        ratio: Ratio of a convolution's time in float32 to that in the requested precision; None if float32 was
            requested, or the requested one is unavailable.
    """
    return asked if ratio is not None and ratio > 1 else "float32"


#: GPU rasterizers in order of preference.
GPU_RASTERIZERS: tuple[RasterizerName, ...] = ("triton", "cuda")


def rasterizer_options(name: str, settings: Settings, memory: int) -> dict[str, Any]:
    """Return the constructor options, apart from the scene, of the rasterizer that computes blend weights.

    On the CPU, tile intersections and cached weights share one memory budget (`CachedRasterizer`). On a GPU, tile
    intersections have their own budget, half that of cached weights, taken from the memory reserved for buffers. They
    are small compared to GPU memory, and recomputing them costs a sort and a synchronization per view.

    Args:
        name: Name of the rasterizer.
        settings: Settings of the job.
        memory: Memory budget of the rank in bytes.
    """
    options: dict[str, Any] = {"background": settings.background, "near": settings.near}
    if name in ("cpu", "triton"):
        options["max_intersection_bytes"] = memory_for("rasterizer", memory) // (2 if name == "triton" else 1)
    return options


def uncached_rasterizer(device: Device, problems: Mapping[str, str]) -> RasterizerName:
    """Return the rasterizer that computes blend weights: on a GPU, the first of `GPU_RASTERIZERS` that works.

    Args:
        device: Device of the job.
        problems: Reason by name for each GPU rasterizer that does not work.
    """
    if device == "cuda":
        return next((name for name in GPU_RASTERIZERS if name not in problems), "cpu")
    return "cpu"
