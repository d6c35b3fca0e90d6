"""Quality on novel views, measured at intervals during a run.

Novel views lie halfway between neighboring cameras, so no camera has to be held out of training. Two measures are
computed: the distance of the views from the style (the Gram terms of the SOS loss), and their multi-view consistency.
Geometry is frozen, so coverage and warps never change and are cached.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import Cache, tensor_bytes
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.terms import StyleTargets
from sgsst_core.quality.consistency import (
    LONG_RANGE,
    SHORT_RANGE,
    Consistency,
    Warp,
    consistency,
    expected_depth,
    find_warp,
    shown,
)
from sgsst_core.quality.lpips import Lpips
from sgsst_core.quality.novel_cameras import choose_novel_cameras
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.regions.maps import RegionMaps
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.stylizing.steps import ShowViews, show_nothing
from sgsst_core.stylizing.views import ViewColors

#: Maximum number of views whose Gram distance is measured, and of pairs compared per range.
MAX_VIEWS = 4


@dataclass(frozen=True)
class NovelViewMoment:
    """Measurement of the novel views after one step.

    Attributes:
        gram: Gram distance by scale: sum over layers of w_G mean((G - G_v)^2), averaged over views (see
            `sgsst_core.loss`).
        gram_relative: Mean of `gram` over scales, relative to the run's first measurement; None if there are no views.
        short, long: Consistency of pairs of views 1 and 7 apart; None if there is no such pair.
    """

    gram: dict[int, float]
    gram_relative: float | None
    short: Consistency | None
    long: Consistency | None

    def as_dict(self, step: int, seconds: float) -> dict[str, Any]:
        """Return the measurement after `step` steps and `seconds` of optimization as JSON-serializable values."""
        ranges = {"short": self.short, "long": self.long}
        return {
            "step": step,
            "seconds": seconds,
            "gram": {str(scale): value for scale, value in self.gram.items()},
            "gram_relative": self.gram_relative,
            "consistency": {name: pairs and pairs.as_dict() for name, pairs in ranges.items()},
        }


class NovelViews:
    """Measurements on the novel views of one job.

    Args:
        covered: Indices of the cameras that see at least one Gaussian.
        scene: Scene to stylize. Gaussians missing from it are missing in the novel views too.
        rasterizer: Rasterizer of the scene, preferably not shared with the job: in a shared `cached` rasterizer, blend
            weights of novel views would evict those of the job's own views.
        loss: Loss that supplies network, memory budget and tile size. A separate loss with the same properties is
            evaluated, so the timer of this one does not run.
        style_targets: Function that returns the style targets of `loss` for views of a camera's size.
        weighted: Whether to weight statistics by rendered coverage, as the job does.
        lpips: LPIPS network; None skips LPIPS.
        first: `NovelViewMoment.gram` of the run's first measurement, for a resumed run; None if there is none yet.
        most: Maximum number of views whose Gram distance is measured, and of pairs compared per range.
        memory: Memory budget in bytes for coverage, colors, warps and images. What does not fit is recomputed.
        rasterizer_of: Function that creates a rasterizer for a sample of the Gaussians; see `choose_novel_cameras`.
        maps: Region maps that match `style_targets`; None if the scene has no regions.

    Attributes:
        cameras: All novel views.
        views: Indices of the views whose Gram distance is measured, at most `most`. If empty, there is nothing to
            measure.
        pairs: Pairs of views to compare, at most `most`, by gap.
        first: `NovelViewMoment.gram` of the run's first measurement; None before it.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        covered: Sequence[int],
        scene: Scene,
        rasterizer: Rasterizer,
        loss: SosLoss,
        style_targets: Callable[[Camera], StyleTargets],
        *,
        weighted: bool,
        lpips: Lpips | None = None,
        first: dict[int, float] | None = None,
        most: int = MAX_VIEWS,
        memory: int = 1 << 29,
        rasterizer_of: Callable[[Scene], Rasterizer] | None = None,
        maps: RegionMaps | None = None,
    ) -> None:
        self.scene = scene
        self.rasterizer = rasterizer
        self.lpips = lpips
        self.weighted = weighted
        self.first = first
        self._style_targets = style_targets
        self._maps = maps
        self._loss = SosLoss(
            loss.network,
            content_weight=0.0,
            memory=loss.memory,
            tile_size=loss.tiling.tile_size,
            coarsest=loss.tiling.coarsest,
            scales=loss.weights,
        )
        self.cameras, self.views, self.pairs = choose_novel_cameras(
            [cameras[index] for index in covered], scene, rasterizer, most=most, rasterizer_of=rasterizer_of
        )
        self._colors = ViewColors(scene, self.cameras, rasterizer.device, memory // 8)
        self._coverage: Cache[int, Tensor] = Cache(memory // 8, tensor_bytes)
        self._warps: Cache[tuple[int, int], Warp] = Cache(memory // 2, lambda warp: warp.nbytes)
        self._image_memory = memory // 4

    @torch.no_grad()
    def measure(self, sh_dc: Tensor, show: ShowViews = show_nothing) -> NovelViewMoment:
        """Measure the scene with colors `sh_dc` [N, 3]; `show` is called before each view.

        Raises:
            ValueError: If an image contains NaN or infinity.
        """
        images: Cache[int, Tensor] = Cache(self._image_memory, tensor_bytes)
        sh_dc = sh_dc.detach().to(self.rasterizer.device)

        def rendered(index: int) -> Tensor:
            camera, colors = self.cameras[index], self._colors(index, sh_dc)
            return shown(self.rasterizer.render(colors, camera), camera, self.rasterizer.device)

        def image(index: int) -> Tensor:
            return images.get(index, partial(rendered, index))

        gram = self._gram(image, show)
        self.first = self.first or gram
        start = _mean(self.first)
        return NovelViewMoment(
            gram,
            _mean(gram) / start if start else None,
            self._consistency(SHORT_RANGE, image),
            self._consistency(LONG_RANGE, image),
        )

    def _gram(self, image: Callable[[int], Tensor], show: ShowViews) -> dict[int, float]:
        """Compute the Gram distance by scale, as the mean over the views that have the scale."""
        values: dict[int, list[float]] = {}
        for done, index in enumerate(self.views):
            show(done, len(self.views))
            coverage = None
            if self.weighted:
                coverage = self._coverage.get(index, partial(self.rasterizer.coverage, self.cameras[index]))
            target = self._loss.targets.of_view(image(index), coverage)
            if self._maps is not None:
                fractions = self._maps.render(self.cameras[index]).unbind(2)
                target.regions = [self._loss.targets.position_weights(fraction) for fraction in fractions]
            style = self._style_targets(self.cameras[index])
            for scale, terms in self._loss.evaluate(image(index), style, target, gradient=False).terms.items():
                values.setdefault(scale, []).append(terms["gram"])
        return {scale: sum(own) / len(own) for scale, own in sorted(values.items())}

    def _consistency(self, gap: int, image: Callable[[int], Tensor]) -> Consistency | None:
        if not self.pairs[gap]:
            return None

        def warp(first: int, second: int) -> Warp:
            return self._warps.get((first, second), partial(find, first, second))

        def find(i: int, j: int) -> Warp:
            depth, other = (expected_depth(self.scene, self.cameras[k], self.rasterizer) for k in (i, j))
            return find_warp(other, self.cameras[j], depth, self.cameras[i])

        return consistency(gap, self.pairs[gap], image, warp, self.lpips)


def _mean(gram: dict[int, float]) -> float:
    return sum(gram.values()) / max(len(gram), 1)
