"""Colors of a scene's Gaussians as views see them."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sgsst_core.budget import Cache, tensor_bytes
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors


class ViewColors:
    """Function that computes a view's colors; their part from higher SH degrees never changes, and is cached.

    Args:
        scene: Scene that provides this part.
        cameras: One camera per view.
        device: Device of the colors.
        memory: Memory budget of the cache in bytes.
    """

    def __init__(self, scene: Scene, cameras: Sequence[Camera], device: torch.device, memory: int) -> None:
        self._cameras = cameras
        self._degree = scene.sh_degree
        self._sh_rest = scene.sh_rest.to(device)
        self._means = scene.means.to(device)
        self._rest: Cache[int, Tensor] = Cache(memory, tensor_bytes)

    def __call__(self, index: int, sh_dc: Tensor) -> Tensor:
        """Return the colors [N, 3] of a view for `sh_dc` [N, 3]."""
        if self._degree == 0:
            return view_colors(sh_dc, torch.zeros((), dtype=sh_dc.dtype, device=sh_dc.device))
        rest = self._rest.get(index, lambda: rest_colors(self._sh_rest, self._means, self._cameras[index]))
        return view_colors(sh_dc, rest)
