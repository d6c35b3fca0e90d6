"""Checkpoints: safetensors files with everything that a resumed run needs, tied to their job by a fingerprint.

A checkpoint contains a digest of its content.
"""

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from sgsst_core.errors import CheckpointError
from sgsst_core.features.vgg import EVEN_COLOR_SCALE, EVEN_PIXEL_SCALE, EVEN_SCALE
from sgsst_core.files.atomic import atomic_path
from sgsst_core.messages import from_json, to_json
from sgsst_core.planning.plan import Plan
from sgsst_core.regions import Region, Regions
from sgsst_core.scene.camera import Camera
from sgsst_core.scene.gaussians import Scene
from sgsst_core.settings import Settings
from sgsst_core.style import Style
from sgsst_core.stylizing.stylizer import StylizerState

T = TypeVar("T")

#: Increased whenever the meaning of a stored value changes.
FORMAT_VERSION = "11"
#: Settings that may differ between a checkpoint and the run that resumes from it. They only end the run or select
#: measurements; the memory limit, which determines the partition, changes only rounding.
_FREE_SETTINGS = {"within", "fixed", "target_loss", "early_stop", "memory_limit", "measure"}


@dataclass(frozen=True)
class Checkpoint:
    """State from which an unfinished job resumes.

    Attributes:
        plan: Plan of the job, which saves a resumed run from surveying the views again.
        ranks: Number of ranks when the plan was made.
        run: Identifier of the program run that wrote it.
    """

    state: StylizerState
    plan: Plan
    ranks: int
    run: str
    written_by: dict[str, str]


def save_checkpoint(path: Path, checkpoint: Checkpoint, job: str) -> None:
    """Write a checkpoint of the job with this fingerprint in place of an earlier one, atomically.

    Raises:
        OutputError: If the file cannot be written; an earlier checkpoint remains.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(*_packed(checkpoint, job, checkpoint.run)))


@functools.cache
def versions() -> dict[str, str]:
    """Return the versions of this program ("unknown" if it is not installed) and of PyTorch.

    They are cached, because a confined process may not read the files of an installation from source.
    """
    try:
        program = version("sgsst-service")
    except PackageNotFoundError:
        program = "unknown"
    return {"program": program, "torch": torch.__version__}


def fingerprint(
    scene: Scene,
    cameras: Sequence[Camera],
    style: Style,
    settings: Settings,
    weights: str,
    photos: str = "",
    regions: Regions | None = None,
) -> str:
    """Return a SHA-256 digest of everything that determines the course of a job.

    Args:
        weights: Digest of the feature network's weights.
        photos: Identifier of the content images; empty for unstylized renders.
    """
    digest = hashlib.sha256(repr((weights, photos, scene.rendering)).encode())
    for tensor in (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh_dc, scene.sh_rest):
        digest.update(repr(tuple(tensor.shape)).encode())
        digest.update(tensor.contiguous().numpy().data)
    regions = regions and replace(regions, every=tuple(_unnamed(region) for region in regions.every))
    unnamed, tensors = [replace(camera, name="") for camera in cameras], dict[str, Tensor]()
    inputs = json.dumps(to_json((_plain(style), regions, unnamed), tensors))
    # Later versions may choose other factors, but a run must stay with one loss.
    even = repr((EVEN_SCALE, EVEN_COLOR_SCALE, EVEN_PIXEL_SCALE)) if settings.feature_scale == "even" else ""
    chosen = settings.model_dump_json(exclude=_FREE_SETTINGS)
    digest.update(_digest(tensors, {"inputs": inputs, "settings": chosen, "even": even}).encode())
    return digest.hexdigest()


def _plain(style: Style) -> Style:
    """Return a style without names and notes."""
    return replace(style, names=(), notes=())


def _unnamed(region: Region) -> Region:
    """Return what a region does to its Gaussians."""
    return replace(region, name="", select="", selected=0, style=region.style and _plain(region.style))


def save_plan(path: Path, plan: Plan, job: str, conditions: str) -> None:
    """Write a plan into an existing file, for a run of the same job that finds the same conditions.

    Args:
        conditions: Text about everything else that the plan depends on, such as the machine.
    """
    path.write_bytes(save(*_packed(plan, job, conditions)))


def load_plan(path: Path, job: str, scene: Scene, cameras: Sequence[Camera]) -> tuple[Plan, str]:
    """Return a plan from `save_plan` and its conditions. What it says about scene and views is checked.

    Args:
        scene: Scene of the job, before its refinement.

    Raises:
        CheckpointError: If there is no such file, or it is corrupt or of another job.
    """
    plan, conditions = _load(path, job, Plan)
    count, refinement, fits = len(scene), plan.refinement, True
    views = len(plan.time_choice.views) if plan.time_choice else len(cameras)
    if refinement is not None:
        count = int(refinement.pieces.long().prod(dim=1).sum())
        fits = refinement.pieces.shape == (len(scene), 3) and int(refinement.pieces.min()) >= 1
        fits = fits and (refinement.sh_dc is None or refinement.sh_dc.shape == (count, 3))
    fits = (
        fits
        and all(each.shape == (count,) and each.dtype == torch.bool for each in (plan.seen, plan.optimized))
        and plan.survey.total_blend_weights.shape == (count,)
        and all(0 <= index < views for index in (*plan.covered, *plan.survey.covered))
        and len(plan.survey.regions) == views
        and all(0 <= index < len(cameras) for index in (plan.time_choice.views if plan.time_choice else ()))
    )
    if not fits:
        raise CheckpointError(f"{path}: is not a plan of this scene.")
    return plan, conditions


def _packed(value: Checkpoint | Plan, job: str, run: str) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return the tensors of a file of a job, and its metadata with the other values and a digest of all content."""
    tensors: dict[str, Tensor] = {}
    values = json.dumps(to_json(value, tensors))
    metadata = {"version": FORMAT_VERSION, "job": job, "run": run, "values": values}
    return tensors, {**metadata, "digest": _digest(tensors, metadata)}


