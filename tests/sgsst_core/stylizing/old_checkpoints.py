"""Checkpoints of earlier format versions, made from present ones."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from sgsst_core.stylizing.checkpoint import _digest


def of_version_4(path: Path) -> None:
    """Rewrite a checkpoint in version 4 of the format, without GPU memory."""
    metadata, tensors = _parts(path)
    history, plan = json.loads(metadata["history"]), json.loads(metadata["plan"])
    for record in history:
        del record["device_memory"]
    del plan["prediction"]["device_bytes"], plan["search"]
    metadata |= {"version": "4", "history": json.dumps(history), "plan": json.dumps(plan)}
    save_file(tensors, path, {**metadata, "digest": _digest(tensors, metadata)})


def of_version_3(path: Path, decision: str | None = None) -> None:
    """Rewrite a checkpoint in version 3 of the format, without the fields that plans lacked then."""
    of_version_4(path)
    metadata, tensors = _parts(path)
    plan = json.loads(metadata["plan"])
    for name in ("memory_limit", "device", "rasterizer", "precision", "measured"):
        del plan[name]
    if decision:
        plan["decisions"][0]["decision"] = decision
    metadata |= {"version": "3", "plan": json.dumps(plan)}
    save_file(tensors, path, {**metadata, "digest": _digest(tensors, metadata)})


def _parts(path: Path) -> tuple[dict[str, str], dict[str, Tensor]]:
    """Return metadata without the digest, and tensors."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    del metadata["digest"]
    return metadata, tensors
