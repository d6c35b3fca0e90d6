"""`Rasterizer.survey` based on `coverage` and `color_gradient`; reference for the fast implementations."""

from __future__ import annotations

import torch
from torch import Tensor

from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene.camera import Camera


def plain_survey(rasterizer: Rasterizer, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return coverage [h, width], and each Gaussian's blend weight summed over all pixels [N].

    The latter is a column of the color gradient for an image gradient of ones.
    """
    coverage = rasterizer.coverage(camera)
    ones = torch.ones((*coverage.shape, 3), dtype=rasterizer.dtype, device=coverage.device)
    return coverage, rasterizer.color_gradient(ones, camera)[:, 0]