def load_checkpoint(path: Path, job: str, run: str | None = None) -> Checkpoint:
    """Read a checkpoint of the job with this fingerprint.

    Args:
        run: Program run that must have written it; None for any run.

    Raises:
        CheckpointError: If the file is missing or corrupt, or belongs to another job or run.
    """
    checkpoint, written_by = _load(path, job, Checkpoint)
    if run not in (None, written_by):
        raise CheckpointError(f"{path}: was written by an earlier run. Start again without --resume.")
    return checkpoint


def _load(path: Path, job: str, kind: type[T]) -> tuple[T, str]:
    """Return the value of a file of a job and what wrote it, after checking its digest."""
    if not path.is_file():
        raise CheckpointError(f"{path}: there is no checkpoint to resume from. Start again without --resume.")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        if metadata["version"] != FORMAT_VERSION:
            raise CheckpointError(f"{path}: is of another version of this program. Start again without --resume.")
        if metadata.pop("digest") != _digest(tensors, metadata):
            raise ValueError("its content is not what was written")
        if metadata["job"] != job:
            raise CheckpointError(
                f"{path}: belongs to another job (scene, cameras, style, weights or settings differ). "
                "Give the same ones as before, or start again without --resume."
            )
        value = from_json(json.loads(metadata["values"]), tensors)
        if not isinstance(value, kind):
            raise TypeError(f"it holds no {kind.__name__}")
        return value, metadata["run"]
    except (SafetensorError, AttributeError, KeyError, TypeError, ValueError, OSError, ImportError) as error:
        raise CheckpointError(
            f"{path}: is not a readable checkpoint ({error}). Start again without --resume."
        ) from error


def _digest(tensors: Mapping[str, Tensor], metadata: Mapping[str, str]) -> str:
    """Return a SHA-256 digest of a checkpoint's content."""
    digest = hashlib.sha256(json.dumps(metadata, sort_keys=True).encode())
    for name in sorted(tensors):
        tensor = tensors[name].contiguous()
        digest.update(repr((name, str(tensor.dtype), tuple(tensor.shape))).encode())
        digest.update(tensor.numpy().data)
    return digest.hexdigest()
