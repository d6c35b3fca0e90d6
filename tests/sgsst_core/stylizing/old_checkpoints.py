"""Checkpoints of a version before, made of present ones."""

from __future__ import annotations

import json
from pathlib import Path

from safetensors import safe_open
from safetensors.torch import save_file

from sgsst_core.stylizing.checkpoint import _digest


def of_version_3(path: Path, decision: str | None = None) -> None:
    """Rewrite a checkpoint as version 3 of its format had it: without what a plan did not say then."""
    with safe_open(path, "pt") as file:
        metadata = file.metadata()
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (not a mapping)
    plan = json.loads(metadata["plan"])
    for name in ("memory_limit", "device", "rasterizer", "precision", "measured"):
        del plan[name]
    if decision:
        plan["decisions"][0]["decision"] = decision
    del metadata["digest"]
    metadata |= {"version": "3", "plan": json.dumps(plan)}
    save_file(tensors, path, {**metadata, "digest": _digest(tensors, metadata)})
