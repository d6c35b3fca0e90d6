"""Blends of scenes that differ only in color: weighted means of their spherical harmonics."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import torch
from torch import Tensor

from sgsst_core.errors import SceneError, SettingsError
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.scene_format import SceneFormat
from sgsst_core.files.scene_file import SceneFile, encode_scene
from sgsst_core.files.stylized_ply import encode_stylized
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import held

#: Largest absolute weight after normalization. Larger ones amplify the rounding errors of the files.
MAX_WEIGHT = 10.0
#: Gaussians per block of float64 sums.
_BLOCK_ROWS = 1 << 18
#: Fields in which all scenes must be equal, and what they are called in messages.
_SHAPE = {"means": "positions", "quats": "rotations", "scales": "scales", "opacities": "opacities"}


def blend_scenes(files: Sequence[SceneFile], weights: Sequence[float]) -> SceneFile:
    """Return the weighted mean of scenes that differ only in their spherical harmonics.

    Colors before clamping are linear in the coefficients, so the blend's renders are exact blends as long as no color
    is clamped. A weight below 0 moves the blend away from its scene.

    Args:
        files: Scenes from `read_scene`, with the same Gaussians in the same order.
        weights: Weight of each scene. They are divided by their sum.

    Returns:
        First file with the blended scene, for `save`. If only its degree-0 coefficients differ, a PLY keeps all its
        other bytes.

    Raises:
        SettingsError: If a weight is not finite, their sum is not positive, or one is too far from the others.
        SceneError: If the scenes differ in more than color.
    """
    fractions = normalized(weights)
    first = files[0]
    for file in files[1:]:
        check_same_shape(first, file)
    scenes = [file.scene for file in files]
    scene = replace(first.scene, sh_dc=_weighted_sum([scene.sh_dc for scene in scenes], fractions))
    rests = common_rests(scenes)
    if all(torch.equal(rest, rests[0]) for rest in rests[1:]):
        return replace(first, scene=scene)
    # `write_stylized`, which preserves the bytes of a PLY, changes only colors
    return replace(first, scene=replace(scene, sh_rest=_weighted_sum(rests, fractions)), header=None)


def encode_blend(output: BinaryIO, blend: SceneFile, format: SceneFormat, target: Path) -> None:
    """Write a scene from `blend_scenes` to a stream as `save` would; `target` is named in messages.

    Raises:
        OutputError: If the format cannot represent the scene.
        SceneError: If the first scene's file has changed since it was read.
    """
    if format is PLY:
        encode_stylized(output, blend, blend.scene.sh_dc, target)
    else:
        encode_scene(output, blend.scene, format, target, axes=blend.axes)


def normalized(weights: Sequence[float]) -> list[float]:
    """Return weights divided by their sum.

    Raises:
        SettingsError: If a weight is not finite, their sum is not positive, or a result is larger than `MAX_WEIGHT`.
    """
    text = ", ".join(f"{weight:g}" for weight in weights)
    if not all(math.isfinite(weight) and abs(weight) <= 1e100 for weight in weights):  # sums remain finite
        raise SettingsError(f"The weights {text} are not all finite numbers. Give one for each scene, such as 0.7.")
    total = math.fsum(weights)
    if not total > 0:
        raise SettingsError(f"The weights {text} have the sum {total:g}. Give weights whose sum is greater than 0.")
    if max(map(abs, weights)) > MAX_WEIGHT * total:
        raise SettingsError(
            f"The weights {text} are too large for their sum {total:g}: each must be at most {MAX_WEIGHT:g} times as "
            "large. Give weights closer to each other."
        )
    return [weight / total for weight in weights]


def check_same_shape(first: SceneFile, file: SceneFile) -> None:
    """Raise a SceneError if two scenes differ in more than color."""
    if len(file.scene) != len(first.scene):
        raise SceneError(
            f"{file.path}: has {len(file.scene):,} Gaussians, but {first.path} has {len(first.scene):,}. Give scenes "
            "with the same Gaussians; refining splits some."
        )
    for name, title in _SHAPE.items():
        if not torch.equal(getattr(file.scene, name), getattr(first.scene, name)):
            raise SceneError(
                f"{file.path}: its Gaussians have other {title} than those of {first.path}. Give a scene and its "
                "results, all in the same format."
            )


def common_rests(scenes: Sequence[Scene]) -> list[Tensor]:
    """Return the coefficients above degree 0 of each scene, with zeros for bands that only others have."""
    most = max(scene.sh_rest.shape[1] for scene in scenes)
    rests = []
    for scene in scenes:
        rest = held(scene.sh_rest)
        missing = rest.new_zeros(len(rest), most - rest.shape[1], 3)
        rests.append(torch.cat([rest, missing], dim=1) if missing.numel() else rest)
    return rests


def _weighted_sum(tensors: Sequence[Tensor], weights: Sequence[float]) -> Tensor:
    """Return the weighted sum of float32 tensors of one shape, computed in float64."""
    result = torch.empty_like(tensors[0])
    largest = torch.finfo(result.dtype).max
    for start in range(0, len(result), _BLOCK_ROWS):
        rows = slice(start, start + _BLOCK_ROWS)
        total = torch.zeros(result[rows].shape, dtype=torch.float64)
        for tensor, weight in zip(tensors, weights, strict=True):
            total += weight * tensor[rows].double()
        result[rows] = total.clamp(-largest, largest)
    return result
