"""Writer of OpenUSD files with a ParticleField3DGaussianSplat, with the extra `usd`."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import numpy as np

from sgsst_core.errors import OutputError
from sgsst_core.files.atomic import DISK_FULL, atomic_path
from sgsst_core.files.formats.frame import Y_UP, Frame
from sgsst_core.files.scene_file import arrays_of
from sgsst_core.scene.gaussians import Scene

#: Suffixes of USD files: binary, text, and binary.
USD_SUFFIXES = (".usdc", ".usda", ".usd")
#: Standard deviations within the written extent.
_REACH = 3


def check_usd(out: Path) -> None:
    """Check that USD files can be written.

    Raises:
        OutputError: If usd-core is not installed, or too old.
    """
    if importlib.util.find_spec("pxr") is not None:
        from pxr import UsdVol

        if hasattr(UsdVol, "ParticleField3DGaussianSplat"):
            return
    raise OutputError(
        f"{out}: is a USD file, which the extra `usd` writes. Run `pip install 'sgsst-service[usd]'`, or write a .glb."
    )


def write_usd(path: Path, scene: Scene) -> None:
    """Write a scene as a USD stage with y up, atomically. Standard deviations and opacities are stored as they are.

    Raises:
        OutputError: If the file cannot be written.
    """
    from pxr import Tf, Usd, UsdGeom, UsdVol, Vt

    scene = scene.without_zero_bands()
    arrays = {name: array.astype(np.float32) for name, array in arrays_of(scene).items()}
    Frame.of(Y_UP).apply(arrays)
    quats = arrays["quats"].astype(np.float64)
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    with np.errstate(over="ignore"):
        scales = np.exp(arrays["scales"].astype(np.float64)).astype(np.float32)
        opacities = (1 / (1 + np.exp(-arrays["opacities"].astype(np.float64)))).astype(np.float32)
    reach = _REACH * scales.max(axis=1, keepdims=True)
    bounds = np.stack([(arrays["means"] - reach).min(axis=0), (arrays["means"] + reach).max(axis=0)])
    harmonics = np.concatenate([arrays["sh_dc"][:, None], arrays["sh_rest"]], axis=1).reshape(-1, 3)

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Gaussians")
    stage.SetDefaultPrim(splats.GetPrim())
    splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(bounds.astype(np.float32)))
    for name, values in {
        "positions": Vt.Vec3fArray.FromNumpy(arrays["means"]),
        "orientations": Vt.QuatfArray.FromNumpy(np.roll(quats, -1, axis=1).astype(np.float32)),
        "scales": Vt.Vec3fArray.FromNumpy(scales),
        "opacities": Vt.FloatArray.FromNumpy(opacities),
        "radiance:sphericalHarmonicsDegree": scene.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(harmonics),
    }.items():
        splats.GetPrim().GetAttribute(name).Set(values)
    with atomic_path(path) as temporary:
        try:
            written = stage.GetRootLayer().Export(str(temporary))
        except Tf.ErrorException as error:
            full = next((code for code in DISK_FULL if os.strerror(code) in str(error)), None)
            if full:  # reported by `atomic_path`
                raise OSError(full, os.strerror(full)) from error
            raise OutputError(f"{path}: cannot be written: {error}. Free some space, or name another file.") from error
        if not written:
            raise OutputError(f"{path}: cannot be written. Free some space, or name another file.")
