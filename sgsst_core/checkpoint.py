"""Checkpoints: one safetensors file with everything that a resumed run needs, tied to its job by a fingerprint."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from sgsst_core.camera import Camera
from sgsst_core.errors import CheckpointError
from sgsst_core.files import atomic_path
from sgsst_core.loss import LossTerms
from sgsst_core.scene import Scene
from sgsst_core.settings import Settings
from sgsst_core.stylizer import StepRecord, StylizerState

#: Raised whenever the meaning of a stored value changes.
FORMAT_VERSION = "2"
#: Settings that may differ between a checkpoint and the run that goes on from it: they only end it, or (the memory
#: limit, which decides the partition) change no more than its rounding.
_FREE_SETTINGS = {"max_seconds", "target_loss", "early_stop", "memory_limit"}


def fingerprint(
    scene: Scene, cameras: Sequence[Camera], style: Tensor, settings: Settings, weights: str, photos: str = ""
) -> str:
    """SHA-256 over all that decides the course of a job.

    Args:
        weights: digest of the feature network's.
        photos: whatever identifies the content images; empty for unstylized renders.
    """
    digest = hashlib.sha256(repr((weights, photos)).encode())
    for tensor in (scene.means, scene.quats, scene.scales, scene.opacities, scene.sh_dc, scene.sh_rest, style):
        digest.update(repr(tuple(tensor.shape)).encode())
        digest.update(tensor.contiguous().numpy().data)
    for camera in cameras:
        pose = camera.world_to_camera.numpy().tobytes()
        digest.update(repr((camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)).encode() + pose)
    digest.update(settings.model_dump_json(exclude=_FREE_SETTINGS).encode())
    return digest.hexdigest()


def save_checkpoint(path: Path, state: StylizerState, job: str) -> None:
    """Write a checkpoint of the job with that fingerprint; it appears whole or not at all.

    Raises:
        OutputError: the file cannot be written.
    """
    tensors = {
        "sh_dc": state.sh_dc,
        "first_moment": state.first_moment,
        "second_moment": state.second_moment,
        "generator": state.generator,
    }
    metadata = {
        "version": FORMAT_VERSION,
        "job": job,
        "step": str(state.step),
        "seconds": repr(state.seconds),
        "queue": json.dumps(state.queue),
        "history": json.dumps([asdict(record) for record in state.history]),
        "seconds_by_part": json.dumps(state.seconds_by_part),
        "memory": json.dumps(state.memory),
        "measured": json.dumps(state.measured),
    }
    with atomic_path(path) as temporary:
        save_file(tensors, temporary, metadata)


def load_checkpoint(path: Path, job: str) -> StylizerState:
    """Read a checkpoint of the job with that fingerprint.

    Raises:
        CheckpointError: missing or corrupt file, or another job's.
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: there is no checkpoint to resume from. Start again without --resume.")
    try:
        with safe_open(path, "pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
        if metadata["version"] != FORMAT_VERSION:
            raise CheckpointError(f"{path}: is of another version of this program. Start again without --resume.")
        if metadata["job"] != job:
            raise CheckpointError(
                f"{path}: belongs to another job (scene, cameras, style, weights or settings differ). "
                "Give the same ones as before, or start again without --resume."
            )
        return StylizerState(
            sh_dc=tensors["sh_dc"],
            first_moment=tensors["first_moment"],
            second_moment=tensors["second_moment"],
            step=int(metadata["step"]),
            seconds=float(metadata["seconds"]),
            generator=tensors["generator"].to(torch.uint8),
            queue=json.loads(metadata["queue"]),
            history=[_record(entry) for entry in json.loads(metadata["history"])],
            seconds_by_part=json.loads(metadata["seconds_by_part"]),
            memory=json.loads(metadata["memory"]),
            measured=json.loads(metadata["measured"]),
        )
    except (SafetensorError, KeyError, ValueError, OSError) as error:
        raise CheckpointError(
            f"{path}: is not a readable checkpoint ({error}). Start again without --resume."
        ) from error


def _record(entry: dict) -> StepRecord:
    terms = {int(scale): LossTerms(**parts) for scale, parts in entry["terms"].items()}
    return StepRecord(**{**entry, "terms": terms})
