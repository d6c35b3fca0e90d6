"""Regions of a loaded scene: the selected Gaussians of each region, and its style images."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from sgsst_core.errors import ImageError
from sgsst_core.files.photos import Photo, find_masks, load_photo
from sgsst_core.files.scene_file import SceneFile, read_property
from sgsst_core.rasterizer import make_rasterizer
from sgsst_core.regions.definition import Region, Regions, check_regions
from sgsst_core.regions.selection import (
    count_votes,
    decide_by_votes,
    in_box,
    in_half_space,
    in_sphere,
    read_mask,
    where_property,
)
from sgsst_core.scene.camera import Camera
from sgsst_core.style import Style
from worker.region_requests import REST, RegionRequest, Selection
from worker.styles import StyleFile


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
        requests: Requested regions; see `worker.region_requests.region_requests`.
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
    """Return a flag for each Gaussian, [N] bool: whether the masks of some views select it. See `regions.masks`.

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
