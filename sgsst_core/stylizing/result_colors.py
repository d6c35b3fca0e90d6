"""Colors before the first step and after the last: transfers of the style's colors, and colors of unseen Gaussians."""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.stylizing.job import StylizationJob
from sgsst_core.stylizing.optimizer import constrained
from sgsst_core.stylizing.unseen import neighbors_change, neighbors_change_by_region


def transferred_colors(job: StylizationJob, colors: Tensor | None = None) -> Tensor:
    """Transfer the style's colors to the rendered Gaussians; see `warm_start`.

    Args:
        job: Job of the scene.
        colors: [n, 3] on the CPU, colors before the transfer; None for the scene's, as before the first step.

    Returns:
        [n, 3] on the CPU.
    """
    seen = job.plan.seen
    colors = job.scene.sh_dc[seen] if colors is None else colors
    weights = job.plan.survey.total_blend_weights[seen]
    transferred = job.styles.transferred(colors, weights, seen, preserve_chroma=job.preserves_chroma)
    # `result_colors` derives colors that no view determines from those of their neighbors.
    return torch.where(job.plan.optimized[seen][:, None], transferred, colors)


def result_colors(job: StylizationJob, optimized: Tensor, *, transfer: bool) -> Tensor:
    """Return the colors of the whole scene, in which unseen Gaussians follow their neighbors if the settings say so.

    Args:
        job: Job of the scene.
        optimized: [n, 3] on the CPU, colors of the rendered Gaussians.
        transfer: Whether to transfer the style's colors to `optimized`.

    Returns:
        [N, 3] float32 on the CPU.
    """
    colors = job.scene.sh_dc.clone()
    colors[job.plan.seen] = _transferred_last(job, optimized) if transfer else optimized
    if job.settings.unseen != "neighbors":
        return colors
    weights = torch.where(job.plan.optimized, job.plan.survey.total_blend_weights, 0.0)
    change, regions = colors - job.scene.sh_dc, job.regions
    unseen = weights <= 0 if regions is None else (weights <= 0) & ~regions.frozen
    if regions is None:
        change = neighbors_change(job.scene.means, change, weights)
    else:
        change = neighbors_change_by_region(job.scene.means, change, weights, regions)[unseen]
    change = change.mean(dim=1, keepdim=True) if job.preserves_chroma else change
    original = job.scene.sh_dc[unseen]
    chroma_of = original if job.preserves_chroma else None
    subspace = job.styles.color_subspace(job.settings)
    colors[unseen] = constrained(original + change, chroma_of, subspace, bounded=job.settings.bounded)
    return colors


def _transferred_last(job: StylizationJob, optimized: Tensor) -> Tensor:
    transferred, subspace = transferred_colors(job, optimized), job.styles.color_subspace(job.settings)
    if not job.preserves_chroma and subspace is None:
        return transferred
    chroma_of = job.scene.sh_dc[job.plan.seen] if job.preserves_chroma else None
    bounded = constrained(transferred, chroma_of, subspace, bounded=job.settings.bounded)
    return torch.where(transferred != optimized, bounded, optimized)  # frozen colors remain bit-identical
