"""Facts about scenes, views and machines for tests of a plan's rules, without a survey."""

from __future__ import annotations

from typing import Any

import torch

from sgsst_core.features.partition import Rectangle
from sgsst_core.parallel.division import Size, Tiling
from sgsst_core.planning.facts import Facts, Machine
from sgsst_core.planning.survey import Survey

CPU, GPU = Machine("cpu", 1 << 33), Machine("cuda", 1 << 33, graphs=True)


def facts(
    machine: Machine = CPU,
    *,
    size: Size = (545, 980),
    views: int = 4,
    gaussians: int = 1000,
    uncovered: float = 0.0,
    **values: Any,
) -> Facts:
    """Return the facts about views of one size that see all Gaussians of a scene."""
    weights, regions = torch.ones(gaussians, dtype=torch.float64), [Rectangle(0, 0, *size)] * views
    given: dict[str, Any] = {
        "sh_degree": 0,
        "used_degree": 0,
        "harmonics_energy": 0.0,
        "rasterizer": "cpu" if machine.device == "cpu" else "triton",
        "precision": "float32",
        "tiling": Tiling(halo=64, held=1e7, working=0.25, coarsest=256),
        "pixel_bytes": 2000.0,
        **values,
    }
    return Facts(
        gaussians=gaussians,
        sizes=(size,) * views,
        survey=Survey(weights, list(range(views)), regions, uncovered),
        machine=machine,
        **given,
    )
