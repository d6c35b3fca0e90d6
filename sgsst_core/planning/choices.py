"""Choices that follow from the settings and a first measurement.

What is measured next depends on them, so the probe and `decide` share them.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import MEMORY_SHARES
from sgsst_core.errors import SettingsError
from sgsst_core.loss.style_losses import has_statistics
from sgsst_core.planning.plan import Device
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import RasterizerName
from sgsst_core.settings import PlannedBackground, Precision, Settings

#: On the CPU, making a view's kept weights costs about three renders with gradient, and each use of them saves two
#: thirds of one: with fewer visits they do not pay. On GPUs both are measured (`RasterCost.least_visits`).
LEAST_VISITS = 5
#: With this share of pixels uncovered, views show an object without background. (Those of a room that was captured from
#: some places only have holes of a few percent.)
SCAN_SHARE = 0.2
#: What is behind such an object in a step, if nothing else was asked for (docs/quality.md).
SCAN_BACKGROUND: PlannedBackground = "palette"


def optimized_gaussians(looked: Survey, settings: Settings) -> Tensor:
    """[N] bool, Gaussians whose colors the views decide.

    Raises:
        SettingsError: pruning would leave none.
    """
    optimized = looked.total_blend_weights > settings.prune_weight
    if not optimized.any():
        raise SettingsError(
            f"--prune-weight {settings.prune_weight:g} would leave out every Gaussian: the largest total blend weight "
            f"is {float(looked.total_blend_weights.max()):.3g}. Give a smaller one."
        )
    return optimized


def is_scan(looked: Survey, *, weighted: bool) -> bool:
    """Whether views show an object without background, whose statistics leave out what is behind it."""
    return weighted and looked.uncovered_share > SCAN_SHARE


def starts_warm(settings: Settings, *, scan: bool) -> bool:
    """Whether colors begin as the style's: what they have in common, steps reach slowly (docs/quality.md).

    By luminance alone that is known of scans only, beside which nothing tells how bright they should be.
    """
    if settings.warm_start is None:
        return scan or settings.preserve_colors != "luminance"
    return settings.warm_start


def ends_with_transfer(settings: Settings, *, warm: bool) -> bool:
    """Whether a job that begins with the style's colors is given them once more behind the last step.

    A loss without statistics lets them go in its steps; ARF (Zhang et al. 2022) transfers them a second time, too. With
    statistics it would undo what steps have found (docs/quality.md).
    """
    return warm and not has_statistics(settings.style_loss)


def training_background_of(settings: Settings, *, scan: bool) -> PlannedBackground:
    """What is behind the Gaussians in a step."""
    if settings.training_background == "auto":
        return SCAN_BACKGROUND if scan else "background"
    return settings.training_background


def rendered_gaussians(optimized: Tensor, settings: Settings) -> Tensor:
    """[N] bool, Gaussians that are rendered: the optimized ones, or all for comparison."""
    everything = "unseen" in settings.keep and not settings.prune_weight
    return torch.ones_like(optimized) if everything else optimized


def pruned_gaussians(looked: Survey, seen: Tensor) -> Tensor:
    """[N] bool, Gaussians that a view shows and that are not rendered all the same."""
    return ~seen & (looked.total_blend_weights > 0)


def precision_of(asked: Precision, ratio: float | None) -> Precision:
    """The network's precision, where a convolution in float32 takes `ratio` times as long as in the one asked for.

    Processors without bfloat16 instructions compute it hundreds of times slower than float32.

    Args:
        ratio: None where float32 was asked for, or what there is not here.
    """
    return asked if ratio is not None and ratio > 1 else "float32"


#: Rasterizers of GPUs, the preferred one first.
GPU_RASTERIZERS: tuple[RasterizerName, ...] = ("triton", "cuda")


def rasterizer_options(name: str, settings: Settings, memory: int) -> dict[str, Any]:
    """What the rasterizer of a job that computes weights anew is made with, beside its scene.

    On the CPU lists share the memory of kept weights (`CachedRasterizer`). Lists of a GPU are small beside its memory,
    and each view without one costs a sort and a wait: they have half as much as kept weights, of what is left to
    buffers.

    Args:
        memory: bytes that the rank may plan with.
    """
    options: dict[str, Any] = {"background": settings.background, "near": settings.near}
    if name in ("cpu", "triton"):
        options["max_list_bytes"] = int(memory * MEMORY_SHARES["rasterizer"]) // (2 if name == "triton" else 1)
    return options


def uncached_rasterizer(device: Device, problems: Mapping[str, str]) -> RasterizerName:
    """The rasterizer that computes blend weights anew: on a GPU the first of `GPU_RASTERIZERS` that works.

    Args:
        problems: why GPU rasterizers cannot be used, by their name; those that can are not in it.
    """
    if device == "cuda":
        return next((name for name in GPU_RASTERIZERS if name not in problems), "cpu")
    return "cpu"
