"""Readers of a job's inputs: scene, cameras, photos, style, regions and network weights.

The command line, the service's inspection process and every rank of a job use these readers, so that all of them
interpret the files in the same way.
"""

from __future__ import annotations

import json
import math
import socket
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from sgsst_core import container, errors
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.spz import SpzAxes, SpzHeader
from sgsst_core.files.images import (
    MAX_MISSING,
    WHITE,
    Color,
    Photo,
    PhotoFolder,
    check_names,
    check_photos,
    find_masks,
    image_size,
    load_image,
    load_photo,
    photo_name,
    some_names,
)
from sgsst_core.files.scene_file import SceneFile, read_property, read_scene
from sgsst_core.orbit import Orbit, OrbitRequest, find_subject, find_up, make_orbit
from sgsst_core.parallel import ALONE, Collectives
from sgsst_core.planning import survey
from sgsst_core.planning.plan import OPTIMIZER_BYTES, check_scales
from sgsst_core.planning.time_budget import TimeChoice
from sgsst_core.progress import Decision
from sgsst_core.rasterizer import Rasterizer, make_rasterizer
from sgsst_core.regions import (
    Region,
    Regions,
    check_regions,
    count_votes,
    decide_by_votes,
    in_box,
    in_half_space,
    in_sphere,
    read_mask,
    where_property,
)
from sgsst_core.scene.camera import Camera, fit_cameras, resized, spread, undistorted
from sgsst_core.scene.gaussians import Scene, sampled
from sgsst_core.scene.rendering import CLASSIC
from sgsst_core.settings import Settings
from sgsst_core.style import Style, normalized
from sgsst_core.stylizing.checkpoint import fingerprint
from sgsst_core.stylizing.styles import check_style_size
from worker.job import JobSpec, SceneRequest, check_choice
from worker.options import REST, RegionRequest, Selection, StyleFile

T = TypeVar("T")
#: Maximum number of pixels of all images of a style: as float32 they take 400 MB, and up to as much again while one of
#: them is resized to the views.
STYLE_PIXELS = 1 << 25
_REDUCED = "{}: was reduced when it was read, because the style has more than 33 megapixels"


class InputLimits(Protocol):
    """Limits of the inputs that a service accepts; every method raises an error if its limit is exceeded."""

    def check_count(self, count: int, growth: float) -> None:
        """Check the number of Gaussians that a scene file declares, times the factor of its refinement."""

    def check_cameras(self, cameras: Sequence[Camera]) -> None:
        """Check the number of views and their pixels."""

    def check_image(self, path: Path) -> None:
        """Check the number of pixels of an image."""


@dataclass(frozen=True)
class Inputs:
    """All inputs of a job.

    Attributes:
        style: Style images, [H, W, 3] in 0..1.
        scene_file: Scene, and which rows of its file were dropped.
        cameras: Cameras at the sizes at which the scene is stylized.
        orbit: Orbit that generated the cameras; None if they come from a file.
        photos: Photo of each camera for the content term; None if it uses unstylized renders.
        decisions: Decisions about scene, cameras and photos for the plan.
        regions: Regions of the scene; None if the job has none.
    """

    style: Style
    scene_file: SceneFile
    cameras: list[Camera]
    orbit: Orbit | None
    photos: list[Photo] | None
    decisions: tuple[Decision, ...]
    regions: Regions | None

    def chosen(self, choice: TimeChoice, settings: Settings) -> Inputs:
        """Return the inputs with the views of a time budget, given the settings that it has chosen."""
        photos = self.photos and choice.of(self.photos)
        return replace(self, cameras=fit_cameras(choice.of(self.cameras), settings), photos=photos)

    def photo_loader(self, background: Color) -> Callable[[int], Tensor] | None:
        """Return a function that loads the photo of a camera by its index; None if the job has no photos.

        Args:
            background: Background color of the job, which transparent parts of photos get as renders do.
        """
        photos, cameras = self.photos, self.cameras
        return (lambda index: load_photo(photos[index], cameras[index], background=background)) if photos else None


