"""The views of a job: what each is compared with, and what of it is kept in memory."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from sgsst_core.budget import Shelf
from sgsst_core.camera import Camera
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.scene import Scene
from sgsst_core.sos import SosLoss, ViewTarget
from sgsst_core.spherical_harmonics import rest_colours, view_colours, view_colours_gradient

PhotoLoader = Callable[[int], Tensor]


class Views:
    """Renders views, and prepares their targets at first use.

    Args:
        scene: supplies the colours' frozen part and the content (the unstylized render).
        cameras: one for each view.
        rasterizer: renders them.
        loss: prepares the targets.
        photos: content image [H, W, 3] of a view by its index; None for the unstylized render.
        covered: indices of the views that see anything.
        weighted: weigh statistics by rendered coverage.
        memory: bytes that content features, coverage and colours of views may take.
        revive: let colours that the clamp holds at 0 come back (`view_colours_gradient`).
        keep_content: keep content features that fit; False computes them at each visit, for comparison.
    """

    def __init__(
        self,
        scene: Scene,
        cameras: Sequence[Camera],
        rasterizer: Rasterizer,
        loss: SosLoss,
        *,
        covered: list[int],
        weighted: bool,
        photos: PhotoLoader | None = None,
        memory: int = 1 << 30,
        keep_content: bool = True,
        revive: bool = False,
    ) -> None:
        self.scene = scene
        self.cameras = list(cameras)
        self.rasterizer = rasterizer
        self.loss = loss
        self._photos = photos
        self._sh_rest = scene.sh_rest.to(rasterizer.device)
        self._means = scene.means.to(rasterizer.device)
        self._rest: Shelf[int, Tensor] = Shelf(memory // 4, _tensor_bytes)
        self._coverage: Shelf[int, list[Tensor]] = Shelf(memory // 4, _pyramid_bytes)
        kept = memory // 2 if keep_content else 0
        self._content: Shelf[tuple[int, int], Tensor] = Shelf(kept, _tensor_bytes)
        self.covered = covered
        self.weighted = weighted
        self.revive = revive

    def __len__(self) -> int:
        return len(self.cameras)

    def colours(self, index: int, sh_dc: Tensor) -> Tensor:
        """Colours [N, 3] of a view."""
        if self.scene.sh_degree == 0:
            return view_colours(sh_dc, torch.zeros((), dtype=sh_dc.dtype, device=sh_dc.device))
        rest = self._rest.get(index, lambda: rest_colours(self._sh_rest, self._means, self.cameras[index]))
        return view_colours(sh_dc, rest)

    def render(self, index: int, colours: Tensor) -> Tensor:
        """Image [H, W, 3] of a view with its colours [N, 3]."""
        return self.rasterizer.render(colours, self.cameras[index])

    def gradient(self, index: int, image_gradient: Tensor, colours: Tensor) -> Tensor:
        """dL/dsh_dc [N, 3] from dL/dimage [H, W, 3] and the colours that were rendered."""
        gradient = self.rasterizer.colour_gradient(image_gradient, self.cameras[index])
        return view_colours_gradient(gradient, colours, revive=self.revive)

    def content(self, index: int) -> Tensor:
        """Content image [H, W, 3]: the photo, or the render of the unstylized scene."""
        if self._photos is not None:
            return self._photos(index)
        return self.render(index, self.colours(index, self.scene.sh_dc.to(self.rasterizer.device)))

    def target(self, index: int, scales: Sequence[int]) -> ViewTarget:
        """What the view is compared with at some scales; kept where memory allows.

        Features are computed only of scales that are asked for: phase 1 needs those of one.
        """
        coverage = self._coverage.get(index, lambda: self._position_weights(index)) if self.weighted else None
        target = ViewTarget(coverage=coverage)
        if self.loss.content_weight:
            image = functools.cache(lambda: self.content(index))
            for scale in scales:
                target.content[scale] = self._content.get(
                    (index, scale), functools.partial(self._features, image, scale, coverage)
                )
        return target

    def _position_weights(self, index: int) -> list[Tensor]:
        return self.loss.position_weights(self.rasterizer.coverage(self.cameras[index]))

    def _features(self, image: Callable[[], Tensor], scale: int, coverage: list[Tensor] | None) -> Tensor:
        return self.loss.content_features(image(), scale, coverage)


def _tensor_bytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()


def _pyramid_bytes(pyramid: list[Tensor]) -> int:
    return sum(_tensor_bytes(level) for level in pyramid)
