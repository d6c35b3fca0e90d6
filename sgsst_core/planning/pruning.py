"""Optional pruning and its error: hardly visible Gaussians, and views that nearly repeat another one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.constants import TRANSMITTANCE_MIN
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Number of Gaussians that are tracked between views.
_FOLLOWED = 2000


@dataclass(frozen=True)
class ImageError:
    """Maximum and mean change of a pixel if Gaussians are left out, as upper bounds.

    Both are relative to the range of colors.
    """

    largest: float
    mean: float


def pruned_image_error(
    pruned: Tensor, cameras: Sequence[Camera], covered: Sequence[int], rasterizer: Rasterizer
) -> ImageError:
    """Bound the change of every pixel of every view if some Gaussians are not rendered.

    Consider removing pruned Gaussians one by one, the farthest first. Removing one changes a pixel by w (c - b), where
    w is its blend weight, c its color, and b the blend of everything behind it. The weights of Gaussians in front of it
    do not change. Therefore no pixel changes by more than the sum of the pruned weights times the range of colors, plus
    the transmittance at which blending stops.

    Args:
        pruned: [N] bool, Gaussians that are left out.
        cameras: Cameras of all views.
        covered: Indices of the views to consider.
        rasterizer: Rasterizer of the whole scene.
    """
    marks = pruned[:, None].to(torch.float32).expand(-1, 3).contiguous()
    nothing = torch.zeros_like(marks)
    largest, total, pixels = 0.0, 0.0, 0
    for index in covered:
        weights = rasterizer.render(marks, cameras[index]) - rasterizer.render(nothing, cameras[index])
        largest = max(largest, float(weights.amax()))
        total += float(weights[..., 0].sum(dtype=torch.float64))
        pixels += weights[..., 0].numel()
    return ImageError(largest + TRANSMITTANCE_MIN, total / pixels + TRANSMITTANCE_MIN)


def distinct_views(
    scene: Scene, cameras: Sequence[Camera], covered: Sequence[int], weights: Tensor, share: float
) -> list[int]:
    """Return the covered views that do not nearly repeat an earlier one.

    The most visible Gaussians are projected into both views. A view is dropped if the median of their shifts is less
    than `share` of the longer side. Views that have too few of these Gaussians in common are distinct.

    Args:
        scene: Whole scene.
        cameras: Cameras of all views.
        covered: Indices of the covered views.
        weights: [N] float64, total blend weights.
        share: Minimum shift as a fraction of the longer side; 0 keeps all views.
    """
    if not share:
        return list(covered)
    followed = scene.means[weights.topk(min(_FOLLOWED, len(scene))).indices].double()
    kept: list[int] = []
    places: list[tuple[Tensor, Tensor]] = []
    for index in covered:
        place = _project(followed, cameras[index])
        if all(_shift(place, other) >= share for other in places):
            kept.append(index)
            places.append(place)
    return kept


def _project(points: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return positions [n, 2] in units of the longer side, and whether they are inside the view [n]."""
    pose = camera.world_to_camera.double()
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    depth = torch.where(z > 0, z, 1.0)
    column, row = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    inside = (z > 0) & (column >= 0) & (column <= camera.width) & (row >= 0) & (row <= camera.height)
    return torch.stack([column, row], dim=-1) / max(camera.width, camera.height), inside


def _shift(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> float:
    """Return the median shift of common points in units of the longer side; infinite if fewer than half are common."""
    both = first[1] & second[1]
    if int(both.sum()) * 2 < max(int(first[1].sum()), int(second[1].sum()), 1):
        return float("inf")
    return float((first[0][both] - second[0][both]).norm(dim=-1).median())
