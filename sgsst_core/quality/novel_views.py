"""Quality on views that were never trained on, measured at moments of a run.

No camera is taken away from the training: novel views lie halfway between neighboring cameras. What is measured is
how far their style is from the style image's (the Gram terms of the SOS loss) and how well they agree with each other
(multi-view consistency). Geometry is frozen, so that coverage and warps are the same at every moment and are kept.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sgsst_core.budget import Shelf
from sgsst_core.loss.sos import ScaleTarget, SosLoss
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
from sgsst_core.rasterizer.arguments import CameraKey, camera_key
from sgsst_core.scene.camera import Camera, between, resized
from sgsst_core.scene.gaussians import Scene, sampled
from sgsst_core.scene.spherical_harmonics import rest_colors, view_colors
from sgsst_core.stylizing.regions import RegionMaps

#: Views whose Gram distance is measured, and pairs of each range that are compared, at most.
MOST_VIEWS = 4
#: Two cameras farther apart than so many median steps are no neighbors: the capture was broken off between them.
JUMP = 4.0
#: Nor are two that are turned against each other by more than this, about the field of view of a photo: halfway between
#: them, nothing need be in view that either sees.
LARGEST_TURN = math.radians(60)
#: Median depth and coverage of a novel view are at least the smaller of its neighbors' divided by this, and at most
#: the larger times this. Inside an object or behind a wall they are not; on the chord of an arc of 60 degrees they
#: change by no more than a third.
LIKENESS = 2.0
#: Longer side in pixels at which that is looked at.
_OUTLOOK_SIDE = 160
#: Gaussians that are looked at there: of larger scenes evenly chosen ones, so much larger that they cover as much.
_OUTLOOK_GAUSSIANS = 250_000
#: cos(60 degrees) of a camera file has been rounded.
_COSINE_ROUNDING = 1e-6


def neighbors(cameras: list[Camera]) -> list[tuple[Camera, Camera]]:
    """The pairs that novel cameras lie between: each two neighbors; neighbors in space follow each other.

    The list's order counts. Where the next camera is mostly no neighbor (see `JUMP` and `LARGEST_TURN`) the list is
    not in the order of a capture, and a walk from each camera to the nearest one takes its place. Fewer than two
    cameras have nothing between them, and neither have two of one pose.
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
    """An order of cameras [n, 3], [n, 3, 3] that goes to the nearest one left, similarly turned ones first."""
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
    """Whether rotations [..., 3, 3] differ from one by no more than `LARGEST_TURN`, [...] bool."""
    cosine = ((rotations * rotation).sum(dim=(-2, -1)) - 1) / 2  # trace(A B^T) = 1 + 2 cos(angle)
    return cosine >= math.cos(LARGEST_TURN) - _COSINE_ROUNDING


@dataclass(frozen=True)
class NovelViewMoment:
    """What one measurement gives.

    Attributes:
        gram: scale to Gram distance, the mean over views of sum over layers of w_G mean((G - G_v)^2) (see `loss`).
        gram_relative: mean of `gram` over the scales, relative to the run's first measurement; None without views.
        short, long: consistency of views 1 and 7 apart; None where there is no such pair.
    """

    gram: dict[int, float]
    gram_relative: float | None
    short: Consistency | None
    long: Consistency | None

    def as_dict(self, step: int, seconds: float) -> dict[str, Any]:
        """The measurement after `step` iterations and `seconds` of optimization, as values that JSON can hold."""
        return {
            "step": step,
            "seconds": seconds,
            "gram": {str(scale): value for scale, value in self.gram.items()},
            "gram_relative": self.gram_relative,
            "consistency": {"short": _consistency_json(self.short), "long": _consistency_json(self.long)},
        }


