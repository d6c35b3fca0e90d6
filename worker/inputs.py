"""Readers of a job's inputs: scene, cameras, style, photos, regions and network weights.

The command line, the service's inspection process and every rank of a job use these readers, so that all of them
interpret the files in the same way.

The lowest rank of a machine reads the scene and copies its arrays to an anonymous memory file (memfd). The other ranks
open that file through the /proc entry of the reader and map it copy-on-write: ranks share the pages, but cannot change
each other's data. The system frees the memory when the last process that uses it ends, so it cannot leak. Where there
are no such files (Windows, macOS), every rank reads the scene. The spherical harmonics of a large scene stay in its
file, which every rank opens.
"""

from __future__ import annotations

import json
import math
import mmap
import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from sgsst_core import container
from sgsst_core.errors import CameraError, ImageError, MaskError, SceneTooLargeError, SettingsError, SgsstError
from sgsst_core.features.network_weights import BackboneWeights, load_network_weights
from sgsst_core.files.formats import read_scene_header
from sgsst_core.files.formats.spz import SpzAxes
from sgsst_core.files.images import WHITE, Color, image_size, load_image
from sgsst_core.files.photos import Photo, check_names, find_masks, load_photo
from sgsst_core.files.scene_file import HELD_BYTES, SceneFile, read_property, read_scene, stays_in_file
from sgsst_core.files.stylized_ply import check_sh_attenuation
from sgsst_core.orbit import Orbit
from sgsst_core.parallel.collectives import ALONE, Collectives
from sgsst_core.planning.plan import OPTIMIZER_BYTES, check_scales
from sgsst_core.planning.survey import nothing_seen, sees_something
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
from sgsst_core.scene.camera import Camera, fit_cameras
from sgsst_core.scene.gaussians import TENSORS, Scene
from sgsst_core.scene.stored_harmonics import StoredHarmonics
from sgsst_core.settings import Settings
from sgsst_core.style import Style, normalized
from sgsst_core.stylizing.checkpoint import fingerprint
from sgsst_core.stylizing.styles import check_style_size
from worker.capture import Capture, about_background, about_notes, about_rendering, choose_axes, read_capture
from worker.job import JobSpec, SceneRequest, check_choice
from worker.options import REST, RegionRequest, Selection, StyleFile
from worker.processes import home

