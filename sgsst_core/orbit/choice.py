"""Choice of an orbit around a scene: the up direction, and rings of cameras that show enough of the surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from sgsst_core.constants import NEAR
from sgsst_core.orbit.cameras import ELEVATION, middle_of, orbit
from sgsst_core.orbit.subject import Subject, Up, find_subject, find_up
from sgsst_core.progress import Decision
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.scene.camera import Camera, resized
from sgsst_core.scene.gaussians import Scene, sampled, sampled_rows

#: Elevations in degrees of rings that may be added to the first. Rings below the horizon are only for an isolated
#: subject, without ground or background.
_ABOVE, _BELOW = (40.0, 70.0), (-20.0,)
#: Minimum fraction of the surface that a ring must add.
_LITTLE = 0.03
#: Default number of views of a ring at elevation 0. All rings together then have 49 views.
_AROUND = 16
#: Minimum number of views per ring if there are several rings.
_MIN_VIEWS = 6
#: Fraction of its largest visible area from which on a surface counts as fully seen: that of a surface rotated by 45
#: degrees.
_ENOUGH = 0.7
#: A surface counts as inside the scene if views show less than the first fraction of its area. The second is the
#: maximum fraction of such surfaces without a warning.
_HARDLY, _INSIDE = 0.02, 0.3
#: Trial views: number in a ring at elevation 0, resolution, and number of sampled Gaussians.
_TRIALS, _TRIAL_SIDE, _TRIAL_GAUSSIANS = 8, 160, 50_000
#: If the subject makes up less than this fraction of a view, other objects are assumed to hide it.
_SHOWS = 0.7
#: Maximum fraction of a scene outside its subject without a warning.
_OUTSIDE = 0.03


@dataclass(frozen=True)
class OrbitRequest:
    """Requested properties of an orbit; None to choose a value that suits the scene.

    Attributes:
        up: [3], world direction of up.
        elevation: Elevation in degrees of the orbit's only ring; None to choose one or several rings.
        radius: Distance of the cameras from the center in world units.
    """

    count: int | None = None
    up: tuple[float, float, float] | None = None
    elevation: float | None = None
    radius: float | None = None
    near: float = NEAR


@dataclass(frozen=True)
class Orbit:
    """Cameras of an orbit, and the reasons for their choice.

    Attributes:
        cameras: Cameras, ring by ring.
        up: Up direction with its reason.
        elevations: Elevations of the rings in degrees.
        radius: Distance of the cameras from the center of the subject in world units.
        tried: Elevations that were tried.
        shown: Surface that the rings show, as a fraction of what all tried rings would show.
        next: Fraction of that surface that the best remaining ring would add; None if no ring remains.
        outside: Fraction of the scene that is not part of the subject.
        hidden: Fraction of the trial views in which other objects hide too much of the subject.
        inside: Fraction of the surface that no trial view shows.
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


def make_orbit(scene: Scene, request: OrbitRequest, remaining: Tensor | None = None) -> Orbit:
    """Create the requested orbit, and choose everything that was not specified.

    Args:
        remaining: [N] bool, Gaussians of a cropped scene that the orbit surrounds; None for all. The others may still
            hide them, and show where up is.

    Raises:
        SettingsError: If an option is out of range; see `cameras.orbit`.
    """
    subject, up = find_upright_subject(scene, request.up, remaining)
    first = ELEVATION if request.elevation is None else request.elevation
    rings = request.count // _MIN_VIEWS if request.count is not None else 1 + len(_ABOVE + _BELOW)
    tried = [first]
    if request.elevation is None and rings > 1:
        alone = not up.ground and subject.left_out <= _OUTSIDE
        tried += [*_ABOVE, *(_BELOW if alone else ())]
    trial = _Trial(scene, subject, up, request, remaining)
    areas, fractions = zip(*(trial.of_ring(elevation) for elevation in tried), strict=True)
    chosen, shown, left = _needed(areas, max(rings, 1))
    elevations = tuple(tried[ring] for ring in chosen)
    count = request.count
    if count is None:
        count = sum(max(_MIN_VIEWS, round(_AROUND * math.cos(math.radians(angle)))) for angle in elevations)
    cameras = trial.cameras(count, elevations)
    radius = float((cameras[0].center - middle_of(subject, up.direction)).norm())
    hidden = [fraction < _SHOWS for ring in chosen for fraction in fractions[ring]]
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
        trial.hidden_fraction(areas),
    )


