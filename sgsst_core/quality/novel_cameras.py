"""Placement of novel cameras between the cameras of a job, and choice of those to measure."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

import torch

from sgsst_core.planning.survey import sees_something
from sgsst_core.quality.consistency import LONG_RANGE, SHORT_RANGE, expected_depth, view_pairs
from sgsst_core.rasterizer import Rasterizer
from sgsst_core.rasterizer.base import CameraKey, camera_key
from sgsst_core.scene.camera import Camera, between, resized
from sgsst_core.scene.camera_path import moved, nearest_walk, similarly_rotated
from sgsst_core.scene.gaussians import Scene, sampled

#: Distance, relative to the median distance of consecutive cameras, beyond which two cameras are not neighbors. The
#: capture was probably interrupted between them.
JUMP = 4.0
#: Maximum factor by which the median depth and the coverage of a novel view may lie outside the range of its neighbors'
#: values. They exceed it inside an object or behind a wall. On the chord between two cameras of a 60-degree arc, they
#: change by at most a third.
LIKENESS = 2.0
#: Longer side in pixels of the small renders that are checked for depth and coverage.
_OUTLOOK_SIDE = 160
#: Maximum number of Gaussians in these renders. Larger scenes are sampled, and sampled Gaussians are enlarged to cover
#: the same area.
_OUTLOOK_GAUSSIANS = 250_000


#: Mean coverage of a view (0 if it sees nothing), and its median depth (None if unknown).
Outlook = tuple[float, float | None]


def neighbors(cameras: list[Camera]) -> list[tuple[Camera, Camera]]:
    """Return the pairs of neighboring cameras between which novel cameras are placed.

    Adjacent cameras of the list are paired. If most of them are not neighbors (see `JUMP` and `LARGEST_ROTATION`), the
    list is assumed not to be in capture order, and a greedy walk to the nearest remaining camera replaces it. Pairs
    with the same pose are omitted. The result is empty for fewer than two cameras.
    """
    if len(cameras) < 2:
        return []
    centers = torch.stack([camera.center for camera in cameras])
    rotations = torch.stack([camera.world_to_camera[:3, :3].double() for camera in cameras])
    walk = nearest_walk(centers, rotations)
    steps = (centers[walk[1:]] - centers[walk[:-1]]).norm(dim=1)
    moves = steps[torch.from_numpy(moved(steps.numpy(), centers.numpy()))]
    reach = JUMP * float(moves.median()) if len(moves) else math.inf

    def pairs(order: Sequence[int]) -> list[tuple[Camera, Camera]]:
        return [
            (cameras[i], cameras[j])
            for i, j in itertools.pairwise(order)
            if float((centers[i] - centers[j]).norm()) <= reach
            and bool(similarly_rotated(rotations[i], rotations[j]))
            and not torch.allclose(cameras[i].world_to_camera, cameras[j].world_to_camera)
        ]

    in_order = pairs(range(len(cameras)))
    return in_order if 2 * len(in_order) >= len(cameras) - 1 else max(in_order, pairs(walk), key=len)


def choose_novel_cameras(
    cameras: list[Camera],
    scene: Scene,
    rasterizer: Rasterizer,
    *,
    most: int,
    rasterizer_of: Callable[[Scene], Rasterizer] | None = None,
) -> tuple[list[Camera], list[int], dict[int, list[tuple[int, int]]]]:
    """Place a camera halfway between neighbors, and choose what to measure: evenly spread, never inside an object.

    Args:
        cameras: Cameras of the job that see at least one Gaussian.
        most: Maximum number of views whose Gram distance is measured, and of pairs compared per range.
        rasterizer_of: Function that creates a rasterizer for a sample of the Gaussians, used to check depth and
            coverage in large scenes; None uses the whole scene.

    Returns:
        All novel cameras, the indices of the views whose Gram distance is measured (if there are none, there is nothing
        to measure), and pairs of views to compare, by gap.
    """
    parents = neighbors(cameras)
    novel = [between(*pair) for pair in parents]
    pairs = {gap: view_pairs(len(novel), gap, most) for gap in (SHORT_RANGE, LONG_RANGE)}
    # Use the first views of the short-range pairs: they are rendered anyway, and spread just as evenly.
    views = [i for i, _ in pairs[SHORT_RANGE]] or list(range(min(len(novel), most)))
    used = {*views, *(index for chosen in pairs.values() for pair in chosen for index in pair)}
    if rasterizer_of is not None and len(scene) > _OUTLOOK_GAUSSIANS:
        scene = sampled(scene, _OUTLOOK_GAUSSIANS)
        rasterizer = rasterizer_of(scene)
    outlooks: dict[CameraKey, Outlook] = {}  # by camera, because a camera is a neighbor of two views

    def outlook(camera: Camera) -> Outlook:
        key, small = camera_key(camera), resized(camera, min(_OUTLOOK_SIDE, camera.side))
        if key not in outlooks:
            coverage, depth = rasterizer.coverage(small), expected_depth(scene, small, rasterizer)
            known = depth.depth[depth.known]
            covered = float(coverage.mean()) if sees_something(coverage) else 0.0
            outlooks[key] = covered, float(known.median()) if len(known) else None
        return outlooks[key]

    clear = {index for index in used if _is_clear(novel[index], parents[index], outlook)}
    return (
        novel,
        [index for index in views if index in clear],
        {gap: [pair for pair in chosen if clear.issuperset(pair)] for gap, chosen in pairs.items()},
    )


def _is_clear(camera: Camera, parents: tuple[Camera, Camera], outlook: Callable[[Camera], Outlook]) -> bool:
    """Return whether depth and coverage of a novel view resemble its neighbors', unlike inside an object."""
    (covered, depth), *others = (outlook(view) for view in (camera, *parents))
    return (
        covered > 0
        and _alike(covered, [other[0] for other in others])
        and (depth is None or _alike(depth, [other[1] for other in others if other[1] is not None]))
    )


def _alike(value: float, others: list[float]) -> bool:
    """Return whether a value is within `LIKENESS` of the range of `others`; true if `others` is empty."""
    return not others or min(others) / LIKENESS <= value <= LIKENESS * max(others)
