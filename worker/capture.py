"""Cameras and photos of a job, and what the plan says about them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from sgsst_core.errors import CameraError, SceneError
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.spz import SpzAxes, SpzHeader
from sgsst_core.files.images import (
    MAX_MISSING,
    Photo,
    PhotoFolder,
    check_photos,
    photo_name,
    some_names,
)
from sgsst_core.files.scene_file import SceneFile, read_scene
from sgsst_core.orbit import Orbit, OrbitRequest, find_subject, find_up, make_orbit
from sgsst_core.planning.survey import compare_photos, frame_warnings, implausible, shown_by
from sgsst_core.progress import Decision
from sgsst_core.scene.camera import Camera, fit_cameras, resized, spread, undistorted
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.rendering import CLASSIC
from sgsst_core.settings import Settings
from worker.job import SceneRequest

#: Axes of an SPZ scene are those under which a typical view shows this many times as many Gaussians.
_CLEARLY_MORE = 2.0
_ROTATED = "the scene is rotated by 180 degrees about x (rub: y up, z backward)"


@dataclass(frozen=True)
class Capture:
    """Cameras of a job and their photos.

    Attributes:
        cameras: Cameras at the requested resolution.
        orbit: Orbit that generated the cameras; None if they come from a file.
        names: Names of the photos of all requested cameras, including those of views that are left out.
        photos: Photo of each camera; None if the job uses unstylized renders.
        decisions: Decisions about cameras and photos for the plan.
    """

    cameras: list[Camera]
    orbit: Orbit | None
    names: tuple[str, ...]
    photos: list[Photo] | None = None
    decisions: tuple[Decision, ...] = ()

    def fitted(self, settings: Settings) -> Capture:
        """Return the capture with its cameras reduced to `settings.max_resolution`."""
        return replace(self, cameras=fit_cameras(self.cameras, settings))

    def with_photos(self, folder: Path | None) -> Capture:
        """Return the capture with the photos of a folder, without views that lack one.

        If the folder is None, views are compared with unstylized renders. Otherwise the frames of cameras with a lens
        shrink to what their undistorted photos show.

        Raises:
            ImageError: If photos are missing or do not fit; see `check_photos`.
            CameraError: If photos of a camera cannot be undistorted.
        """
        if folder is None:
            reason = "renders have no distortion, and there are no photos to undistort"
            about = _about_lenses(self.cameras, "only the pinhole part of the cameras is used", reason)
            return replace(self, decisions=(*self.decisions, *about))
        matches = check_photos(folder, self.cameras)
        missing = [photo_name(camera) for camera, photo in zip(self.cameras, matches, strict=True) if photo is None]
        used = [index for index, photo in enumerate(matches) if photo is not None]
        photos = [photo for photo in matches if photo is not None]
        cameras = [undistorted(self.cameras[index]) for index in used]
        width = min((new.width / self.cameras[i].width for new, i in zip(cameras, used, strict=True)), default=1.0)
        size = f"at least {width:.0%} of their width, as much as their photos fill" if width < 1 else "their size"
        lines = _about_lenses(cameras, "the photos are undistorted", f"views keep {size}")
        lines += _about_photos(cameras, photos, missing)
        if strangers := PhotoFolder(folder).strangers(self.names):
            reason = f"they have the name of no camera: {some_names(strangers)}"
            mostly = len(strangers) > MAX_MISSING * (len(strangers) + len(photos))
            text = f"{'warning: ' if mostly else ''}{len(strangers)} files are not used"
            lines.append(Decision("photos", text, reason))
        return replace(self, cameras=cameras, photos=photos, decisions=(*self.decisions, *lines))

    def checked(self, scene: Scene, near: float) -> Capture:
        """Return the capture with warnings if it does not fit a scene, and with its photos in the right orientation.

        Raises:
            CameraError: If the cameras see nearly nothing of the scene.
            ImageError: If a photo cannot be read.
        """
        if self.orbit is not None:
            return self
        decisions = [*implausible(scene.means, self.cameras), *frame_warnings(scene, self.cameras, near)]
        photos = self.photos
        if photos is not None:
            photos, about = compare_photos(scene, self.cameras, photos, near)
            decisions += about
        return replace(self, photos=photos, decisions=(*decisions, *self.decisions))


def read_capture(
    source: SceneRequest, scene: Scene, images: Path | None = None, remaining: Tensor | None = None
) -> Capture:
    """Read or generate the requested cameras, at the requested resolution, still without photos.

    Args:
        scene: Scene that an orbit surrounds.
        images: Folder of photos, for cameras whose file states no sizes.
        remaining: [N] bool, Gaussians that an orbit surrounds; None for all.

    Raises:
        CameraError: If the cameras cannot be used.
    """
    orbit = None
    decisions: list[Decision] = []
    if source.cameras is None:
        orbit = make_orbit(scene, orbit_request(source), remaining)
        cameras = list(orbit.cameras)
    else:
        cameras = read_cameras(source.cameras, images)
    names = tuple(dict.fromkeys(map(photo_name, cameras)))
    panoramas = len({camera.panorama for camera in cameras} - {None})
    if source.views is not None:
        cameras = spread(cameras, source.views)
    if source.resolution is not None:
        cameras = [resized(camera, source.resolution) for camera in cameras]
    if panoramas:
        reason = "views are pinholes: one for each face of a cube, with the panorama's pixels per degree in its middle"
        decisions.append(Decision("cameras", f"{panoramas} of {len(names)} are panoramas, six views each", reason))
    return Capture(cameras, orbit, names, decisions=tuple(decisions))


def choose_axes(source: SceneRequest, images: Path | None = None) -> tuple[SpzAxes, list[Decision]]:
    """Return the axes to read an SPZ scene with, and the line for the plan if cameras or the scene decide.

    If neither request nor file state them, they are those under which the cameras see the scene, or without cameras
    those under which it stands upright. If that does not decide, or `up` is requested, the axes stay "auto", and the
    scene gets a note. Nothing is raised: `read_scene` and `read_capture` report unusable files.
    """
    requested = source.spz_axes
    if requested != "auto":
        return requested, []
    try:
        header = read_scene_header(source.scene)
        if not isinstance(header, SpzHeader) or header.may_state_axes:
            return requested, []
        cameras = None
        if source.cameras is not None:
            cameras = read_cameras(source.cameras, images)
        scene = read_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes="rdf").scene
    except (SceneError, CameraError):
        return requested, []
    return _seen_axes(scene.means, cameras, source.near) if cameras else _upright_axes(scene, source.up)


def _upright_axes(scene: Scene, requested_up: str) -> tuple[SpzAxes, list[Decision]]:
    """Return the axes under which a scene that was read as RDF stands upright; see `choose_axes`."""
    up = find_up(find_subject(scene)) if requested_up == "auto" else None
    if up is None or not up.sure or up.name not in ("y", "-y"):
        return "auto", []
    reason = f"the file states none, and up is {up.name} in its values: {up.reason}; see --spz-axes"
    if up.name == "-y":
        return "rdf", [Decision("axes", "the scene is read as rdf: y down, z forward, as in a PLY", reason)]
    return "rub", [Decision("axes", _ROTATED, reason)]


def _seen_axes(means: Tensor, cameras: Sequence[Camera], near: float) -> tuple[SpzAxes, list[Decision]]:
    """Return the axes under which cameras see positions [N, 3] that were read as RDF; see `choose_axes`."""
    rdf = shown_by(means, cameras, near).typical
    rub = shown_by(means * means.new_tensor([1, -1, -1]), cameras, near).typical
    if rub <= _CLEARLY_MORE * rdf:
        return ("rdf" if rdf > _CLEARLY_MORE * rub else "auto"), []
    reason = f"a typical view has {rub:.1%} of the Gaussians in its frame so, and {rdf:.1%} with rdf; see --spz-axes"
    return "rub", [Decision("axes", _ROTATED, reason)]


def about_rendering(file: SceneFile) -> list[Decision]:
    """Return decisions about a non-classic render mode, and warnings about unreliable tags in the file."""
    tag, rendering = file.tag, file.scene.rendering
    lines = []
    if rendering != tag.rendering:
        states = f"the file states {tag.rendering.text}" if tag.reason else "the file states nothing"
        lines.append(Decision("rendering", rendering.text, f"as requested; {states}"))
    elif tag.reason and rendering != CLASSIC:
        lines.append(Decision("rendering", rendering.text, f"{tag.reason} says so; see --render-mode and --eps2d"))
    return [*lines, *(Decision("rendering", f"warning: drawn {drawn}", reason) for drawn, reason in tag.warnings)]


def about_notes(file: SceneFile) -> list[Decision]:
    """Return warnings about contents of a scene file that were not read, or not read as stored."""
    return [Decision("scene", "warning", note) for note in file.notes]


def orbit_request(source: SceneRequest) -> OrbitRequest:
    """Convert the orbit options of a request."""
    up = None
    if source.up != "auto":
        x, y, z = (float(name == source.up[-1]) * (-1.0 if source.up.startswith("-") else 1.0) for name in "xyz")
        up = (x, y, z)
    count = None if source.orbit in (None, "auto") else int(source.orbit)
    return OrbitRequest(count, up, source.elevation, source.radius, source.near)


def _about_lenses(cameras: Sequence[Camera], decision: str, reason: str) -> list[Decision]:
    """Return the decision about distorted cameras; nothing if there are none. Cube faces have no distortion."""
    distorted = [camera.lens.model for camera in cameras if camera.lens and camera.panorama is None]
    models, count = sorted(set(distorted)), len(distorted)
    about = f"{count} of {len(cameras)} cameras have lens distortion ({', '.join(models)})"
    return [Decision("lenses", decision, f"{about}; {reason}")] if models else []


def _about_photos(cameras: Sequence[Camera], photos: Sequence[Photo], missing: Sequence[str]) -> list[Decision]:
    """Return the decisions about missing, ambiguous and rotated photos."""
    lines = []
    if missing:
        left_out = f"warning: {len(missing)} of {len(missing) + len(photos)} views are left out"
        lines.append(Decision("photos", left_out, f"they have no photo: {some_names(missing)}"))
    single = [photo.path for camera, photo in zip(cameras, photos, strict=True) if camera.panorama is None]
    shared = [path.name for path, count in Counter(single).items() if count > 1]
    if shared:
        text = f"warning: {len(shared)} belong to several cameras each, of which they can show one"
        lines.append(Decision("photos", text, f"the names of these cameras are the same: {some_names(shared)}"))
    oriented = [photo for photo in photos if photo.oriented]
    if oriented:
        reason = f"without it they do not have the shapes of their cameras, such as {oriented[0].path.name}"
        lines.append(Decision("photos", f"the EXIF orientation of {len(oriented)} is applied", reason))
    return lines