def find_upright_subject(
    scene: Scene, requested: tuple[float, float, float] | None, remaining: Tensor | None = None
) -> tuple[Subject, Up]:
    """Return the subject of a scene and its up direction.

    Args:
        requested: Up direction; None for that of the scene's file, or to estimate it.
        remaining: See `make_orbit`.
    """
    subject = whole = find_subject(scene)
    if remaining is not None:
        subject = find_subject(scene.subset(remaining))
    stated = requested or scene.up
    if stated is not None:
        axis = torch.tensor(stated, dtype=torch.float64)
        return subject, Up(axis / axis.norm().clamp_min(1e-300), "requested" if requested else "the file states it")
    up = find_up(subject)
    return subject, up if up.sure or subject is whole else find_up(whole)


def orbit_decisions(orbit: Orbit, cameras: Sequence[Camera], uncovered: Sequence[float] | None) -> list[Decision]:
    """Return the decisions about an orbit.

    Args:
        cameras: Its cameras at the sizes used for stylization.
        uncovered: Fraction of uncovered pixels of each view; None if unknown.
    """
    decisions = [Decision("up", orbit.up.name, orbit.up.reason)]
    *others, last = [f"{angle:g}" for angle in orbit.elevations]
    angles = f"{', '.join(others)} and {last}" if others else last
    rings = f"{len(orbit.elevations)} rings" if len(orbit.elevations) > 1 else "a ring"
    reason = "requested"
    if len(orbit.tried) > 1:
        tried = f"rings at {min(orbit.tried):g} to {max(orbit.tried):g} degrees"
        reason = f"they show {orbit.shown:.0%} of the surface that {tried} show"
        reason += f"; another ring would add {orbit.next:.1%}" if orbit.next is not None else ""
    views = f"{len(cameras)} view{'s' if len(cameras) > 1 else ''}"
    decisions.append(
        Decision("cameras", f"{views} in {rings} at {angles} degrees, {orbit.radius:.3g} from the center", reason)
    )
    sizes = sorted({(camera.width, camera.height) for camera in cameras})
    shapes = f"{sizes[0][0]}x{sizes[0][1]}"
    shapes += f" to {sizes[-1][0]}x{sizes[-1][1]}, {len(sizes)} shapes" if len(sizes) > 1 else ""
    if uncovered is not None:
        covered = [1 - fraction for fraction in uncovered]
        shown = f"the scene covers {sum(covered) / len(covered):.0%} of their pixels (at least {min(covered):.0%})"
        decisions.append(Decision("frames", shapes, f"fitted to the subject's shape; {shown}"))
    outside, hidden = f"{orbit.outside:.0%} of the scene lies", f"in {orbit.hidden:.0%} of the views, other objects"
    inside = f"{orbit.inside:.0%} of the scene lies inside, hidden from all views around it"
    doubts = (
        (orbit.outside > _OUTSIDE, f"{outside} outside the frames", "it is not a single object"),
        (orbit.hidden > 0, f"{hidden} hide the subject", "the cameras stand outside of its surroundings"),
        (orbit.inside > _INSIDE, inside, "it may be a room"),
    )
    for doubted, text, reason in doubts:
        if doubted:
            better = f"{reason}; the cameras of its capture (--cameras) would show it better"
            decisions.append(Decision("subject", f"warning: {text}", better))
    return decisions