def read_inputs(request: JobSpec, collectives: Collectives = ALONE, limits: InputLimits | None = None) -> Inputs:
    """Read and check all inputs of a job. Every rank must call this function.

    Args:
        limits: Limits of a service. With them, every photo is read, a scene that no camera sees is found, and names of
            photos and masks must be those of cameras. None reads only what the job needs first.

    Raises:
        InvalidInputError: If an input cannot be used. Its attribute `role` is the input's role. Every rank raises the
            same error.
    """
    settings, images, source = request.settings, request.images, request.source
    with errors_of("scene"):
        if limits:
            limits.check_count(read_scene_header(source.scene).count, settings.growth)
    with errors_of("cameras"):
        if limits and source.cameras is not None and images is None:
            check_frames_have_sizes(source.cameras)
    with errors_of("style"):
        if limits:
            for file in (*request.styles, *(each for region in request.regions for each in region.styles)):
                limits.check_image(file.path)
        style = together(collectives, lambda: load_styles(request.styles, request.style_background))
    with errors_of("scene"):
        axes, about_axes = collectives.broadcast(lambda: choose_axes(source, images))
        if not limits:  # else it does not matter whether the memory of this machine suffices now
            together(collectives, lambda: check_memory(source.scene, collectives, settings.growth))
        read = partial(read_scene, source.scene, drop_invalid=source.drop_invalid, spz_axes=axes)
        scene_file = together(collectives, read).rendered(source.render_mode, source.eps2d)
    with errors_of("cameras"):
        check_choice(source)
        read_views = partial(read_job_capture, request, scene_file)
        # Every rank reads a camera file itself. Only rank 0 computes an orbit, since processors may round differently.
        capture = collectives.broadcast(read_views) if source.cameras is None else together(collectives, read_views)
        capture = capture.fitted(settings)
        cameras = capture.cameras
        if limits:
            limits.check_cameras(cameras)
        together(collectives, lambda: check_scales(settings.scales, cameras, settings.coarsest_side))
        if limits:
            check_something_in_view(scene_file.scene, cameras, source.near)
    with errors_of("style"):
        together(collectives, lambda: check_style_size(style, cameras, settings.style_scale))
    with errors_of("photos"):
        if limits and images is not None:
            check_names(images, capture.names)
        with_photos = together(collectives, lambda: capture.with_photos(images))
        if limits:
            for photo in with_photos.photos or []:
                limits.check_image(photo.path)
                load_image(photo.path)
    with errors_of("cameras"):
        capture = collectives.broadcast(lambda: with_photos.checked(scene_file.scene, source.near))
    with errors_of("mask"):
        if limits:
            _check_masks(request.regions, capture.names, limits)
    with errors_of("regions"):
        regions = read_regions(request, scene_file, capture.cameras, collectives)
    decisions = (*about_notes(scene_file), *about_axes, *about_rendering(scene_file), *capture.decisions)
    return Inputs(style, scene_file, capture.cameras, capture.orbit, capture.photos, decisions, regions)


def _check_masks(regions: Sequence[RegionRequest], names: Sequence[str], limits: InputLimits) -> None:
    """Check the names and sizes of mask images, given the names of the cameras."""
    for selection in (region.selection for region in regions):
        if selection and selection.kind == "masks" and selection.path:
            check_names(selection.path, names, masks=True)
            for path in sorted(selection.path.rglob("*")):
                if path.is_file():
                    limits.check_image(path)


@contextmanager
def errors_of(role: str) -> Iterator[None]:
    """Mark errors with the role of the input that they concern."""
    try:
        yield
    except BaseException as error:
        if not hasattr(error, "role"):
            error.role = "mask" if isinstance(error, errors.MaskError) else role  # type: ignore[attr-defined]
        raise


def check_frames_have_sizes(path: Path) -> None:
    """Check that the frames of a transforms.json, or of those in a folder, have image sizes.

    Without photos, the size would otherwise be read from the image file. Its path may point anywhere on this machine,
    and a message would reveal what exists there.

    Raises:
        CameraError: If a frame has no size.
    """
    for file in sorted(path.glob("*.json")) if path.is_dir() else [path]:
        try:
            content = json.loads(file.read_text(encoding="utf-8-sig"))
        except (ValueError, RecursionError):
            continue  # the reader reports the fault
        frames = content.get("frames") if isinstance(content, dict) else None
        for index, frame in enumerate(frames if isinstance(frames, list) else []):
            if isinstance(frame, dict) and any(frame.get(side) is None and content.get(side) is None for side in "wh"):
                raise errors.CameraError(
                    f"{file}: camera {index}: gives no size. Add the sizes of the images as 'w' and 'h'."
                )