T = TypeVar("T")
#: Maximum number of pixels of all images of a style: as float32 they take 400 MB, and up to as much again while one of
#: them is resized to the views.
STYLE_PIXELS = 1 << 25
#: Number of Gaussians that are projected at once to find one in a view.
_BLOCK = 1 << 16
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
        reader: Whether this rank read the scene's file itself, as one rank of each machine does.
    """

    style: Style
    scene_file: SceneFile
    cameras: list[Camera]
    orbit: Orbit | None
    photos: list[Photo] | None
    decisions: tuple[Decision, ...]
    regions: Regions | None
    reader: bool

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
        axes, about_axes, about_color = collectives.broadcast(
            lambda: (*choose_axes(source, images), about_background(source.scene, settings.background))
        )
        scene_file, reader = _read_scene(request, axes, collectives, limits)
        together(collectives, lambda: check_sh_attenuation(scene_file, settings.sh_attenuation))
    with errors_of("cameras"):
        check_choice(source)
        capture = _capture_on_all_ranks(request, scene_file, collectives).fitted(settings)
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
    decisions = (*about_notes(scene_file), *about_axes, *about_rendering(scene_file), *about_color, *capture.decisions)
    return Inputs(style, scene_file, capture.cameras, capture.orbit, capture.photos, decisions, regions, reader)


def _read_scene(
    request: JobSpec, axes: SpzAxes, collectives: Collectives, limits: InputLimits | None
) -> tuple[SceneFile, bool]:
    """Return the scene in the requested render mode, and whether this rank read its file."""
    source, drop_invalid = request.source, request.source.drop_invalid
    if limits:  # whether the memory of this machine suffices now does not matter
        file, reader = read_scene(source.scene, drop_invalid=drop_invalid, spz_axes=axes), True
    else:
        growth = request.settings.growth
        file, reader = read_shared_scene(
            source.scene, collectives, drop_invalid=drop_invalid, growth=growth, spz_axes=axes
        )
    return file.rendered(source.render_mode, source.eps2d), reader


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
            error.role = "mask" if isinstance(error, MaskError) else role  # type: ignore[attr-defined]
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
                raise CameraError(f"{file}: camera {index}: gives no size. Add the sizes of the images as 'w' and 'h'.")


def fingerprint_of(inputs: Inputs, settings: Settings, weights: str, collectives: Collectives) -> str:
    """Return the fingerprint of a job, after checking that all ranks that read the scene computed the same one.

    Args:
        weights: Digest of the feature network's weights.

    Raises:
        SettingsError: If ranks have read different files.
    """
    photos = inputs.photos
    stamps = collectives.broadcast(lambda: repr([_stamp(photo) for photo in photos]) if photos else "")
    own = None
    if inputs.reader:
        own = fingerprint(
            inputs.scene_file.scene, inputs.cameras, inputs.style, settings, weights, stamps, inputs.regions
        )
    fingerprints = collectives.all_gather((own, socket.gethostname()))
    for other, host in fingerprints:
        if other is not None and other != fingerprints[0][0]:
            raise SettingsError(
                f"The files of this job are not the same on {fingerprints[0][1]} and {host}: scene, cameras, style or "
                "weights differ. Give paths on a file system that all machines share."
            )
    assert fingerprints[0][0] is not None  # rank 0 always reads the scene itself
    return fingerprints[0][0]


def read_regions(
    request: JobSpec, file: SceneFile, cameras: Sequence[Camera], collectives: Collectives = ALONE
) -> Regions | None:
    """Return the requested regions of a scene, or None if none are requested. Every rank must call this function.

    Raises:
        InvalidInputError: If a selection or a style cannot be used, or if every Gaussian is frozen. Every rank raises
            the same error.
    """
    if not request.regions:
        return None
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
    names = tuple(file.path.name for file in files)
    sizes = [math.prod(image_size(file.path)) for file in files]
    most = STYLE_PIXELS // len(files) if sum(sizes) > STYLE_PIXELS else STYLE_PIXELS
    notes = [_REDUCED.format(file.path.name) for file, size in zip(files, sizes, strict=True) if size > most]
    images = tuple(load_image(file.path, background=background, warn=notes.append, max_pixels=most) for file in files)
    return Style(images, weights, names, tuple(notes))


def _capture_on_all_ranks(request: JobSpec, file: SceneFile, collectives: Collectives) -> Capture:
    """Return the result of `read_job_capture`, the same on every rank.

    Every rank reads a camera file itself. Only rank 0 computes an orbit, since processors may round differently.
    """
    read = partial(read_job_capture, request, file)
    return collectives.broadcast(read) if request.source.cameras is None else together(collectives, read)


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
    if not any(sees_something(rasterizer.coverage(camera)) for camera in cameras):
        raise nothing_seen(scene.means, cameras, rasterizer.near)


def check_something_in_view(scene: Scene, cameras: Sequence[Camera], near: float) -> None:
    """Check that at least one camera sees a Gaussian, if possible without rendering.

    A Gaussian whose center projects into a view counts as seen. Views are rendered only if there is no such Gaussian.

    Raises:
        CameraError: If no camera sees a Gaussian.
    """
    for block in scene.means.split(_BLOCK):  # the first block usually decides
        means = block.double()
        for camera in cameras:
            x, y, z = (means @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]).unbind(1)
            across = camera.fx * x / z + camera.cx
            down = camera.fy * y / z + camera.cy
            inside = (z > near) & (across >= 0) & (across < camera.width) & (down >= 0) & (down < camera.height)
            if bool(inside.any()):
                return
    check_something_seen(scene, cameras, make_rasterizer("cpu", scene, near=near))


def together(collectives: Collectives, make: Callable[[], T]) -> T:
    """Call `make` on every rank, and return this rank's result once all ranks have succeeded.

    Raises:
        SgsstError: If `make` raises it on any rank. Every rank then raises the error of the lowest failed rank.
    """
    value, error = None, None
    try:
        value = make()
    except SgsstError as own:
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
        raise ImageError(f"{folder}: no view that has a mask sees a Gaussian. Give masks of other views.")
    return decide_by_votes(file.scene.means, inside, total)


def _load_mask(mask: Photo, camera: Camera) -> Tensor:
    """Load a mask, [H, W] in 0..1; what is white and opaque is inside."""
    return load_photo(mask, camera, color_managed=False).mean(dim=2)


# --- scene that the ranks of a machine share --------------------------------------------------------------------------

#: Bytes per Gaussian that a rank needs in addition to the scene and the optimizer: projection to a view (center, conic,
#: depth, extent, sorting keys), color in the view, and gradients of the view's color and of the optimized color.
VIEW_BYTES = 96
#: Arrays start at multiples of this many bytes, so that every dtype is aligned.
_ALIGNMENT = 64
_Layout = dict[str, tuple[int, tuple[int, ...], str]]  # offset, shape and numpy dtype by name


@dataclass(frozen=True)
class _Shared:
    """Location of a shared scene: the memory file of a process, and the layout of its arrays."""

    process: int
    descriptor: int
    size: int
    layout: _Layout
    file: SceneFile  # with empty arrays
    harmonics: tuple[Any, ...] | None  # arguments of StoredHarmonics, whose file must not be opened on other machines


def read_shared_scene(
    path: Path,
    collectives: Collectives,
    *,
    drop_invalid: bool = False,
    growth: float = 1.0,
    spz_axes: SpzAxes = "auto",
) -> tuple[SceneFile, bool]:
    """Read a scene once on each machine. Every rank must call this function.

    Args:
        drop_invalid: Whether to drop invalid Gaussians; see `read_scene`.
        growth: Factor by which refinement may increase the number of Gaussians. It scales the memory requirement, and
            lowers the size up to which spherical harmonics are loaded into memory.

    Returns:
        The scene, and whether this rank read the file itself. Exactly one rank of each machine does.

    Raises:
        SceneError: If the scene cannot be read; see `read_scene`. Every rank raises the same error.
        SceneTooLargeError: If the scene does not fit into the memory of a rank's machine or GPU.
    """
    homes = collectives.all_gather(home())
    reader = homes.index(home())
    sharing = homes.count(home())
    together(collectives, lambda: _check_memory(path, collectives.rank, sharing, growth))
    read = partial(read_scene, path, drop_invalid=drop_invalid, held_bytes=_held_bytes(growth), spz_axes=spz_axes)

    def read_first() -> tuple[SceneFile | None, _Shared | None]:
        """Read the scene if this rank does so for its machine, and share it with the others there."""
        if collectives.rank != reader:
            return None, None
        file = read()
        return _share(file) if sharing > 1 and hasattr(os, "memfd_create") else (file, None)

    own, shared = together(collectives, read_first)
    try:
        offer = collectives.all_gather(shared)[reader]
        if own is None and offer is not None:
            with suppress(OSError):  # some systems hide even the user's own processes in /proc
                own = _mapped(offer, f"/proc/{offer.process}/fd/{offer.descriptor}")
        if own is None:
            own = read()
        collectives.all_gather(None)  # barrier: the reader closes its memory file after all ranks have opened it
    finally:
        if shared is not None:
            os.close(shared.descriptor)
    return own, collectives.rank == reader


def _held_bytes(growth: float) -> int | None:
    """Return the maximum bytes of spherical harmonics in memory for a scene that may grow; None for the default."""
    return None if growth == 1 else int(HELD_BYTES / growth)


def _share(file: SceneFile) -> tuple[SceneFile, _Shared]:
    """Copy a scene to a memory file; return the scene mapped from there, and its location."""
    stored = file.scene.sh_rest if isinstance(file.scene.sh_rest, StoredHarmonics) else None
    tensors = {name: getattr(file.scene, name) for name in TENSORS}
    arrays: dict[str, NDArray[Any]] = {name: value.numpy() for name, value in tensors.items() if value is not stored}
    if file.retained is not None:
        arrays["retained"] = file.retained
    layout: _Layout = {}
    size = 0
    for name, array in arrays.items():
        layout[name] = (size, array.shape, array.dtype.str)
        size += -(-array.nbytes // _ALIGNMENT) * _ALIGNMENT
    descriptor = os.memfd_create("sgsst-scene", os.MFD_CLOEXEC)
    os.ftruncate(descriptor, size)
    with mmap.mmap(descriptor, size) as memory:
        for name, (offset, _, _) in layout.items():
            data = np.ascontiguousarray(arrays[name]).reshape(-1).view(np.uint8)
            memory[offset : offset + data.nbytes] = data.data
    nothing: dict[str, Any] = dict.fromkeys(TENSORS, torch.empty(0))
    empty = replace(file.scene, **nothing)
    in_file = None if stored is None else stored.arguments
    shared = _Shared(os.getpid(), descriptor, size, layout, replace(file, scene=empty, retained=None), in_file)
    return _mapped(shared, f"/proc/self/fd/{descriptor}"), shared


def _mapped(shared: _Shared, path: str) -> SceneFile:
    """Map the scene of a memory file."""
    with Path(path).open("rb") as file:
        memory = mmap.mmap(file.fileno(), shared.size, access=mmap.ACCESS_COPY)
    arrays = {}
    for name, (offset, shape, kind) in shared.layout.items():
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(memory, kind, count, offset).reshape(shape) if count else np.empty(shape, kind)
    retained = arrays.pop("retained", None)
    tensors: dict[str, Any] = {name: torch.from_numpy(array) for name, array in arrays.items()}
    if shared.harmonics is not None:
        tensors["sh_rest"] = StoredHarmonics(*shared.harmonics)
    return replace(shared.file, scene=replace(shared.file.scene, **tensors), retained=retained)


def _check_memory(path: Path, rank: int, sharing: int, growth: float) -> None:
    """Check that a scene, by the size in its header, fits into the free memory of this rank's machine and GPU.

    Args:
        sharing: Number of ranks on this machine.
        growth: Factor of growth; see `read_shared_scene`.

    Raises:
        SceneError: If the header cannot be read.
        SceneTooLargeError: If the scene does not fit.
    """
    header = read_scene_header(path)
    rest = 3 * header.coefficients
    held = 0 if stays_in_file(header, _held_bytes(growth)) else rest  # in memory
    sizes = header.count, header.count * 4 * (14 + held), header.count * 4 * (14 + rest)
    count, scene_bytes, device_bytes = (int(size * growth) for size in sizes)
    own = count * (OPTIMIZER_BYTES + VIEW_BYTES)
    each = scene_bytes + own  # every rank has its own copy of the Gaussians that its views show
    where = f"Rank {rank} on {socket.gethostname()}: the scene's {count:,} Gaussians need"
    advice = "Give a machine with more memory, fewer --workers on each, or a smaller scene."
    needed, free = scene_bytes + sharing * each, container.memory().available
    if needed > free:
        ranks = f"{sharing} ranks share it" if sharing > 1 else "there is one rank"
        raise SceneTooLargeError(
            f"{where} {needed / 1e9:.2f} GB of memory ({ranks}), but {free / 1e9:.2f} GB are free. {advice}"
        )
    if torch.cuda.is_available():
        free, total = torch.cuda.mem_get_info()
        needed = device_bytes + own
        if needed > free:
            raise SceneTooLargeError(
                f"{where} {needed / 1e9:.2f} GB on its GPU ({torch.cuda.get_device_name()}, {total / 1e9:.1f} GB), but "
                f"{free / 1e9:.2f} GB are free. {advice}"
            )
