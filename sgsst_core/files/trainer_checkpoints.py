"""Checkpoints of gsplat's trainer and of nerfstudio's splatfacto, whose colors are replaced.

A checkpoint is a pickle in a ZIP archive. PyTorch loads only tensors and plain values from it. Before that, its entries
are checked: they must be uncompressed, so that they cannot take more memory than the file is long.
"""

from __future__ import annotations

import pickle
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.formats import HEAD_BYTES
from sgsst_core.files.formats.unsupported import is_checkpoint, refuse_changed_meaning
from sgsst_core.files.scene_file import SceneFile, file_stamp
from sgsst_core.files.splats import SPLAT_KEYS, scene_of_splats, stylized_splats
from sgsst_core.refine.split import Refinement
from sgsst_core.scene.gaussians import Scene
from sgsst_core.scene.stored_harmonics import changed

#: File name suffixes of checkpoints.
CHECKPOINT_SUFFIXES = (".ckpt", ".pt", ".pth")
#: Names in nerfstudio's checkpoints, by those in gsplat's.
_NERFSTUDIO = {key: f"_model.gauss_params.{key}" for key in SPLAT_KEYS.values()} | {
    "sh0": "_model.gauss_params.features_dc",
    "shN": "_model.gauss_params.features_rest",
}
_EXPORT = (
    "Export the scene as PLY with the program that wrote it (`ns-export gaussian-splat` of nerfstudio); the original "
    "3DGS code has point_cloud/iteration_*/point_cloud.ply beside it."
)
#: NumPy's float64 scalar, which nerfstudio's learning rate schedules leave in a checkpoint, under both of its names.
_NUMPY_SCALARS: list[Any] = [
    *((np.float64().__reduce__()[0], f"numpy.{module}.multiarray.scalar") for module in ("core", "_core")),
    np.dtype,
    np.dtypes.Float64DType,
]


@dataclass(frozen=True)
class TrainerCheckpoint:
    """Checkpoint of a trainer, together with the information to write it back.

    Attributes:
        path: Path of the file.
        scene: Gaussians of the checkpoint.
        splats: Tensors of the checkpoint by gsplat's keys.
        stamp: Size in bytes and modification time in ns of the file when it was read.
    """

    path: Path
    scene: Scene
    splats: dict[str, Tensor]
    stamp: tuple[int, int]

    def scene_file(self) -> SceneFile:
        """Return the scene as that of a file of another format than PLY, which states no render mode."""
        return SceneFile(self.path, self.scene, None, None, self.stamp, "checkpoint")

    def stylized(self, scene: Scene, refinement: Refinement | None, sh_attenuation: float) -> TrainerCheckpoint:
        """Return the checkpoint of a stylized scene; see `stylized_splats`."""
        return replace(self, scene=scene, splats=stylized_splats(self.splats, scene, refinement, sh_attenuation))


def is_trainer_checkpoint(path: Path) -> bool:
    """Return whether a file is a checkpoint in a ZIP archive, as PyTorch has written them since version 1.6."""
    try:
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES)
    except OSError:
        return False
    return head.startswith(b"PK") and is_checkpoint(head)


def read_checkpoint(path: Path) -> TrainerCheckpoint:
    """Read the scene of a checkpoint of gsplat (`splats`) or nerfstudio (`pipeline`).

    Raises:
        SceneError: If the file cannot be read, holds anything but tensors and plain values, or holds no Gaussians.
    """
    stamp = file_stamp(path)
    tensors, names = _splats_in(path, _load(path))
    refuse_changed_meaning(path, (name.removeprefix("_model.gauss_params.") for name in tensors))
    splats = {key: tensors[name] for key, name in names.items() if name in tensors}
    try:
        scene = scene_of_splats(splats)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from error
    return TrainerCheckpoint(path, scene, splats, stamp)


def write_checkpoint(checkpoint: TrainerCheckpoint, target: Path) -> None:
    """Write a checkpoint with the tensors of `checkpoint.splats`, atomically. All its other values stay.

    Raises:
        SceneError: If the checkpoint's file has changed since it was read.
        OutputError: If the target cannot be written.
    """
    content = _load(checkpoint.path)
    if file_stamp(checkpoint.path) != checkpoint.stamp:
        raise changed(checkpoint.path)
    tensors, names = _splats_in(checkpoint.path, content)
    tensors.update({names[key]: value for key, value in checkpoint.splats.items()})
    with atomic_path(target) as temporary:
        try:
            torch.save(content, temporary)
        except RuntimeError as error:  # PyTorch's writer does not raise OSError
            raise OutputError(f"{target}: cannot be written: {error}. Free some space and run again.") from error


def _load(path: Path) -> Any:
    """Load tensors and plain values from a checkpoint, after checking the sizes of its entries."""
    try:
        with zipfile.ZipFile(path) as archive:
            entries = archive.infolist()
        stored = all(entry.compress_type == zipfile.ZIP_STORED for entry in entries)
        if not stored or sum(entry.file_size for entry in entries) > path.stat().st_size:
            raise SceneError(
                f"{path}: is a checkpoint with compressed entries, which PyTorch does not write. {_EXPORT}"
            )
        with torch.serialization.safe_globals(_NUMPY_SCALARS):
            return torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise SceneError(
            f"{path}: holds more than tensors and plain values. Such a file can run any program, so it is not loaded. "
            f"{_EXPORT}"
        ) from error
    except (OSError, zipfile.BadZipFile) as error:
        raise SceneError(f"{path}: cannot be read: {error}. Check the path.") from error
    except (RuntimeError, ValueError, TypeError, KeyError, EOFError) as error:  # of PyTorch for damaged content
        raise SceneError(f"{path}: is a damaged checkpoint ({str(error)[:100]}). Use an intact copy.") from error


def _splats_in(path: Path, content: Any) -> tuple[dict[str, Any], Mapping[str, str]]:
    """Return the dictionary of a checkpoint that holds the Gaussians, and the names of gsplat's keys in it."""
    if isinstance(content, dict) and isinstance(content.get("splats"), dict):
        tensors, names = content["splats"], {key: key for key in SPLAT_KEYS.values()}
    elif isinstance(content, dict) and isinstance(content.get("pipeline"), dict):
        tensors, names = content["pipeline"], _NERFSTUDIO
    else:
        raise SceneError(f"{path}: is neither a checkpoint of gsplat's trainer nor one of nerfstudio. {_EXPORT}")
    if names["sh0"] not in tensors:
        raise SceneError(f"{path}: holds no Gaussians with spherical harmonics (`{names['sh0']}`). {_EXPORT}")
    if names is _NERFSTUDIO and not np.prod(np.shape(tensors.get(names["shN"], ()))):
        raise SceneError(f"{path}: was trained with SH degree 0, whose colors nerfstudio keeps as logits. {_EXPORT}")
    for name in names.values():
        value = tensors.get(name)
        if isinstance(value, Tensor) and value.numel() * value.element_size() > value.untyped_storage().nbytes():
            raise SceneError(f"{path}: `{name}` is larger than its data. Use an intact copy.")
    return tensors, names
