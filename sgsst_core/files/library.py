"""Functions with which users of the library read inputs and save results."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TypeVar

import torch

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import RESULT_FORMATS, RESULT_SUFFIXES, format_of_name
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.spz import SpzAxes
from sgsst_core.files.scene_file import SceneFile, losses, read_scene, write_scene
from sgsst_core.files.stylized_ply import write_stylized
from sgsst_core.files.trainer_checkpoints import (
    CHECKPOINT_SUFFIXES,
    Splats,
    TrainerCheckpoint,
    is_trainer_checkpoint,
    read_checkpoint,
    scene_of_splats,
    stylized_splats,
    write_checkpoint,
)
from sgsst_core.refine.split import Refinement
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene, checked_scene

#: Scene in any form that the library accepts.
AnyScene = SceneFile | TrainerCheckpoint | Scene | Splats | torch.nn.ParameterDict
F = TypeVar("F", bound=AnyScene)


def load_scene(
    path: str | Path, *, drop_invalid: bool = False, spz_axes: SpzAxes = "auto"
) -> SceneFile | TrainerCheckpoint:
    """Read a scene file, or a checkpoint of gsplat's trainer or nerfstudio's splatfacto.

    The format is detected from the file's content. Checkpoints are loaded with `weights_only=True`.

    Args:
        drop_invalid: Whether to drop invalid Gaussians of a scene file; see `read_scene`.
        spz_axes: Axes of an SPZ file; see `read_scene`.

    Returns:
        File with its scene as attribute `scene`. `save` writes it back with all that it holds besides.

    Raises:
        SceneError: If the file cannot be used.

    Example:
        >>> source = load_scene("scene.ply")
        >>> tuple(source.scene.means.shape)
        (616, 3)
    """
    path = Path(path)
    if is_trainer_checkpoint(path):
        return read_checkpoint(path)
    return read_scene(path, drop_invalid=drop_invalid, spz_axes=spz_axes)


def load_cameras(path: str | Path) -> list[Camera]:
    """Read the cameras of a file or folder in any format; see `read_cameras`.

    Raises:
        CameraError: If the file is missing, its format is unknown, or a camera cannot be used.

    Example:
        >>> cameras = load_cameras("cameras.json")
        >>> cameras[0].width, cameras[0].height
        (64, 48)
    """
    return read_cameras(Path(path))


def save(path: str | Path, scene: AnyScene) -> None:
    """Write a scene to a file, atomically. The suffix of its name determines the format.

    A PLY of a scene that was read from one has all its bytes except colors (`write_stylized`). A checkpoint is written
    only for a scene that was read from one, and has all its other values.

    Args:
        scene: Scene in any of the accepted types.

    Raises:
        SceneError: If the scene cannot be used, or its file has changed since it was read.
        OutputError: If the suffix is unknown, or the file cannot be written.

    Example:
        >>> source = load_scene("scene.ply")
        >>> save("scene.spz", source)
        >>> len(load_scene("scene.spz").scene)
        616
    """
    path = Path(path)
    format = format_of_name(path.name)
    if isinstance(scene, TrainerCheckpoint) and path.suffix in CHECKPOINT_SUFFIXES:
        write_checkpoint(scene, path)
    elif format not in RESULT_FORMATS or format is None:
        raise OutputError(
            f"{path}: has no suffix that a scene can be written with. Use {RESULT_SUFFIXES}"
            f"{', or .pt or .ckpt' if isinstance(scene, TrainerCheckpoint) else ''}."
        )
    elif format is PLY and isinstance(scene, SceneFile) and scene.header is not None:
        write_stylized(scene, path, scene.scene.sh_dc, sh_attenuation=scene.sh_attenuation)
    else:
        write_scene(path, as_scene(scene), format, scene.axes if isinstance(scene, SceneFile) else "rub")
    for note in losses(as_scene(scene), format) if format else ():
        warnings.warn(f"{path.name}: {note}", stacklevel=2)


def as_scene(scene: AnyScene) -> Scene:
    """Return the Gaussians of a scene of any accepted type.

    Raises:
        SceneError: If the type is not accepted, or a value is wrong.
    """
    if isinstance(scene, SceneFile | TrainerCheckpoint):
        return scene.scene
    if isinstance(scene, Scene):
        return checked_scene(scene)
    if isinstance(scene, Mapping | torch.nn.ParameterDict):
        return scene_of_splats(dict(scene.items()))
    raise SceneError(
        f"The scene is a {type(scene).__name__}. Read files with `load_scene`, or give a `Scene` or a dictionary of "
        "tensors as in gsplat."
    )


def stylized(given: AnyScene, scene: Scene, refinement: Refinement | None, sh_attenuation: float) -> AnyScene:
    """Return a stylized scene, with its refinement and SH attenuation, as the type of the given unstylized one."""
    if isinstance(given, SceneFile | TrainerCheckpoint):
        return given.stylized(scene, refinement, sh_attenuation)
    if isinstance(given, Scene):
        return scene
    splats = stylized_splats(dict(given.items()), scene, refinement, sh_attenuation)
    return torch.nn.ParameterDict(splats) if isinstance(given, torch.nn.ParameterDict) else splats
