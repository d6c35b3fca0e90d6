"""An orbit around a scene: which way is up, and rings of cameras as far as they show more of its surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.constants import NEAR
from sgsst_core.planning.plan import Decision
from sgsst_core.planning.survey import Survey
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene, sampled
from sgsst_core.scene.orbit import ELEVATION, middle_of, orbit
from sgsst_core.scene.subject import Subject, find_subject
from sgsst_core.scene.up import Up, find_up

#: Elevations, degrees, of the rings that may be added to the first; those from below to a subject by itself, that
#: neither a ground nor a room is under.
_ABOVE, _BELOW = (40.0, 70.0), (-20.0,)
#: A ring is added where it shows so much more of the surface.
_LITTLE = 0.03
#: Views of a level ring whose number is left to need: 49 with all rings.
_AROUND = 16
#: Views of a ring, at least, where there are several.
_LEAST_VIEWS = 6
#: What is seen at so much of the area at which it can be seen best (a surface turned by 45 degrees) is seen.
_ENOUGH = 0.7
#: What is seen at less than this share of its own area lies inside, and how much may do so without a word.
_HARDLY, _INSIDE = 0.02, 0.3
#: Trial views: of a level ring, their resolution, and Gaussians that are looked at.
_TRIALS, _TRIAL_SIDE, _TRIAL_GAUSSIANS = 8, 160, 50_000
#: A view of which less shows the subject is one of what stands before it.
_SHOWS = 0.7
#: Share of a scene that may lie outside its subject without a word.
_OUTSIDE = 0.03


@dataclass(frozen=True)
class OrbitRequest:
    """What is asked of an orbit; None leaves it to the scene.

    Attributes:
        count: of views.
        up: [3] world direction.
        elevation: of its one ring, degrees.
        radius: distance of the cameras from the middle, world units.
        near: near plane, world units.
    """

    count: int | None = None
    up: tuple[float, float, float] | None = None
    elevation: float | None = None
    radius: float | None = None
    near: float = NEAR


@dataclass(frozen=True)
class Orbit:
    """An orbit's cameras, and why they are these.

    Attributes:
        cameras: ring by ring.
        up: which way is up, and why.
        elevations: of the rings, degrees.
        radius: distance of the cameras from the subject's middle, world units.
        tried: elevations that were tried.
        shown: share of the surface that the rings show, of what all that were tried would.
        next: what the best of the other rings would add to it; None where there is none.
        outside: share of the scene that is no part of the subject.
        hidden: share of the trial views that show more of other things than they may.
        inside: share of the surface that none of the trial views shows.
    """

    cameras: list[Camera]
    up: Up
    elevations: tuple[float, ...]
    radius: float
    tried: tuple[float, ...]
    shown: float
    next: float | None
    outside: float
    hidden: float
    inside: float


def make_orbit(scene: Scene, request: OrbitRequest) -> Orbit:
    """The orbit that was asked for, and the rest of it by need.

    Raises:
        SettingsError: see `scene.orbit.orbit`.
    """
    subject = find_subject(scene)
    up = find_up(subject) if request.up is None else _asked_up(request.up)
    first = ELEVATION if request.elevation is None else request.elevation
    rings = request.count // _LEAST_VIEWS if request.count is not None else 1 + len(_ABOVE + _BELOW)
    tried = [first]
    if request.elevation is None and rings > 1:
        alone = not up.ground and subject.left_out <= _OUTSIDE
        tried += [*_ABOVE, *(_BELOW if alone else ())]
    trial = _Trial(scene, subject, up, request)
    views = [trial.of_ring(elevation) for elevation in tried]
    chosen, shown, left = _needed([view.areas for view in views], max(rings, 1))
    elevations = tuple(tried[ring] for ring in chosen)
    count = request.count
    if count is None:
        count = sum(max(_LEAST_VIEWS, round(_AROUND * math.cos(math.radians(angle)))) for angle in elevations)
    cameras = trial.cameras(count, elevations)
    radius = float((cameras[0].center - middle_of(subject, up.direction)).norm())
    hidden = [share < _SHOWS for ring in chosen for share in views[ring].subject]
    return Orbit(
        cameras,
        up,
        elevations,
        radius,
        tuple(tried),
        shown,
        left,
        subject.left_out,
        sum(hidden) / len(hidden),
        trial.share_inside([view.areas for view in views]),
    )


def orbit_decisions(made: Orbit, cameras: Sequence[Camera], looked: Survey) -> list[Decision]:
    """What was decided about an orbit, for the plan.

    Args:
        cameras: as they are stylized, in their sizes.
        looked: what they show.
    """
    decisions = [Decision("up", made.up.name, made.up.reason)]
    angles = _listed([f"{angle:g}" for angle in made.elevations])
    rings = f"{len(made.elevations)} rings" if len(made.elevations) > 1 else "a ring"
    reason = "as asked for"
    if len(made.tried) > 1:
        others = f"rings at {min(made.tried):g} to {max(made.tried):g} degrees"
        reason = f"they show {made.shown:.0%} of the surface that {others} show"
        reason += f"; another one would add {made.next:.1%}" if made.next is not None else ""
    views = f"{len(cameras)} view{'s' if len(cameras) > 1 else ''}"
    decisions.append(
        Decision("cameras", f"{views} in {rings} at {angles} degrees, {made.radius:.3g} from the middle", reason)
    )
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    shapes = f"{sizes[0][0]}x{sizes[0][1]}"
    shapes += f" to {sizes[-1][0]}x{sizes[-1][1]}, {len(sizes)} shapes" if len(sizes) > 1 else ""
    if looked.uncovered is not None:
        covered = [1 - share for share in looked.uncovered]
        shown = f"the scene covers {sum(covered) / len(covered):.0%} of their pixels ({min(covered):.0%} at least)"
        decisions.append(Decision("frames", shapes, f"they follow the subject's shape; {shown}"))
    return decisions + _doubts(made)


def _doubts(made: Orbit) -> list[Decision]:
    """What speaks against an orbit around this scene."""
    found = []
    better = "cameras of its capture (--cameras) would show it better"
    if made.outside > _OUTSIDE:
        decision = f"warning: {made.outside:.0%} of the scene lies around what is framed"
        found.append(Decision("subject", decision, f"it is no single object; {better}"))
    if made.hidden:
        decision = f"warning: in {made.hidden:.0%} of the views, other things hide the subject"
        found.append(Decision("subject", decision, f"the cameras stand beyond what is around it; {better}"))
    if made.inside > _INSIDE:
        decision = f"warning: {made.inside:.0%} of the scene lies inside, where no view from around it looks"
        found.append(Decision("subject", decision, f"it may be a room; {better}"))
    return found


def _asked_up(direction: tuple[float, float, float]) -> Up:
    axis = torch.tensor(direction, dtype=torch.float64)
    return Up(axis / axis.norm().clamp_min(1e-300), "as asked for")


def _listed(words: Sequence[str]) -> str:
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"


@dataclass(frozen=True)
class _Ring:
    """What the trial views of a ring show.

    Attributes:
        areas: [n], of each Gaussian the largest area that one of them shows, in world units.
        subject: for each view that shows anything, the share of that which is the subject.
    """

    areas: Tensor
    subject: list[float]


class _Trial:
    """Small views of a scene, or of some of its Gaussians enlarged, that tell what rings show."""

    def __init__(self, scene: Scene, subject: Subject, up: Up, request: OrbitRequest) -> None:
        self._subject, self._up, self._request = subject, up, request
        colorless = replace(scene, sh_rest=scene.means.new_zeros((len(scene), 0, 3)))
        self._scene = sampled(colorless, _TRIAL_GAUSSIANS)
        self._rasterizer = make_rasterizer("cpu", self._scene, near=request.near)
        self._framed = subject.holds(self._scene.means)

    def cameras(self, count: int, elevations: Sequence[float]) -> list[Camera]:
        """Those of the orbit with these rings."""
        axis, request = self._up.direction.tolist(), self._request
        return orbit(self._subject, count, up=axis, elevations=elevations, radius=request.radius, near=request.near)

    def share_inside(self, areas: Sequence[Tensor]) -> float:
        """How much of the surface is hidden from all rings, of which each shows some areas [n]."""
        lengths = self._scene.scales.double().clamp(-60, 60).exp().sort(dim=1).values
        own = 2 * math.pi * torch.sigmoid(self._scene.opacities.double()) * lengths[:, 1] * lengths[:, 2]
        shown = torch.stack(list(areas)).amax(0)
        return float(own[shown < _HARDLY * own].sum() / own.sum().clamp_min(1e-300))

    def of_ring(self, elevation: float) -> _Ring:
        """What a ring shows."""
        count = max(4, round(_TRIALS * math.cos(math.radians(elevation))))
        areas = torch.zeros(len(self._scene), dtype=torch.float64)
        subject = []
        for camera in self.cameras(count, [elevation]):
            small = resized(camera, _TRIAL_SIDE)
            weights = self._rasterizer.survey(small)[1].double()
            depths = self._scene.means.double() @ small.world_to_camera[2, :3] + small.world_to_camera[2, 3]
            # a pixel shows so much area at a depth, across the view
            shown = weights * (depths / small.fx) ** 2
            areas = torch.maximum(areas, shown)
            if float(shown.sum()) > 0:
                subject.append(float(shown[self._framed].sum() / shown.sum()))
        return _Ring(areas, subject or [1.0])


def _needed(areas: Sequence[Tensor], most: int) -> tuple[list[int], float, float | None]:
    """Which rings show the surface: the first, then the one that adds most, until the next would add little.

    Rings' share of the surface is the sum over all Gaussians of the largest area [n] that one of their views shows,
    over that of the views of all rings. What is seen from the side counts for as much as is seen of it, and for all
    from `_ENOUGH` on.

    Args:
        areas: of each ring.
        most: of the rings to choose.

    Returns:
        The rings chosen, in the order of `areas`; the share that they show; what the best of the others would add.
    """
    best_of_all = torch.stack(list(areas)).amax(0)
    areas = [(area / _ENOUGH).minimum(best_of_all) for area in areas]
    whole = float(best_of_all.sum()) or 1.0
    chosen, seen = [0], areas[0]
    while True:
        gains = {
            ring: float((torch.maximum(seen, areas[ring]) - seen).sum()) / whole
            for ring in range(len(areas))
            if ring not in chosen
        }
        best = max(gains, key=lambda ring: gains[ring], default=None)
        if best is None or gains[best] < _LITTLE or len(chosen) >= most:
            return sorted(chosen), float(seen.sum()) / whole, gains[best] if best is not None else None
        chosen.append(best)
        seen = torch.maximum(seen, areas[best])