def fingerprint_of(inputs: Inputs, settings: Settings, weights: str, collectives: Collectives) -> str:
    """Return the fingerprint of a job, after checking that all ranks have computed the same one.

    Args:
        weights: Digest of the feature network's weights.

    Raises:
        SettingsError: If ranks have read different files.
    """
    photos = inputs.photos
    stamps = collectives.broadcast(lambda: repr([*map(_stamp, photos)]) if photos else "")
    own = fingerprint(inputs.scene_file.scene, inputs.cameras, inputs.style, settings, weights, stamps, inputs.regions)
    fingerprints = collectives.all_gather((own, socket.gethostname()))
    for other, host in fingerprints:
        if other != fingerprints[0][0]:
            raise errors.SettingsError(
                f"The files of this job are not the same on {fingerprints[0][1]} and {host}: scene, cameras, style or "
                "weights differ. Give paths on a file system that all machines share."
            )
    return own


def read_regions(
    request: JobSpec, file: SceneFile, cameras: Sequence[Camera], collectives: Collectives = ALONE
) -> Regions | None:
    """Return the requested regions of a scene, or None if none are requested. Every rank must call this function.

    Raises:
        InvalidInputError: If a selection or a style cannot be used, or if every Gaussian is frozen. Every rank raises
            the same error.
    """
    settings, near = request.settings, request.source.near

    def load(files: Sequence[StyleFile]) -> Style:
        style = load_styles(files, request.style_background)
        check_style_size(style, cameras, settings.style_scale)
        return style

    # Only one rank selects: mask votes depend on renders, which different processors may round differently.
    return collectives.broadcast(
        lambda: select_regions(
            request.regions, file, cameras, near, load, settings.sh_attenuation, settings.content_weight
        )
    )


def load_styles(files: Sequence[StyleFile], background: Color = WHITE) -> Style:
    """Read the images of a style and normalize their weights.

    If they have more than `STYLE_PIXELS` together, those with more than their share of it are reduced first.

    Args:
        background: sRGB color behind transparent parts, in 0..1.

    Raises:
        ImageError: If an image cannot be used.
        SettingsError: If there are too many images, or if the weights cannot be normalized.
    """
    weights = normalized([file.weight for file in files])  # raises before any image is read
    sizes = [math.prod(image_size(file.path)) for file in files]
    most = STYLE_PIXELS // len(files) if sum(sizes) > STYLE_PIXELS else STYLE_PIXELS
    notes = [_REDUCED.format(file.path.name) for file, size in zip(files, sizes, strict=True) if size > most]
    images = tuple(load_image(file.path, background=background, warn=notes.append, max_pixels=most) for file in files)
    return Style(images, weights, tuple(file.path.name for file in files), tuple(notes))


def read_job_capture(request: JobSpec, file: SceneFile) -> Capture:
    """Read or generate the cameras of a job, given its scene; an orbit surrounds what a crop leaves.

    Raises:
        InvalidInputError: If cameras or regions cannot be used; see `read_capture`.
    """
    source = request.source
    remaining = cropped(request.regions, file, source.near) if source.cameras is None else None
    return read_capture(source, file.scene, request.images, remaining)


def read_scene_and_capture(source: SceneRequest) -> tuple[SceneFile, Capture]:
    """Read a scene and its requested cameras, and check that they belong together.

    Raises:
        SceneError: If the scene cannot be used.
        CameraError: If the options contradict each other, which is checked first, or the cameras cannot be used.
    """
    check_choice(source)
    file, decisions = read_requested(source)
    capture = read_capture(source, file.scene).checked(file.scene, source.near)
    return file, replace(capture, decisions=(*decisions, *capture.decisions))


def read_requested(source: SceneRequest) -> tuple[SceneFile, list[Decision]]:
    """Read a scene with the axes that its cameras suggest and the requested render mode; add decisions about both."""
    axes, decisions = choose_axes(source)
    file = read_scene(source.scene, drop_invalid=source.drop_invalid, spz_axes=axes)
    file = file.rendered(source.render_mode, source.eps2d)
    return file, [*about_notes(file), *decisions, *about_rendering(file)]


def check_something_seen(scene: Scene, cameras: Sequence[Camera], rasterizer: Rasterizer) -> None:
    """Check that at least one camera sees a Gaussian. Views are rendered until one shows a Gaussian.

    Raises:
        CameraError: If no camera sees a Gaussian.
    """
    if not any(survey.sees_something(rasterizer.coverage(camera)) for camera in cameras):
        raise survey.nothing_seen(scene.means, cameras, rasterizer.near)


#: Views that are rendered to find whether cameras see anything, and Gaussians in all of them together.
_MAX_VIEWS, _MAX_GAUSSIANS = 200, 50_000_000