class _Trial:
    """Renderer of small trial views of a scene, or of an enlarged sample of its Gaussians, for comparing rings."""

    def __init__(self, scene: Scene, subject: Subject, up: Up, request: OrbitRequest, remaining: Tensor | None) -> None:
        self._subject, self._up, self._request = subject, up, request
        colorless = replace(scene, sh_rest=scene.means.new_zeros((len(scene), 0, 3)))
        self._scene = sampled(colorless, _TRIAL_GAUSSIANS)
        self._rasterizer = make_rasterizer("cpu", self._scene, near=request.near)
        self._framed = subject.holds(self._scene.means)
        self._cropped = None if remaining is None else ~remaining[sampled_rows(len(scene), _TRIAL_GAUSSIANS)]

    def cameras(self, count: int, elevations: Sequence[float]) -> list[Camera]:
        """Return the cameras of the orbit with these rings."""
        axis, request = self._up.direction.tolist(), self._request
        return orbit(self._subject, count, up=axis, elevations=elevations, radius=request.radius, near=request.near)

    def hidden_fraction(self, areas: Sequence[Tensor]) -> float:
        """Return the fraction of the surface that is hidden from all rings, given the areas [n] that each shows."""
        lengths = self._scene.scales.double().clamp(-60, 60).exp().sort(dim=1).values
        surface = 2 * math.pi * torch.sigmoid(self._scene.opacities.double()) * lengths[:, 1] * lengths[:, 2]
        if self._cropped is not None:
            surface[self._cropped] = 0
        shown = torch.stack(list(areas)).amax(0)
        return float(surface[shown < _HARDLY * surface].sum() / surface.sum().clamp_min(1e-300))

    def of_ring(self, elevation: float) -> tuple[Tensor, list[float]]:
        """Render the trial views of a ring.

        Returns:
            Visible area of each Gaussian in the view that shows most of it, [n], in squared world units; and for each
            view that shows anything, the fraction of the visible area that belongs to the subject.
        """
        count = max(4, round(_TRIALS * math.cos(math.radians(elevation))))
        areas = torch.zeros(len(self._scene), dtype=torch.float64)
        subject = []
        for camera in self.cameras(count, [elevation]):
            small = resized(camera, _TRIAL_SIDE)
            weights = self._rasterizer.survey(small)[1].double()
            depths = self._scene.means.double() @ small.world_to_camera[2, :3] + small.world_to_camera[2, 3]
            # area of a pixel at this depth, perpendicular to the view
            shown = weights * (depths / small.fx) ** 2
            areas = torch.maximum(areas, shown)
            if float(shown.sum()) > 0:
                subject.append(float(shown[self._framed].sum() / shown.sum()))
        if self._cropped is not None:
            areas[self._cropped] = 0
        return areas, subject or [1.0]


def _needed(areas: Sequence[Tensor], most: int) -> tuple[list[int], float, float | None]:
    """Choose rings greedily: the first one, then repeatedly the one that adds most surface, until the gain is small.

    For each Gaussian, the view that shows most of it counts. The surface that a set of rings shows is the sum of these
    areas, relative to that of all rings. A Gaussian counts fully if a ring shows at least the fraction `_ENOUGH` of its
    largest area, and in proportion below that.

    Args:
        areas: Areas [n] for each ring.
        most: Maximum number of rings to choose.

    Returns:
        Indices of the chosen rings, ascending; fraction of the surface that they show; and fraction that the best other
        ring would add (None if there is none).
    """
    best_of_all = torch.stack(list(areas)).amax(0)
    areas = [(area / _ENOUGH).minimum(best_of_all) for area in areas]
    total = float(best_of_all.sum()) or 1.0
    chosen, covered = [0], areas[0]
    while True:
        gains = {
            ring: float((torch.maximum(covered, areas[ring]) - covered).sum()) / total
            for ring in range(len(areas))
            if ring not in chosen
        }
        best = max(gains, key=lambda ring: gains[ring], default=None)
        if best is None or gains[best] < _LITTLE or len(chosen) >= most:
            return sorted(chosen), float(covered.sum()) / total, gains[best] if best is not None else None
        chosen.append(best)
        covered = torch.maximum(covered, areas[best])
