"""Checkpoints of a version before, made of present ones."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor

from sgsst_core.stylizing.checkpoint import _digest


def of_version_4(path: Path) -> None:
    """Rewrite a checkpoint as version 4 of its format had it: without the memory of a GPU."""
    metadata, tensors = _parts(path)
    history, plan = json.loads(metadata["history"]), json.loads(metadata["plan"])
    for record in history:
        del record["device_memory"]
    del plan["prediction"]["device_bytes"], plan["search"]
    metadata |= {"version": "4", "history": json.dumps(history), "plan": json.dumps(plan)}
    save_file(tensors, path, {**metadata, "digest": _digest(tensors, metadata)})


def of_version_3(path: Path, decision: str | None = None) -> None:
    """Rewrite a checkpoint as version 3 of its format had it: without what a plan did not say then."""
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
    """Metadata without the digest, and tensors."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    del metadata["digest"]
    return metadata, tensors