def check_something_in_view(scene: Scene, cameras: Sequence[Camera], near: float) -> None:
    """Check that at least one camera sees a Gaussian, if possible without rendering.

    Views are rendered only if the centers of Gaussians are in no view (see `shown_by`), and from samples of Gaussians
    and cameras if there are many, because a service limits the time to read inputs.

    Raises:
        CameraError: If no camera sees a Gaussian.
    """
    if survey.shown_by(scene.means, cameras, near).together:
        return
    views = spread(cameras, _MAX_VIEWS)
    rasterizer = make_rasterizer("cpu", sampled(scene, _MAX_GAUSSIANS // len(views)), near=near, memory=0)
    if not any(survey.sees_something(rasterizer.coverage(camera)) for camera in views):
        raise survey.nothing_seen(scene.means, cameras, near)


def together(collectives: Collectives, make: Callable[[], T]) -> T:
    """Call `make` on every rank, and return this rank's result once all ranks have succeeded.

    Raises:
        SgsstError: If `make` raises it on any rank. Every rank then raises the error of the lowest failed rank.
    """
    value, error = None, None
    try:
        value = make()
    except errors.SgsstError as own:
        error = own
    for raised in collectives.all_gather(error):
        if raised is not None:
            raise raised
    return value  # type: ignore[return-value]


def same_weights(backbone: str, collectives: Collectives) -> BackboneWeights:
    """Load the weights of the feature network on every rank. Rank 0 chooses the network."""
    if collectives.size == 1:
        return load_network_weights(backbone)
    name = collectives.broadcast(lambda: load_network_weights(backbone).name)
    return together(collectives, lambda: load_network_weights(name))


def _stamp(photo: Photo) -> tuple[object, ...]:
    status = photo.path.stat()
    return (photo.path.name, status.st_size, status.st_mtime_ns, *(["oriented"] if photo.oriented else []))


# --- regions ----------------------------------------------------------------------------------------------------------


def select_regions(
    requests: Sequence[RegionRequest],
    file: SceneFile,
    cameras: Sequence[Camera],
    near: float,
    load: Callable[[Sequence[StyleFile]], Style],
    sh_attenuation: float = 0.0,
    content_weight: float = 1.0,
) -> Regions | None:
    """Return the requested regions of a scene, or None if none are requested.

    A Gaussian that several regions select belongs to the last of them.

    Args:
        requests: Requested regions; see `worker.options.region_requests`.
        cameras: Cameras that mask images may belong to, at the sizes at which the scene is stylized.
        near: Near plane in world units.
        load: Function that reads the images of a style.
        sh_attenuation: SH attenuation of the job, 0 to 1.

    Raises:
        InvalidInputError: If a file cannot be used, or the regions contradict each other or the job; see
            `check_regions`.
    """
    if not requests:
        return None
    labels = torch.zeros(len(file.scene), dtype=torch.uint8)
    every = [Region(REST)]
    for request in requests:
        style = load(request.styles) if request.styles else None
        if request.selection is None:
            every[0] = Region(REST, "", style, request.weight, request.freeze, content_weight=request.content_weight)
            continue
        own = select(request.selection, file, cameras, near)
        labels[own] = len(every)
        every.append(
            Region(
                request.name,
                request.selection.text,
                style,
                request.weight,
                request.freeze,
                int(own.sum()),
                request.content_weight,
            )
        )
    regions = Regions(tuple(every), labels)
    check_regions(regions, sh_attenuation, content_weight)
    return regions


def cropped(requests: Sequence[RegionRequest], file: SceneFile, near: float) -> Tensor | None:
    """Return the Gaussians that a crop leaves, [N] bool: those that are not frozen, if the rest is.

    Returns:
        None if the rest is not frozen, if nothing or everything remains, or if masks of views select, which belong to
        cameras.

    Raises:
        InvalidInputError: If a file cannot be used.
    """
    if not any(request.selection is None and request.freeze for request in requests):
        return None
    remaining = torch.zeros(len(file.scene), dtype=torch.bool)
    for request in requests:
        if request.selection is not None:
            if request.selection.kind == "masks":
                return None
            remaining[select(request.selection, file, (), near)] = not request.freeze
    return remaining if bool(remaining.any()) and not bool(remaining.all()) else None


def select(selection: Selection, file: SceneFile, cameras: Sequence[Camera], near: float) -> Tensor:
    """Return a flag for each Gaussian of a scene, [N] bool: whether the selection contains it. See `select_regions`."""
    means, numbers, path = file.scene.means, selection.numbers, selection.path
    match selection.kind:
        case "box":
            return in_box(means, numbers)
        case "sphere":
            return in_sphere(means, numbers)
        case "half-space":
            return in_half_space(means, numbers)
        case "property":
            return where_property(read_property(file, selection.name), selection.sign, numbers[0])
        case "mask":
            assert path is not None
            return read_mask(path, file)
        case "masks":
            assert path is not None
            return shown_by_masks(path, file, cameras, near)


def shown_by_masks(folder: Path, file: SceneFile, cameras: Sequence[Camera], near: float) -> Tensor:
    """Return a flag for each Gaussian, [N] bool: whether the masks of some views select it. See `sgsst_core.regions`.

    Raises:
        ImageError: If there are no masks, or if a mask cannot be used.
    """
    masked = [(camera, mask) for camera, mask in zip(cameras, find_masks(folder, cameras), strict=True) if mask]
    masks = [partial(_load_mask, mask, camera) for camera, mask in masked]
    rasterizer = make_rasterizer("cpu", file.scene, near=near)
    inside, total = count_votes(rasterizer, [camera for camera, _ in masked], masks, len(file.scene))
    if not bool((total > 0).any()):
        raise errors.ImageError(f"{folder}: no view that has a mask sees a Gaussian. Give masks of other views.")
    return decide_by_votes(file.scene.means, inside, total)


def _load_mask(mask: Photo, camera: Camera) -> Tensor:
    """Load a mask, [H, W] in 0..1; what is white and opaque is inside."""
    return load_photo(mask, camera, color_managed=False).mean(dim=2)


#: Bytes per Gaussian that a rank needs in addition to the scene and the optimizer: projection to a view (center, conic,
#: depth, extent, sorting keys), color in the view, and gradients of the view's color and of the optimized color.
VIEW_BYTES = 96


def check_memory(path: Path, collectives: Collectives, growth: float = 1.0) -> None:
    """Check that a scene, by the size in its header, fits into the free memory of this rank's machine and GPU.

    Args:
        growth: Factor by which refinement may increase the number of Gaussians.

    Raises:
        SceneError: If the header cannot be read.
        SceneTooLargeError: If the scene does not fit.
    """
    header = read_scene_header(path)
    count = int(header.count * growth)
    scene_bytes = int(header.count * 4 * (14 + 3 * header.coefficients) * growth)
    own = count * (OPTIMIZER_BYTES + VIEW_BYTES)
    # Every rank has the scene, and a copy of the Gaussians that its views show.
    ranks = collectives.local_size
    needs = [
        (f"of memory (ranks on this machine: {ranks})", ranks * (2 * scene_bytes + own), container.memory().available)
    ]
    if torch.cuda.is_available():
        needs.append((f"on its GPU ({torch.cuda.get_device_name()})", scene_bytes + own, torch.cuda.mem_get_info()[0]))
    for where, needed, free in needs:
        if needed > free:
            raise errors.SceneTooLargeError(
                f"Rank {collectives.rank} on {socket.gethostname()}: the scene's {count:,} Gaussians need "
                f"{needed / 1e9:.2f} GB {where}, but {free / 1e9:.2f} GB are free. Give a machine with more memory, "
                "fewer --workers on each, or a smaller scene."
            )


# --- cameras and photos, and what the plan says about them ------------------------------------------------------------

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
        lines = _about_lenses(cameras, "the photos are undistorted", "views keep what their photos fill")
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
        decisions = [*survey.implausible(scene.means, self.cameras), *survey.frame_warnings(scene, self.cameras, near)]
        photos = self.photos
        if photos is not None:
            photos, about = survey.compare_photos(scene, self.cameras, photos, near)
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
    except (errors.SceneError, errors.CameraError):
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
    rdf = survey.shown_by(means, cameras, near).typical
    rub = survey.shown_by(means * means.new_tensor([1, -1, -1]), cameras, near).typical
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
    """Return the decisions about missing and ambiguous photos."""
    lines = []
    if missing:
        left_out = f"warning: {len(missing)} of {len(missing) + len(photos)} views are left out"
        lines.append(Decision("photos", left_out, f"they have no photo: {some_names(missing)}"))
    single = [photo.path for camera, photo in zip(cameras, photos, strict=True) if camera.panorama is None]
    shared = [path.name for path, count in Counter(single).items() if count > 1]
    if shared:
        text = f"warning: {len(shared)} belong to several cameras each, of which they can show one"
        lines.append(Decision("photos", text, f"the names of these cameras are the same: {some_names(shared)}"))
    return lines
