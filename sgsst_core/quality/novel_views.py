"""Quality on novel views, measured at intervals during a run.

Novel views lie halfway between neighboring cameras, so no camera has to be held out of training. Two measures are
computed: the distance of the views from the style (the Gram terms of the SOS loss), and their multi-view consistency.
Geometry is frozen, so coverage and warps never change and are cached.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import Cache
from sgsst_core.loss.sos import SosLoss
from sgsst_core.loss.targets import StyleTargets
from sgsst_core.planning.survey import sees_something
from sgsst_core.quality.consistency import (
    LONG_RANGE,
    SHORT_RANGE,
    Consistency,
    Warp,
    compare,
    expected_depth,
    find_warp,
    shown,
    view_pairs,
)
from sgsst_core.quality.lpips import Lpips
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.base import CameraKey, camera_key
from sgsst_core.regions.maps import RegionMaps
from sgsst_core.scene.camera import Camera, between, resized
from sgsst_core.scene.gaussians import Scene, sampled
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors

#: Maximum number of views whose Gram distance is measured, and of pairs compared per range.
MOST_VIEWS = 4
#: Distance, relative to the median distance of consecutive cameras, beyond which two cameras are not neighbors. The
#: capture was probably interrupted between them.
JUMP = 4.0
#: Rotation between two cameras beyond which they are not neighbors: about the field of view of a photo. A view halfway
#: between such cameras may show nothing that either of them sees.
LARGEST_TURN = math.radians(60)
#: Maximum factor by which the median depth and the coverage of a novel view may lie outside the range of its neighbors'
#: values. They exceed it inside an object or behind a wall. On the chord between two cameras of a 60-degree arc, they
#: change by at most a third.
LIKENESS = 2.0
#: Longer side in pixels of the small renders that are checked for depth and coverage.
_OUTLOOK_SIDE = 160
#: Maximum number of Gaussians in these renders. Larger scenes are sampled, and sampled Gaussians are enlarged to cover
#: the same area.
_OUTLOOK_GAUSSIANS = 250_000
#: Tolerance for the rounding of rotations in camera files.
_COSINE_ROUNDING = 1e-6


def neighbors(cameras: list[Camera]) -> list[tuple[Camera, Camera]]:
    """Return the pairs of neighboring cameras between which novel cameras are placed.

    Adjacent cameras of the list are paired. If most of them are not neighbors (see `JUMP` and `LARGEST_TURN`), the list
    is assumed not to be in capture order, and a greedy walk to the nearest remaining camera replaces it. Pairs with the
    same pose are omitted. The result is empty for fewer than two cameras.
    """
    if len(cameras) < 2:
        return []
    centers = torch.stack([camera.center for camera in cameras])
    rotations = torch.stack([camera.world_to_camera[:3, :3].double() for camera in cameras])
    walk = _walk(centers, rotations)
    steps = (centers[walk[1:]] - centers[walk[:-1]]).norm(dim=1)
    reach = JUMP * float(steps[steps > 0].median()) if bool((steps > 0).any()) else 0.0

    def pairs(order: Sequence[int]) -> list[tuple[Camera, Camera]]:
        return [
            (cameras[i], cameras[j])
            for i, j in itertools.pairwise(order)
            if float((centers[i] - centers[j]).norm()) <= reach
            and bool(_similarly_turned(rotations[i], rotations[j]))
            and not torch.allclose(cameras[i].world_to_camera, cameras[j].world_to_camera)
        ]

    in_order = pairs(range(len(cameras)))
    return in_order if 2 * len(in_order) >= len(cameras) - 1 else max(in_order, pairs(walk), key=len)


def _walk(centers: Tensor, rotations: Tensor) -> list[int]:
    """Return the indices of the cameras along a greedy walk to the nearest remaining camera.

    Cameras with a similar rotation take precedence.

    Args:
        centers: Camera centers [n, 3].
        rotations: Camera rotations [n, 3, 3].
    """
    left = torch.ones(len(centers), dtype=torch.bool)
    left[0] = False
    order = [0]
    while bool(left.any()):
        here = order[-1]
        similar = left & _similarly_turned(rotations, rotations[here])
        candidates = (similar if bool(similar.any()) else left).nonzero()[:, 0]
        order.append(int(candidates[(centers[candidates] - centers[here]).norm(dim=1).argmin()]))
        left[order[-1]] = False
    return order


def _similarly_turned(rotations: Tensor, rotation: Tensor) -> Tensor:
    """Return whether rotations [..., 3, 3] differ from a given one by at most `LARGEST_TURN`, as [...] bool."""
    cosine = ((rotations * rotation).sum(dim=(-2, -1)) - 1) / 2  # trace(A B^T) = 1 + 2 cos(angle)
    return cosine >= math.cos(LARGEST_TURN) - _COSINE_ROUNDING


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
        return {
            "step": step,
            "seconds": seconds,
            "gram": {str(scale): value for scale, value in self.gram.items()},
            "gram_relative": self.gram_relative,
            "consistency": {"short": _consistency_json(self.short), "long": _consistency_json(self.long)},
        }


class NovelViews:
    """Measurements on the novel views of one job.

    Args:
        cameras: Cameras of the job.
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
        rasterizer_of: Function that creates a rasterizer for a sample of the Gaussians, used to check depth and
            coverage in large scenes; None uses the whole scene.
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
        most: int = MOST_VIEWS,
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
        self._rasterizer_of = rasterizer_of
        self._maps = maps
        self._loss = SosLoss(
            loss.network,
            content_weight=0.0,
            memory=loss.memory,
            tile_size=loss.tiling.tile_size,
            coarsest=loss.tiling.coarsest,
            scales=loss.weights,
            leave_out=loss.divider.leave_out,
        )
        self._sh_rest = scene.sh_rest.to(rasterizer.device)
        self._means = scene.means.to(rasterizer.device)
        self._rest: Cache[int, Tensor] = Cache(memory // 8, _tensor_bytes)
        self._coverage: Cache[int, Tensor] = Cache(memory // 8, _tensor_bytes)
        self._warps: Cache[tuple[int, int], Warp] = Cache(memory // 2, lambda warp: warp.nbytes)
        self._picture_memory = memory // 4
        parents = neighbors([cameras[index] for index in covered])
        self.cameras = [between(*pair) for pair in parents]
        self.views, self.pairs = self._choose(parents, most)

    def _choose(
        self, parents: list[tuple[Camera, Camera]], most: int
    ) -> tuple[list[int], dict[int, list[tuple[int, int]]]]:
        """Choose the views and pairs to measure, evenly spread; views from inside an object are dropped."""
        count = len(self.cameras)
        pairs = {gap: view_pairs(count, gap, most) for gap in (SHORT_RANGE, LONG_RANGE)}
        # Use the first views of the short-range pairs: they are rendered anyway, and spread just as evenly.
        views = [i for i, _ in pairs[SHORT_RANGE]] or list(range(min(count, most)))
        used = {*views, *(index for chosen in pairs.values() for pair in chosen for index in pair)}
        rough, rasterizer = self.scene, self.rasterizer
        if self._rasterizer_of is not None and len(rough) > _OUTLOOK_GAUSSIANS:
            rough = sampled(rough, _OUTLOOK_GAUSSIANS)
            rasterizer = self._rasterizer_of(rough)
        looks: dict[
            CameraKey, tuple[float, float | None]
        ] = {}  # by camera, because a camera is a neighbor of two views

        def outlook(view: Camera) -> tuple[float, float | None]:
            key = camera_key(view)
            if key not in looks:
                looks[key] = _outlook(view, rough, rasterizer)
            return looks[key]

        clear = {index for index in used if self._is_clear(self.cameras[index], parents[index], outlook)}
        return [index for index in views if index in clear], {
            gap: [pair for pair in chosen if clear.issuperset(pair)] for gap, chosen in pairs.items()
        }

    def _is_clear(
        self, camera: Camera, parents: tuple[Camera, Camera], outlook: Callable[[Camera], tuple[float, float | None]]
    ) -> bool:
        """Return whether depth and coverage of a novel view resemble its neighbors', unlike inside an object."""
        (covered, depth), *others = (outlook(view) for view in (camera, *parents))
        return (
            covered > 0
            and _alike(covered, [other[0] for other in others])
            and (depth is None or _alike(depth, [other[1] for other in others if other[1] is not None]))
        )

    @torch.no_grad()
    def measure(self, sh_dc: Tensor) -> NovelViewMoment:
        """Measure the scene with colors `sh_dc` [N, 3].

        Raises:
            ValueError: If an image contains NaN or infinity.
        """
        pictures: Cache[int, Tensor] = Cache(self._picture_memory, _tensor_bytes)
        sh_dc = sh_dc.detach().to(self.rasterizer.device)

        def picture(index: int) -> Tensor:
            return pictures.get(index, lambda: self._picture(index, sh_dc))

        gram = self._gram(picture)
        self.first = self.first or gram
        start = _mean(self.first)
        return NovelViewMoment(
            gram,
            _mean(gram) / start if start else None,
            self._consistency(SHORT_RANGE, picture),
            self._consistency(LONG_RANGE, picture),
        )

    def _picture(self, index: int, sh_dc: Tensor) -> Tensor:
        """Render a novel view as a screen shows it, [H, W, 3]."""
        camera = self.cameras[index]
        if self.scene.sh_degree == 0:
            rest = torch.zeros((), dtype=sh_dc.dtype, device=sh_dc.device)
        else:
            rest = self._rest.get(index, lambda: rest_colors(self._sh_rest, self._means, camera))
        return shown(self.rasterizer.render(view_colors(sh_dc, rest), camera), camera, self.rasterizer.device)

    def _gram(self, picture: Callable[[int], Tensor]) -> dict[int, float]:
        """Compute the Gram distance by scale, as the mean over the views that have the scale."""
        values: dict[int, list[float]] = {}
        for index in self.views:
            image, coverage = picture(index), None
            if self.weighted:
                coverage = self._coverage.get(index, partial(self.rasterizer.coverage, self.cameras[index]))
            target = self._loss.targets.of_view(image, coverage)
            if self._maps is not None:
                shares = self._maps.render(self.cameras[index]).unbind(2)
                target.regions = [self._loss.targets.position_weights(share) for share in shares]
            style = self._style_targets(self.cameras[index])
            for scale, terms in self._loss.evaluate(image, style, target, gradient=False).terms.items():
                values.setdefault(scale, []).append(terms["gram"])
        return {scale: sum(found) / len(found) for scale, found in sorted(values.items())}

    def _consistency(self, gap: int, picture: Callable[[int], Tensor]) -> Consistency | None:
        if not self.pairs[gap]:
            return None
        results = []
        for i, j in self.pairs[gap]:
            warped, valid = self._warps.get((i, j), partial(self._warp, i, j)).apply(picture(j))
            results.append(compare(i, j, picture(i), warped, valid, self.lpips))
        return Consistency(gap, results)

    def _warp(self, i: int, j: int) -> Warp:
        """Compute the warp of view j into view i."""
        depth, other = (expected_depth(self.scene, self.cameras[k], self.rasterizer) for k in (i, j))
        return find_warp(other, self.cameras[j], depth, self.cameras[i])


def _outlook(camera: Camera, scene: Scene, rasterizer: Rasterizer) -> tuple[float, float | None]:
    """Return a view's mean coverage (0 if it sees nothing) and its median depth (None if unknown)."""
    small = resized(camera, min(_OUTLOOK_SIDE, camera.side))
    coverage = rasterizer.coverage(small)
    seen = sees_something(coverage)
    depth = expected_depth(scene, small, rasterizer)
    known = depth.depth[depth.known]
    return float(coverage.mean()) if seen else 0.0, float(known.median()) if len(known) else None


def _alike(value: float, others: list[float]) -> bool:
    """Return whether a value is within `LIKENESS` of the range of `others`; true if `others` is empty."""
    return not others or min(others) / LIKENESS <= value <= LIKENESS * max(others)


def _mean(gram: dict[int, float]) -> float:
    return sum(gram.values()) / max(len(gram), 1)


def _consistency_json(consistency: Consistency | None) -> dict[str, Any] | None:
    if consistency is None:
        return None
    return {
        "gap": consistency.gap,
        "pairs": len(consistency.pairs),
        "compared": consistency.compared,
        "rmse": consistency.rmse,
        "lpips": consistency.lpips,
    }


def _tensor_bytes(tensor: Tensor) -> int:
    return tensor.numel() * tensor.element_size()
