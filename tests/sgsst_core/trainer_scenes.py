"""Scenes as trainers keep them: gsplat's dictionaries, and checkpoints of gsplat and nerfstudio."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgsst_core.scene.gaussians import Scene


def splats_of(scene: Scene, activated: bool = False) -> dict[str, Tensor]:
    """Return a scene in the shapes of gsplat's trainer; `activated` as its rasterizer takes it."""
    return {
        "means": scene.means,
        "scales": scene.scales.exp() if activated else scene.scales,
        "quats": scene.quats,
        "opacities": scene.opacities.sigmoid() if activated else scene.opacities,
        "sh0": scene.sh_dc[:, None],
        "shN": scene.sh_rest,
    }


def write_gsplat(path: Path, scene: Scene) -> Path:
    """Write a checkpoint as gsplat's `simple_trainer.py` does."""
    torch.save({"step": 29_999, "splats": splats_of(scene)}, path)
    return path


def write_nerfstudio(path: Path, scene: Scene) -> Path:
    """Write a checkpoint as nerfstudio does for splatfacto, with optimizer and NumPy learning rates of its schedule."""
    splats = splats_of(scene)
    model = {
        "means": splats["means"],
        "scales": splats["scales"],
        "quats": splats["quats"],
        "features_dc": scene.sh_dc,
        "features_rest": splats["shN"],
        "opacities": scene.opacities[:, None],
    }
    rates = {"lr": np.float64(1.6e-6), "betas": (0.9, 0.999), "params": [0]}
    content: dict[str, Any] = {
        "step": 29_999,
        "pipeline": {"_model.device_indicator_param": torch.zeros(0)}
        | {f"_model.gauss_params.{name}": value for name, value in model.items()},
        "optimizers": {"means": {"state": {0: {"exp_avg": 0.5 * scene.means}}, "param_groups": [rates]}},
        "schedulers": {"means": {"last_epoch": 29_999, "_last_lr": [np.float64(1.6e-6)], "lr_lambdas": [None]}},
        "scalers": {},
    }
    torch.save(content, path)
    return path
