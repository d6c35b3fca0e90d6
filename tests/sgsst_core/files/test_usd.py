"""Tests of USD files, read back by usd-core."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from sgsst_core.errors import OutputError
from sgsst_core.files.usd import USD_SUFFIXES, check_usd, write_usd
from sgsst_core.scene.stored_harmonics import held
from tests.sgsst_core.splat_scenes import cloud

pxr = pytest.importorskip("pxr", reason="usd-core is not installed")


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("suffix", USD_SUFFIXES)
def test_written_values_match_the_scene(tmp_path: Path, suffix: str, degree: int) -> None:
    """Values are linear, axes have y up, and coefficients follow each other by Gaussian."""
    from pxr import Usd, UsdGeom, UsdVol

    scene, path = cloud(300, degree=degree), tmp_path / f"scene{suffix}"
    write_usd(path, scene)
    stage = Usd.Stage.Open(str(path))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1)
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert splats

    def values(name: str) -> np.ndarray:
        return np.array(stage.GetDefaultPrim().GetAttribute(name).Get())

    flip = np.array([-1, -1, 1])
    np.testing.assert_array_equal(values("positions"), scene.means.numpy() * flip)
    np.testing.assert_allclose(values("scales"), scene.scales.double().exp(), rtol=1e-6)
    np.testing.assert_allclose(values("opacities"), scene.opacities.double().sigmoid(), rtol=1e-6)
    assert int(values("radiance:sphericalHarmonicsDegree")) == degree
    harmonics = values("radiance:sphericalHarmonicsCoefficients").reshape(300, -1, 3)
    assert harmonics.shape == (300, (degree + 1) ** 2, 3)
    np.testing.assert_array_equal(harmonics[:, 0], scene.sh_dc.numpy())
    signs = np.array([-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])[: harmonics.shape[1] - 1, None]
    np.testing.assert_array_equal(harmonics[:, 1:], held(scene.sh_rest).numpy() * signs)
    quats = scene.quats.double().numpy()
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    for index, actual in enumerate(splats.GetOrientationsAttr().Get()):
        expected = (-z[index], -y[index], x[index], w[index])  # a rotation by 180 degrees about z comes first
        assert (actual.GetReal(), *actual.GetImaginary()) == pytest.approx(expected, abs=1e-6)
    low, high = splats.GetExtentAttr().Get()
    assert bool((np.array(low) < values("positions")).all() and (np.array(high) > values("positions")).all())


def test_missing_extra_error_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [*sys.modules]:
        if name.partition(".")[0] == "pxr":
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.setattr(sys, "path", [])
    with pytest.raises(OutputError, match=r"pip install 'sgsst-service\[usd\]'"):
        check_usd(Path("scene.usdc"))


def test_missing_folder_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="does not exist"):
        write_usd(tmp_path / "missing" / "scene.usdc", cloud(10))
    assert not [*tmp_path.iterdir()]