class NovelViews:
    """Measures the novel views of one job.

    Args:
        cameras: of the job.
        covered: indices of those that see anything.
        scene: what is stylized. Gaussians that it lacks are missing in the novel views too.
        rasterizer: of the scene. Best one of its own: a `cached` one that the job uses as well would keep the weights
            of novel views in the place of views that come again in every round.
        loss: gives network, memory and partition; it is not used itself, so that its timer does not run.
        style_targets: the style's statistics for views of a camera's size, in the loss's units.
        weighted: weigh statistics by rendered coverage, as the job does.
        lpips: None leaves LPIPS out.
        first: `HeldOutMoment.gram` of the run's first measurement, where a session before this one has made it.
        most: views whose Gram distance is measured, and pairs of each range that are compared, at most.
        memory: bytes that coverage, colors, warps and pictures may take; what does not fit is computed again.
        rasterizer_of: makes one of a part of the scene, for a first look at the views of a large one; None looks at
            all of it.
        maps: renders the share of each region, which `style_targets` are those of; None where the scene has none.

    Attributes:
        cameras: all novel views.
        views: indices of those whose Gram distance is measured, at most 4; without any there is nothing to measure.
        pairs: gap to the pairs of views that are compared, at most 4 each.
        first: see above; set by the first measurement.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        covered: Sequence[int],
        scene: Scene,
        rasterizer: Rasterizer,
        loss: SosLoss,
        style_targets: Callable[[Camera], Mapping[int, ScaleTarget]],
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
            tile_size=loss.tile_size,
            coarsest=loss.coarsest,
            scales=loss.weights,
            leave_out=loss.leave_out,
        )
        self._sh_rest = scene.sh_rest.to(rasterizer.device)
        self._means = scene.means.to(rasterizer.device)
        self._rest: Shelf[int, Tensor] = Shelf(memory // 8, _tensor_bytes)
        self._coverage: Shelf[int, Tensor] = Shelf(memory // 8, _tensor_bytes)
        self._warps: Shelf[tuple[int, int], Warp] = Shelf(memory // 2, lambda warp: warp.nbytes)
        self._picture_memory = memory // 4
        parents = neighbors([cameras[index] for index in covered])
        self.cameras = [between(*pair) for pair in parents]
        self.views, self.pairs = self._choose(parents, most)

    def _choose(
        self, parents: list[tuple[Camera, Camera]], most: int
    ) -> tuple[list[int], dict[int, list[tuple[int, int]]]]:
        """Views and pairs to measure, evenly spread over the novel views; those inside of something are dropped."""
        count = len(self.cameras)
        pairs = {gap: view_pairs(count, gap, most) for gap in (SHORT_RANGE, LONG_RANGE)}
        # the first views of the short pairs: they have to be rendered anyway, and are as even
        views = [i for i, _ in pairs[SHORT_RANGE]] or list(range(min(count, most)))
        used = {*views, *(index for chosen in pairs.values() for pair in chosen for index in pair)}
        rough, rasterizer = self.scene, self.rasterizer
        if self._rasterizer_of is not None and len(rough) > _OUTLOOK_GAUSSIANS:
            rough = sampled(rough, _OUTLOOK_GAUSSIANS)
            rasterizer = self._rasterizer_of(rough)
        looks: dict[CameraKey, tuple[float, float | None]] = {}  # a camera is the neighbor of two

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
        """Whether a novel camera sees much the same as its neighbors do, rather than the inside of something."""
        (covered, depth), *others = (outlook(view) for view in (camera, *parents))
        return (
            covered > 0
            and _alike(covered, [other[0] for other in others])
            and (depth is None or _alike(depth, [other[1] for other in others if other[1] is not None]))
        )

    @torch.no_grad()
    def measure(self, sh_dc: Tensor) -> NovelViewMoment:
        """Measure the scene with colors sh_dc [N, 3].

        Raises:
            ValueError: a picture holds NaN or infinity.
        """
        pictures: Shelf[int, Tensor] = Shelf(self._picture_memory, _tensor_bytes)
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
        """Picture [H, W, 3] of a novel view, as a screen shows it."""
        camera = self.cameras[index]
        if self.scene.sh_degree == 0:
            rest = torch.zeros((), dtype=sh_dc.dtype, device=sh_dc.device)
        else:
            rest = self._rest.get(index, lambda: rest_colors(self._sh_rest, self._means, camera))
        return shown(self.rasterizer.render(view_colors(sh_dc, rest), camera), camera, self.rasterizer.device)

    def _gram(self, picture: Callable[[int], Tensor]) -> dict[int, float]:
        """Scale to Gram distance, the mean over the views that have the scale."""
        values: dict[int, list[float]] = {}
        for index in self.views:
            image, coverage = picture(index), None
            if self.weighted:
                coverage = self._coverage.get(index, partial(self.rasterizer.coverage, self.cameras[index]))
            target = self._loss.view_target(image, coverage)
            if self._maps is not None:
                shares = self._maps.render(self.cameras[index]).unbind(2)
                target.regions = [self._loss.position_weights(share) for share in shares]
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
        """How view j's picture is brought into view i."""
        depth, other = (expected_depth(self.scene, self.cameras[k], self.rasterizer) for k in (i, j))
        return find_warp(other, self.cameras[j], depth, self.cameras[i])


def _outlook(camera: Camera, scene: Scene, rasterizer: Rasterizer) -> tuple[float, float | None]:
    """Mean coverage of a view, 0 if nothing can be seen, and median depth where it is known."""
    small = resized(camera, min(_OUTLOOK_SIDE, camera.side))
    coverage = rasterizer.coverage(small)
    seen = sees_something(coverage)
    depth = expected_depth(scene, small, rasterizer)
    known = depth.depth[depth.known]
    return float(coverage.mean()) if seen else 0.0, float(known.median()) if len(known) else None


def _alike(value: float, others: list[float]) -> bool:
    """Whether a value is not far outside the others' range; true where there are none."""
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
