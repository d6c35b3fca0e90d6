"""Functions with which users of the library read inputs and save results, and the scenes of trainers.

gsplat's trainers and nerfstudio's splatfacto keep dictionaries of tensors, and write checkpoints that hold them: a
pickle in a ZIP archive. PyTorch loads only tensors and plain values from it. Before that, its entries are checked: they
must be uncompressed, so that they cannot take more memory than the file is long.
"""

import pickle
import warnings
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from sgsst_core.errors import OutputError, SceneError
from sgsst_core.files.advice import is_checkpoint, refuse_changed_meaning
from sgsst_core.files.atomic import atomic_path
from sgsst_core.files.camera_files import read_cameras
from sgsst_core.files.formats import HEAD_BYTES, RESULT_FORMATS, RESULT_SUFFIXES, format_of_name
from sgsst_core.files.formats.ply import PLY
from sgsst_core.files.formats.scene_format import OPACITY_LOGITS, read_bytes
from sgsst_core.files.formats.spz import SpzAxes
from sgsst_core.files.scene_file import (
    SceneFile,
    check_unchanged,
    file_stamp,
    losses,
    read_scene,
    write_scene,
    write_stylized,
)
from sgsst_core.refine import Refinement, piece_counts
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import TENSORS, Scene, attenuation_factor, checked_scene

#: Key of each field of `Scene` in a dictionary of splats.
SPLAT_KEYS = {**{name: name for name in TENSORS}, "sh_dc": "sh0", "sh_rest": "shN"}

#: Tensors, parameters or NumPy arrays by key.
Splats = Mapping[str, Any]
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


def scene_of_splats(splats: Splats) -> Scene:
    """Return the scene of a dictionary of splats.

    Values are those of gsplat's trainers, with logarithms of scales and logits of opacities, or those that gsplat's
    `rasterization` takes: see `are_activated`. Opacities of exactly 0 and 1 have no finite logit; they are clamped as
    in compressed formats.

    Args:
        splats: means [N, 3], quats [N, 4] (wxyz), scales [N, 3], opacities [N], sh0 [N, 1, 3] and shN [N, K, 3]; shN
            may be absent.

    Raises:
        SceneError: If a key is missing, or a value has a wrong type, shape or range.

    Example:
        >>> scene = load_scene("scene.ply").scene
        >>> splats = {"means": scene.means, "quats": scene.quats, "scales": scene.scales.exp()}
        >>> splats |= {"opacities": scene.opacities.sigmoid(), "sh0": scene.sh_dc[:, None]}
        >>> torch.allclose(scene_of_splats(splats).scales, scene.scales)
        True
    """
    keys = SPLAT_KEYS.values()
    missing = [key for key in keys if key not in splats and key != "shN"]
    if missing:
        raise SceneError(
            f"The scene lacks {', '.join(f'`{key}`' for key in missing)}. Give a dictionary with {', '.join(keys)}, as "
            "gsplat's trainers keep it."
        )
    values = {field: splats[key] for field, key in SPLAT_KEYS.items() if key in splats}
    values.setdefault("sh_rest", torch.zeros(len(values["means"]), 0, 3))
    opacities, scales = (_tensor(key, splats[key]) for key in ("opacities", "scales"))
    if are_activated(opacities, scales):
        opacities, scales = opacities.logit(), scales.clamp_min(torch.finfo(scales.dtype).tiny).log()
    clamped = opacities.clamp(float(OPACITY_LOGITS[0]), float(OPACITY_LOGITS[-1]))
    values |= {"opacities": torch.where(opacities.isinf(), clamped, opacities), "scales": scales}
    return checked_scene(Scene(**values), SPLAT_KEYS)


def are_activated(opacities: Tensor, scales: Tensor) -> bool:
    """Return whether values are opacities in 0..1 and standard deviations, instead of logits and logarithms.

    They are if all opacities are in 0..1 and no scale is negative.

    Raises:
        SceneError: If only one of the two is so.
    """
    in_range = not bool(((opacities < 0) | (opacities > 1)).any())
    positive = not bool((scales < 0).any())
    if in_range != positive:
        values = "`opacities` in 0..1 and logarithms as `scales`" if in_range else "positive `scales` and logits"
        raise SceneError(
            f"The scene has {values}. Give logarithms and logits as gsplat's trainers keep them, or neither; a `Scene` "
            "holds logarithms and logits of any sign."
        )
    return in_range


def stylized_splats(
    splats: Splats, scene: Scene, refinement: Refinement | None, sh_attenuation: float
) -> dict[str, Any]:
    """Return a dictionary of splats with the colors of a stylized scene, with the types and shapes that it has.

    Pieces of a split Gaussian inherit entries that `Scene` does not have.

    Refinement and SH attenuation are those of the stylized scene.
    """
    result, changed = dict(splats), {"sh0": scene.sh_dc}
    if refinement is not None and refinement.split:
        counts = piece_counts(refinement.pieces)
        for key, value in result.items():
            if np.ndim(value) == 0 or len(value) != len(counts):
                continue
            if isinstance(value, Tensor):
                result[key] = value.detach().repeat_interleave(counts.to(value.device), dim=0)
            else:
                result[key] = np.repeat(value, counts.numpy(), axis=0)
        activated = are_activated(*(_tensor(key, splats[key]) for key in ("opacities", "scales")))
        changed |= {
            "means": scene.means,
            "opacities": scene.opacities.sigmoid() if activated else scene.opacities,
            "scales": scene.scales.exp() if activated else scene.scales,
        }
    for key, value in changed.items():
        given, shaped = splats[key], value.reshape(len(value), *splats[key].shape[1:])
        as_array = not isinstance(given, Tensor)
        result[key] = shaped.numpy().astype(given.dtype) if as_array else shaped.to(given.device, given.dtype)
    if sh_attenuation and "shN" in result:
        result["shN"] = result["shN"] * attenuation_factor(sh_attenuation)
    return result


def _tensor(key: str, value: Any) -> Tensor:
    """Return a value as a tensor on the CPU."""
    if not isinstance(value, Tensor | np.ndarray):
        raise SceneError(f"The scene: `{key}` is a {type(value).__name__}. Give a tensor or NumPy array.")
    return torch.as_tensor(value).detach().cpu()


@dataclass(frozen=True)
class TrainerCheckpoint:
    """Checkpoint of a trainer, together with the information to write it back.

    Attributes:
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

    def stylized(self, scene: Scene, refinement: Refinement | None, sh_attenuation: float) -> "TrainerCheckpoint":
        """Return the checkpoint of a stylized scene; see `stylized_splats`."""
        return replace(self, scene=scene, splats=stylized_splats(self.splats, scene, refinement, sh_attenuation))


def is_trainer_checkpoint(path: Path) -> bool:
    """Return whether a file is a checkpoint in a ZIP archive, as PyTorch has written them since version 1.6."""
    try:
        head = read_bytes(path, 0, HEAD_BYTES)
    except SceneError:
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
    check_unchanged(checkpoint.path, checkpoint.stamp)
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
    except (OSError, zipfile.BadZipFile, RuntimeError, ValueError, TypeError, KeyError, EOFError) as error:
        raise SceneError(f"{path}: is not a readable checkpoint ({str(error)[:100]}). Use an intact copy.") from error


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
