"""What may be left out on request, and what it costs: hardly visible Gaussians, views that nearly repeat another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from sgsst_core.constants import TRANSMITTANCE_MIN
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene

#: Gaussians that are followed from one view to another.
_FOLLOWED = 2000


@dataclass(frozen=True)
class ImageError:
    """Bounds on what leaving Gaussians out changes in a pixel, per unit of the colors' range: largest and mean."""

    largest: float
    mean: float


def pruned_image_error(
    pruned: Tensor, cameras: Sequence[Camera], covered: Sequence[int], rasterizer: Rasterizer
) -> ImageError:
    """Bound the change of every pixel of every view when some Gaussians are not rendered.

    Take them away one by one, the farthest first. What is taken away showed w (c - b) of its pixel, with its blend
    weight w, its color c, and b the blend of what lies behind it; the weights of those in front stay the same. So
    no pixel changes by more than the sum of the pruned weights times the range of the colors, plus the transmittance
    at which blending stops.

    Args:
        pruned: [N] bool.
        rasterizer: of the whole scene.
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
    """Of the covered views, those whose picture is not nearly that of one before.

    The most visible Gaussians are projected into both views; a view is left out when the median of their shifts is less
    than `share` of the longer side. Where a view shows too few of those of the other, the two are distinct.

    Args:
        weights: [N] float64, total blend weights.
        share: 0 keeps all.
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
    """Positions [n, 2] in units of the longer side, and [n] whether they lie in the view."""
    pose = camera.world_to_camera.double()
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).unbind(-1)
    depth = torch.where(z > 0, z, 1.0)
    column, row = camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy
    inside = (z > 0) & (column >= 0) & (column <= camera.width) & (row >= 0) & (row <= camera.height)
    return torch.stack([column, row], dim=-1) / max(camera.width, camera.height), inside


def _shift(first: tuple[Tensor, Tensor], second: tuple[Tensor, Tensor]) -> float:
    """Median shift, in units of the longer side, of what both views show; infinite where that is less than half."""
    both = first[1] & second[1]
    if int(both.sum()) * 2 < max(int(first[1].sum()), int(second[1].sum()), 1):
        return float("inf")
    return float((first[0][both] - second[0][both]).norm(dim=-1).median())
