"""Colors before the first step and after the last: transfers of the style's colors, and colors of unseen Gaussians."""

from __future__ import annotations

from dataclasses import replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.regions.definition import Regions
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import scene_colors
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.job import StylizationJob
from sgsst_core.stylizing.job_styles import JobStyles
from sgsst_core.stylizing.optimizer import constrained

#: Number of seen neighbors that determine the color change of an unseen Gaussian.
NEIGHBORS = 8
#: Number of unseen Gaussians processed at a time; their neighbors' changes and weights take some tens of megabytes.
_CHUNK = 1 << 16
#: Cells along each axis of the grid that orders the searches.
_CELLS = 128


def transferred_colors(job: StylizationJob, colors: Tensor | None = None) -> Tensor:
    """Transfer the style's colors to the rendered Gaussians; see `warm_start`.

    Args:
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
        optimized: [n, 3] on the CPU, colors of the rendered Gaussians.
        transfer: Whether to transfer the style's colors to `optimized`.

    Returns:
        [N, 3] float32 on the CPU.
    """
    colors, subspace = job.scene.sh_dc.clone(), job.styles.color_subspace(job.settings)
    colors[job.plan.seen] = optimized
    if transfer:
        colors[job.plan.seen] = transferred = transferred_colors(job, optimized)
        if job.preserves_chroma or subspace is not None:
            chroma_of = job.scene.sh_dc[job.plan.seen] if job.preserves_chroma else None
            bounded = constrained(transferred, chroma_of, subspace, bounded=job.settings.bounded)
            # Frozen colors remain bit-identical.
            colors[job.plan.seen] = torch.where(transferred != optimized, bounded, optimized)
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
    colors[unseen] = constrained(original + change, chroma_of, subspace, bounded=job.settings.bounded)
    return colors


def neighbors_change(means: Tensor, change: Tensor, weights: Tensor) -> Tensor:
    """Return color changes for the Gaussians that no view sees.

    Each takes the mean change of its nearest seen neighbors, weighted by their total blend weights: the change of a
    hardly visible Gaussian is determined by only a few pixels.

    Args:
        means: [N, 3].
        change: [N, 3], change by the optimization; rows of unseen Gaussians are ignored.
        weights: [N] float64, total blend weights: 0 for the U unseen Gaussians, positive for at least one other.

    Returns:
        [U, 3] float32.
    """
    seen = weights > 0
    if bool(seen.all()):
        return torch.zeros((0, 3))
    count = min(NEIGHBORS, int(seen.sum()))
    tree = cKDTree(means[seen].double().numpy())
    weights, change, positions = weights[seen], change[seen], means[~seen].double()
    votes = torch.empty((len(positions), 3))
    # Ordered by the cells of a coarse grid: consecutive searches then read the same part of the tree.
    lowest = positions.amin(dim=0)
    size = (positions.amax(dim=0) - lowest).clamp_min(1e-300)
    x, y, z = ((positions - lowest) / size * (_CELLS - 1)).long().unbind(1)
    for part in torch.argsort((x * _CELLS + y) * _CELLS + z, stable=True).split(_CHUNK):
        _, indices = tree.query(positions[part].numpy(), k=count, workers=torch.get_num_threads())
        nearest = torch.as_tensor(indices).reshape(-1, count)
        own = weights[nearest]
        fraction = own / own.amax(dim=1, keepdim=True)  # so that tiny weights do not underflow
        sums = (change[nearest].double() * fraction[:, :, None]).sum(dim=1)
        votes[part] = (sums / fraction.sum(dim=1, keepdim=True)).float()
    return votes


def neighbors_change_by_region(means: Tensor, change: Tensor, weights: Tensor, regions: Regions) -> Tensor:
    """Return color changes for the Gaussians that are not optimized: those of their neighbors in the same region.

    If a region has no optimized Gaussians, neighbors in all regions count. The change of frozen Gaussians is 0.

    Arguments are as in `neighbors_change`, but all weights other than those of optimized Gaussians are 0. The result is
    [N, 3].
    """
    result = torch.zeros_like(change)
    for region in regions.labels[~regions.frozen].unique().tolist():
        members = regions.members(region)
        voters = torch.where(members, weights, 0.0)
        if not bool((voters > 0).any()):
            voters = weights
        rows = members | (voters > 0)
        takes = rows & (voters <= 0)
        result[takes] = neighbors_change(means[rows], change[rows], voters[rows])
    return result


def render_first_view(
    scene: Scene, camera: Camera, style: Style, settings: Settings, regions: Regions | None = None
) -> Tensor | None:
    """Render a view with the colors of a warm start whose weights are those of this view alone.

    For a job with this one view, these are the colors of its warm start. It runs on the CPU and shares nothing with the
    job, whose measurements it must not change.

    Returns:
        Image [H, W, 3]; None if the view shows nothing that may change.
    """
    scene = scene.attenuated(settings.sh_attenuation)
    rasterizer = make_rasterizer("cpu", scene, background=settings.background, near=settings.near)
    weights = rasterizer.survey(camera)[1].double()
    if regions is not None:
        weights[regions.frozen] = 0
    rows = weights > 0
    if not bool(rows.any()):
        return None
    styles = JobStyles.prepared(style, regions and regions.resolved(weights), settings, scene.sh_dc, weights)
    colors, by_luminance = scene.sh_dc.clone(), settings.preserve_colors == "luminance"
    colors[rows] = styles.transferred(colors[rows], weights[rows], rows, preserve_chroma=by_luminance)
    return rasterizer.render(scene_colors(replace(scene, sh_dc=colors), camera), camera)
