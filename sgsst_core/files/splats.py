"""Scenes as dictionaries of tensors, as gsplat's trainers keep them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sgsst_core.errors import SceneError
from sgsst_core.files.formats.quantized import OPACITY_LOGITS
from sgsst_core.refine.split import Refinement, piece_counts
from sgsst_core.scene.gaussians import Scene, attenuation_factor, checked_scene

#: Key of each field of `Scene` in a dictionary of splats.
SPLAT_KEYS = {
    "means": "means",
    "quats": "quats",
    "scales": "scales",
    "opacities": "opacities",
    "sh_dc": "sh0",
    "sh_rest": "shN",
}

#: Tensors, parameters or NumPy arrays by key.
Splats = Mapping[str, Any]


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

    Args:
        splats: Dictionary of the unstylized scene.
        scene: Stylized scene.
        refinement: Refinement of the stylized scene; None if there was none.
        sh_attenuation: SH attenuation of the stylized scene.
    """
    result, changed = dict(splats), {"sh0": scene.sh_dc}
    if refinement is not None and refinement.split:
        counts = piece_counts(refinement.pieces)
        result = {key: _repeated(value, counts) for key, value in result.items()}
        activated = are_activated(*(_tensor(key, splats[key]) for key in ("opacities", "scales")))
        changed |= {
            "means": scene.means,
            "opacities": scene.opacities.sigmoid() if activated else scene.opacities,
            "scales": scene.scales.exp() if activated else scene.scales,
        }
    result |= {key: _like(value, splats[key]) for key, value in changed.items()}
    if sh_attenuation and "shN" in result:
        result["shN"] = result["shN"] * attenuation_factor(sh_attenuation)
    return result


def _tensor(key: str, value: Any) -> Tensor:
    """Return a value as a tensor on the CPU."""
    if not isinstance(value, Tensor | np.ndarray):
        raise SceneError(f"The scene: `{key}` is a {type(value).__name__}. Give a tensor or NumPy array.")
    return torch.as_tensor(value).detach().cpu()


def _repeated(value: Any, counts: Tensor) -> Any:
    """Repeat the rows of a value of all Gaussians; return other values unchanged."""
    if np.ndim(value) == 0 or len(value) != len(counts):
        return value
    if isinstance(value, Tensor):
        return value.detach().repeat_interleave(counts.to(value.device), dim=0)
    return np.repeat(value, counts.numpy(), axis=0)


def _like(value: Tensor, given: Any) -> Any:
    """Return a value with the type, dtype, device and shape of a row of the given one."""
    value = value.reshape(len(value), *given.shape[1:])
    return value.to(given.device, given.dtype) if isinstance(given, Tensor) else value.numpy().astype(given.dtype)
