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

#: On the CPU, computing a view's cached weights takes about three renders with gradient, and each use saves two thirds
#: of one, so they do not pay off for fewer visits. On GPUs both are measured (`RasterCost.least_visits`).
LEAST_VISITS = 5
#: Above this fraction of uncovered pixels, views show an object without background. (Views of a room that was captured
#: from only some places have holes of a few percent.)
SCAN_SHARE = 0.2
#: Default background of such an object in a step (docs/quality.md).
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
    """Return whether views show an object without background, whose statistics exclude the background."""
    return weighted and survey.uncovered_share > SCAN_SHARE


def starts_warm(settings: Settings, *, scan: bool) -> bool:
    """Return whether colors start like the style's.

    Steps change what all colors have in common only slowly (docs/quality.md). If only luminance is stylized, a warm
    start pays off only for scans, in which nothing else determines how bright they should be.
    """
    if settings.warm_start is None:
        return scan or settings.preserve_colors != "luminance"
    return settings.warm_start


def ends_with_transfer(settings: Settings, *, warm: bool) -> bool:
    """Return whether a job that starts with the style's colors is given them once more after the last step.

    A loss without statistics lets these colors drift during the steps; ARF (Zhang et al. 2022) transfers them a second
    time too. With statistics, the transfer would undo what the steps have achieved (docs/quality.md).
    """
    return warm and not has_statistics(settings.style_loss)


def training_background_of(settings: Settings, *, scan: bool) -> PlannedBackground:
    """Return the training background, which is behind the Gaussians in a step."""
    if settings.training_background == "auto":
        return SCAN_BACKGROUND if scan else "background"
    return settings.training_background


def rendered_gaussians(optimized: Tensor, settings: Settings) -> Tensor:
    """Return the mask [N] bool of Gaussians that are rendered: the optimized ones, or all for comparison."""
    everything = "unseen" in settings.keep and not settings.prune_weight
    return torch.ones_like(optimized) if everything else optimized


def pruned_gaussians(survey: Survey, seen: Tensor) -> Tensor:
    """Return the mask [N] bool of Gaussians that are visible in a view but not rendered."""
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

    On the CPU, tile intersections share the memory of cached weights (`CachedRasterizer`). On a GPU, they are small
    compared to its memory, and each view without them costs a sort and a synchronization. There they get half as much
    as cached weights, from the part that is left for buffers.

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
